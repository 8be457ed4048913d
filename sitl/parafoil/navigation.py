"""The autopilot's navigation filter: wind, airspeed and heading from nothing but GPS velocity.

An extended Kalman filter over five states, run at each fix; kernels over one flight.  It is part of the simulated
autopilot, for its guidance; a monitor keeps its own.

Source: Stoeckle, Fejzic, Breger, How, "Fault Detection and Isolation for Autonomous Parafoils", which names the states;
noise figures are ours, see docs/parafoil.md.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sitl.angles import wrap_pi
from sitl.kernel import plant_kernel
from sitl.parafoil.dynamics import density_kg_m3

# states, (ESTIMATE,): wind (where the air moves to), m/s; horizontal airspeed, m/s; heading of the air velocity, rad; its
# rate, rad/s
ESTIMATED_NORTH, ESTIMATED_EAST, AIRSPEED, HEADING, HEADING_RATE = range(5)
ESTIMATE = 5

POLAR_AIRSPEED_M_S = 18.99  # horizontal airspeed of the nominal glide at 2000 m
POLAR_DENSITY_KG_M3 = 1.00649
RELAXATION_S = 60.0  # to the polar: without it, wind along track and airspeed drift apart by 10 m/s in straight flight
WIND_WALK = 0.15  # m/s per root second
AIRSPEED_WALK = 0.25  # m/s per root second
HEADING_RATE_WALK = 0.20  # rad/s per root second
VELOCITY_NOISE_M_S = 0.30
START_VARIANCES = (4.0, 4.0, 2.0, 0.05, 0.01)


@plant_kernel
def polar_airspeed_m_s(altitude_m: float) -> float:
    """Horizontal airspeed of the nominal glide, m/s, at an altitude above sea level, m."""
    return POLAR_AIRSPEED_M_S * math.sqrt(POLAR_DENSITY_KG_M3 / density_kg_m3(altitude_m))


@plant_kernel
def start_estimate(
    estimate: NDArray[np.float64],
    covariance: NDArray[np.float64],
    wind_north_m_s: float,
    wind_east_m_s: float,
    airspeed_m_s: float,
    velocity_north_m_s: float,
    velocity_east_m_s: float,
) -> None:
    """Begin at a fix with a believed wind and airspeed: writes estimate, (ESTIMATE,), and its covariance."""
    estimate[ESTIMATED_NORTH] = wind_north_m_s
    estimate[ESTIMATED_EAST] = wind_east_m_s
    estimate[AIRSPEED] = airspeed_m_s
    estimate[HEADING] = math.atan2(velocity_east_m_s - wind_east_m_s, velocity_north_m_s - wind_north_m_s)
    estimate[HEADING_RATE] = 0.0
    for i in range(ESTIMATE):
        for j in range(ESTIMATE):
            covariance[i, j] = 0.0
        covariance[i, i] = START_VARIANCES[i]


@plant_kernel
def predict_estimate(
    estimate: NDArray[np.float64], covariance: NDArray[np.float64], polar_airspeed: float, dt_s: float
) -> None:
    """Advance by dt_s: heading turns at its rate, airspeed relaxes to the polar's, m/s; in place."""
    decay = math.exp(-dt_s / RELAXATION_S)
    estimate[AIRSPEED] = polar_airspeed + (estimate[AIRSPEED] - polar_airspeed) * decay
    estimate[HEADING] += dt_s * estimate[HEADING_RATE]
    for j in range(ESTIMATE):
        covariance[AIRSPEED, j] *= decay
        covariance[HEADING, j] += dt_s * covariance[HEADING_RATE, j]
    for i in range(ESTIMATE):
        covariance[i, AIRSPEED] *= decay
        covariance[i, HEADING] += dt_s * covariance[i, HEADING_RATE]
    walk = HEADING_RATE_WALK * HEADING_RATE_WALK
    covariance[ESTIMATED_NORTH, ESTIMATED_NORTH] += WIND_WALK * WIND_WALK * dt_s
    covariance[ESTIMATED_EAST, ESTIMATED_EAST] += WIND_WALK * WIND_WALK * dt_s
    covariance[AIRSPEED, AIRSPEED] += AIRSPEED_WALK * AIRSPEED_WALK * dt_s
    covariance[HEADING, HEADING] += walk * dt_s * dt_s * dt_s / 3.0
    covariance[HEADING, HEADING_RATE] += walk * dt_s * dt_s / 2.0
    covariance[HEADING_RATE, HEADING] += walk * dt_s * dt_s / 2.0
    covariance[HEADING_RATE, HEADING_RATE] += walk * dt_s


@plant_kernel
def _update_component(
    estimate: NDArray[np.float64],
    covariance: NDArray[np.float64],
    wind: int,
    along: float,
    across: float,
    velocity_m_s: float,
    gain: NDArray[np.float64],
) -> None:
    """One scalar measurement: velocity = wind + airspeed * along, d(velocity)/d(heading) = airspeed * across."""
    slope = estimate[AIRSPEED] * across
    for i in range(ESTIMATE):
        gain[i] = covariance[i, wind] + along * covariance[i, AIRSPEED] + slope * covariance[i, HEADING]
    variance = gain[wind] + along * gain[AIRSPEED] + slope * gain[HEADING] + VELOCITY_NOISE_M_S * VELOCITY_NOISE_M_S
    innovation = velocity_m_s - (estimate[wind] + estimate[AIRSPEED] * along)
    for i in range(ESTIMATE):
        estimate[i] += gain[i] / variance * innovation
        for j in range(ESTIMATE):
            covariance[i, j] -= gain[i] * gain[j] / variance


@plant_kernel
def update_estimate(
    estimate: NDArray[np.float64],
    covariance: NDArray[np.float64],
    velocity_north_m_s: float,
    velocity_east_m_s: float,
    work: NDArray[np.float64],
) -> None:
    """Take a fix: north, then east linearised about the result of north; heading wrapped; work: (ESTIMATE,), overwritten."""
    heading = estimate[HEADING]
    _update_component(estimate, covariance, ESTIMATED_NORTH, math.cos(heading), -math.sin(heading), velocity_north_m_s, work)
    heading = estimate[HEADING]
    _update_component(estimate, covariance, ESTIMATED_EAST, math.sin(heading), math.cos(heading), velocity_east_m_s, work)
    estimate[HEADING] = wrap_pi(estimate[HEADING])
