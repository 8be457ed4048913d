"""Extended Kalman filtering over a batch: a scalar update, and the filter of wind and heading from GPS velocity.

Arrays are state first, flight last: state (state, flight), covariance (state, state, flight).  Everything is worked
element by element, so that a flight has the same bits alone and in company.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi.atmosphere import density_kg_m3

# States of `WindHeadingFilter`.
WIND_NORTH, WIND_EAST, AIRSPEED, HEADING, HEADING_RATE = range(5)


def wrap_rad(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same angle in (-pi, pi], any shape; an angle already there keeps its bits."""
    wrapped: NDArray[np.float64] = angle_rad - 2.0 * math.pi * np.ceil((angle_rad - math.pi) / (2.0 * math.pi))
    return wrapped


def scalar_update(
    state: NDArray[np.float64],
    covariance: NDArray[np.float64],
    innovation: NDArray[np.float64],
    jacobian: Sequence[tuple[int, NDArray[np.float64] | float]],
    variance: float,
) -> None:
    """Correct state (state, flight) and covariance (state, state, flight), in place, by one scalar measurement.

    innovation: (flight,), measured less expected; jacobian: the entries of the measurement row that are not zero, as
    (state, (flight,) or number); variance: of the measurement, in the square of its unit.
    The covariance loses P h h' P / s, which stays symmetric to the bit.
    """
    first, slope = jacobian[0]
    cross = covariance[first] * slope
    for j, slope in jacobian[1:]:
        cross += covariance[j] * slope
    first, slope = jacobian[0]
    spread = cross[first] * slope
    for j, slope in jacobian[1:]:
        spread += cross[j] * slope
    spread += variance
    state += cross * (innovation / spread)
    covariance -= cross[:, None] * cross[None, :] / spread


@dataclass(frozen=True, slots=True)
class WindHeadingFilter:
    """Wind, airspeed, heading of the air velocity and its rate, from the horizontal velocity over ground.

    States: wind north and east (m/s), airspeed (m/s), heading (rad, NED), heading rate (rad/s).  The airspeed relaxes to
    the nominal polar: without that, wind along the track and airspeed cannot be told apart in straight flight.
    Source: the approach of Ward, Costello and Slegers (2010), as the parafoil paper uses it; docs/parafoil_method.md.
    """

    airspeed_m_s: float  # nominal horizontal airspeed at the reference density
    reference_density_kg_m3: float
    airspeed_relaxation_s: float
    wind_noise_m_s_sqrt_s: float  # random walk of each wind component
    airspeed_noise_m_s_sqrt_s: float
    heading_rate_noise_rad_s_sqrt_s: float
    velocity_noise_m_s: float  # standard deviation of each measured component
    start_wind_variance_m2_s2: float  # where a forecast is known
    start_calm_variance_m2_s2: float  # where none is: still air assumed
    start_airspeed_variance_m2_s2: float
    start_heading_variance_rad2: float
    start_heading_rate_variance_rad2_s2: float

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"navigation.{name} = {getattr(self, name)} must be a number above 0")

    def nominal_airspeed_m_s(self, altitude_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Horizontal airspeed of the nominal glide at this altitude, (flight,)."""
        airspeed: NDArray[np.float64] = self.airspeed_m_s * np.sqrt(self.reference_density_kg_m3 / density_kg_m3(altitude_m))
        return airspeed

    def start(
        self,
        wind_m_s: NDArray[np.float64],
        wind_variance_m2_s2: NDArray[np.float64],
        velocity_m_s: NDArray[np.float64],
        altitude_m: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """State and covariance at the first fix: (state, flight), (state, state, flight).

        wind_m_s, velocity_m_s: (2, flight), north and east; wind_variance_m2_s2: (flight,), for each of both.
        """
        state = np.zeros((5, altitude_m.size))
        state[WIND_NORTH : WIND_EAST + 1] = wind_m_s
        state[AIRSPEED] = self.nominal_airspeed_m_s(altitude_m)
        air_m_s = velocity_m_s - wind_m_s
        state[HEADING] = np.arctan2(air_m_s[1], air_m_s[0])
        covariance = np.zeros((5, 5, altitude_m.size))
        covariance[WIND_NORTH, WIND_NORTH] = wind_variance_m2_s2
        covariance[WIND_EAST, WIND_EAST] = wind_variance_m2_s2
        covariance[AIRSPEED, AIRSPEED] = self.start_airspeed_variance_m2_s2
        covariance[HEADING, HEADING] = self.start_heading_variance_rad2
        covariance[HEADING_RATE, HEADING_RATE] = self.start_heading_rate_variance_rad2_s2
        return state, covariance

    def predict(
        self,
        state: NDArray[np.float64],
        covariance: NDArray[np.float64],
        elapsed_s: NDArray[np.float64],
        altitude_m: NDArray[np.float64],
    ) -> None:
        """Carry both, in place, over elapsed_s (flight,); the heading is not wrapped here."""
        nominal_m_s = self.nominal_airspeed_m_s(altitude_m)
        kept = np.exp(elapsed_s / -self.airspeed_relaxation_s)
        state[HEADING] += elapsed_s * state[HEADING_RATE]
        state[AIRSPEED] = nominal_m_s + (state[AIRSPEED] - nominal_m_s) * kept
        covariance[HEADING] += elapsed_s * covariance[HEADING_RATE]
        covariance[:, HEADING] += elapsed_s * covariance[:, HEADING_RATE]
        covariance[AIRSPEED] *= kept
        covariance[:, AIRSPEED] *= kept
        wind_step = (self.wind_noise_m_s_sqrt_s * self.wind_noise_m_s_sqrt_s) * elapsed_s
        rate_step = (self.heading_rate_noise_rad_s_sqrt_s * self.heading_rate_noise_rad_s_sqrt_s) * elapsed_s
        cross_step = rate_step * (0.5 * elapsed_s)
        covariance[WIND_NORTH, WIND_NORTH] += wind_step
        covariance[WIND_EAST, WIND_EAST] += wind_step
        covariance[AIRSPEED, AIRSPEED] += (self.airspeed_noise_m_s_sqrt_s * self.airspeed_noise_m_s_sqrt_s) * elapsed_s
        covariance[HEADING, HEADING] += cross_step * (elapsed_s * (2.0 / 3.0))
        covariance[HEADING, HEADING_RATE] += cross_step
        covariance[HEADING_RATE, HEADING] += cross_step
        covariance[HEADING_RATE, HEADING_RATE] += rate_step

    def update(self, state: NDArray[np.float64], covariance: NDArray[np.float64], velocity_m_s: NDArray[np.float64]) -> None:
        """Correct both, in place, by the velocity over ground (2, flight): north, then east about the result of north."""
        variance = self.velocity_noise_m_s * self.velocity_noise_m_s
        cos, sin = np.cos(state[HEADING]), np.sin(state[HEADING])
        along = state[AIRSPEED] * cos
        innovation = velocity_m_s[0] - (state[WIND_NORTH] + along)
        across = state[AIRSPEED] * -sin
        scalar_update(state, covariance, innovation, ((WIND_NORTH, 1.0), (AIRSPEED, cos), (HEADING, across)), variance)
        cos, sin = np.cos(state[HEADING]), np.sin(state[HEADING])
        across = state[AIRSPEED] * sin
        innovation = velocity_m_s[1] - (state[WIND_EAST] + across)
        along = state[AIRSPEED] * cos
        scalar_update(state, covariance, innovation, ((WIND_EAST, 1.0), (AIRSPEED, sin), (HEADING, along)), variance)
        state[HEADING] = wrap_rad(state[HEADING])
