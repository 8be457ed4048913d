"""The state of a batch of flights, and how a flight begins: what is drawn for it and where it is released."""

import math
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sitl.kernel import plant_kernel
from sitl.parafoil import dynamics, guidance, navigation
from sitl.parafoil.config import Config, Range, Spread
from sitl.parafoil.faults import FAULTS, no_faults
from sitl.parafoil.vehicle import CHANNELS, LEFT_TOGGLE, RIGHT_TOGGLE
from sitl.wind import (
    DIRECTION,
    FIRST_DOWN,
    FIRST_NORTH,
    GUSTS,
    PROFILE,
    SECOND_NORTH,
    SHEAR,
    SHEAR_LENGTH,
    SHEAR_PHASE,
    SIGMA,
    SPEED_10M,
    VEER,
    mean_wind,
)

# columns of what the motors follow, (3,)
FOLLOWED_1_M, FOLLOWED_2_M, FOLLOWED_TURN_RAD_S = range(3)

# columns of a flight's circumstances, (CIRCUMSTANCES,), which commands may change
SLACK_M, GPS_NOISE, GPS_DISABLED, FUNCTION_1, FUNCTION_2 = range(5)
CIRCUMSTANCES = 5

# columns of the sensors' constant and slow errors, (ERRORS,)
GYRO_BIAS, ROLL_OFFSET, PITCH_OFFSET, YAW_OFFSET, GPS_NORTH_ERROR, GPS_EAST_ERROR = range(6)
ERRORS = 6

# columns of the newest fix, (FIX,); its time is that of the last step with a fix, 0 before the first
FIX_VELOCITY_NORTH, FIX_VELOCITY_EAST, FIX_VELOCITY_DOWN, FIX_NORTH, FIX_EAST, FIX_MS, FILTER_RUNS = range(7)
FIX = 7

# draws of a flight that the faults use
CHANCES = 3
# where a flight is released, (5,): distance and bearing from the target in the air mass, heading, roll, roll rate
_DISTANCE_FRACTION, _BEARING, _HEADING, _ROLL, _ROLL_RATE = range(5)


class Flights(NamedTuple):
    """Arrays with a leading axis of flights, changed in place by the kernels; columns are named where they belong."""

    state: NDArray[np.float64]  # (flight, dynamics.STATES)
    body: NDArray[np.float64]  # (flight, dynamics.BODY)
    held: NDArray[np.float64]  # (flight, dynamics.HELD)
    air: NDArray[np.float64]  # (flight, dynamics.AIR)
    profile: NDArray[np.float64]  # (flight, wind.PROFILE)
    gust: NDArray[np.float64]  # (flight, wind.GUSTS)
    forecast: NDArray[np.float64]  # (flight, guidance.FORECAST_ROWS, 4)
    motor_m: NDArray[np.float64]  # (flight, output)
    line_m: NDArray[np.float64]  # (flight, edge), deflections of the left and right edge
    followed: NDArray[np.float64]  # (flight, 3)
    faults: NDArray[np.float64]  # (flight, faults.FAULTS, 4)
    circumstances: NDArray[np.float64]  # (flight, CIRCUMSTANCES)
    errors: NDArray[np.float64]  # (flight, ERRORS)
    fix: NDArray[np.float64]  # (flight, FIX)
    estimate: NDArray[np.float64]  # (flight, navigation.ESTIMATE)
    covariance: NDArray[np.float64]  # (flight, navigation.ESTIMATE, navigation.ESTIMATE)
    guidance: NDArray[np.float64]  # (flight, guidance.GUIDANCE)
    limits: NDArray[np.float64]  # (flight, guidance.LIMITS)
    orders: NDArray[np.float64]  # (flight, guidance.ORDERS)
    readings: NDArray[np.float64]  # (flight, channel)
    landed_ms: NDArray[np.int64]  # (flight,), -1 while it flies


def empty(flights: int) -> Flights:
    """Room for so many flights, sound, nothing ordered, lines slack-free, outputs in their usual order."""
    orders = np.zeros((flights, guidance.ORDERS))
    orders[:, [guidance.LIMIT_LEFT_M, guidance.LIMIT_RIGHT_M]] = dynamics.TRAVEL_M
    circumstances = np.zeros((flights, CIRCUMSTANCES))
    circumstances[:, GPS_NOISE] = 1.0
    circumstances[:, FUNCTION_1] = LEFT_TOGGLE
    circumstances[:, FUNCTION_2] = RIGHT_TOGGLE
    faults = np.empty((flights, FAULTS, 4))
    faults[:] = no_faults()
    return Flights(
        state=np.zeros((flights, dynamics.STATES)),
        body=np.ones((flights, dynamics.BODY)),
        held=np.zeros((flights, dynamics.HELD)),
        air=np.zeros((flights, dynamics.AIR)),
        profile=np.zeros((flights, PROFILE)),
        gust=np.zeros((flights, GUSTS)),
        forecast=np.zeros((flights, guidance.FORECAST_ROWS, 4)),
        motor_m=np.zeros((flights, 2)),
        line_m=np.zeros((flights, 2)),
        followed=np.zeros((flights, 3)),
        faults=faults,
        circumstances=circumstances,
        errors=np.zeros((flights, ERRORS)),
        fix=np.zeros((flights, FIX)),
        estimate=np.zeros((flights, navigation.ESTIMATE)),
        covariance=np.zeros((flights, navigation.ESTIMATE, navigation.ESTIMATE)),
        guidance=np.zeros((flights, guidance.GUIDANCE)),
        limits=np.zeros((flights, guidance.LIMITS)),
        orders=orders,
        readings=np.zeros((flights, len(CHANNELS))),
        landed_ms=np.full(flights, -1, dtype=np.int64),
    )


def _uniform(source: Generator, ends: Range) -> float:
    return ends[0] + (ends[1] - ends[0]) * source.random()


def _spread(source: Generator, spread: Spread, nominal: float) -> float:
    return min(max(nominal + spread.sd * source.standard_normal(), spread.lowest), spread.highest)


def _limits(config: Config) -> tuple[float, ...]:
    limits = config.guidance  # in the order of guidance.LIMITS' columns
    return (
        limits.turn_limit_rad_s,
        limits.s_turn_limit_rad,
        limits.final_limit_rad,
        limits.final_leg_s,
        limits.flare_height_m,
        limits.flare_m,
        limits.integral_limit_m,
    )


def draw(flights: Flights, f: int, config: Config, source: Generator) -> NDArray[np.float64]:
    """Draw all that is peculiar to flight f from its own generator and release it; -> (CHANCES,), for its fault.

    The order of the draws is part of what a seed means: append, never insert.
    """
    wind, vehicles, sensors = config.wind, config.vehicles, config.sensors
    body = flights.body[f]
    dynamics.fill_body(body, _uniform(source, vehicles.payload_factor))
    body[dynamics.DRAG_FACTOR] = _spread(source, vehicles.drag_factor, 1.0)
    body[dynamics.TURN_FACTOR] = _spread(source, vehicles.turn_factor, 1.0)
    body[dynamics.TURN_BIAS_M] = _spread(source, vehicles.turn_bias_m, 0.0)
    for column in (dynamics.LINE_FACTOR_LEFT, dynamics.LINE_FACTOR_RIGHT):
        body[column] = _spread(source, vehicles.line_factor, 1.0)
    for column in (dynamics.RATE_FACTOR_1, dynamics.RATE_FACTOR_2):
        body[column] = _spread(source, vehicles.motor_rate_factor, 1.0)
    for column in (dynamics.LAG_FACTOR_1, dynamics.LAG_FACTOR_2):
        body[column] = _spread(source, vehicles.motor_lag_factor, 1.0)

    profile = flights.profile[f]
    profile[SPEED_10M] = _uniform(source, wind.speed_10m_m_s)
    profile[DIRECTION] = _uniform(source, (0.0, 2.0 * math.pi))
    profile[VEER] = wind.veer_rad_km * source.standard_normal()
    profile[SHEAR] = _uniform(source, wind.shear_m_s)
    profile[SHEAR_LENGTH] = _uniform(source, wind.shear_length_m)
    profile[SHEAR_PHASE] = _uniform(source, (0.0, 2.0 * math.pi))
    profile[SIGMA] = _uniform(source, wind.turbulence_m_s)
    error_north = wind.forecast_error_m_s * source.standard_normal()
    error_east = wind.forecast_error_m_s * source.standard_normal()

    height = _uniform(source, config.release.height_m)
    release = np.empty(5)
    release[_DISTANCE_FRACTION] = _uniform(source, config.release.distance_fraction)
    release[_BEARING] = _uniform(source, (0.0, 2.0 * math.pi))
    release[_HEADING] = _uniform(source, (-math.pi, math.pi))
    release[_ROLL] = 0.1 * source.standard_normal()
    release[_ROLL_RATE] = 0.05 * source.standard_normal()

    errors = flights.errors[f]
    errors[GYRO_BIAS] = sensors.gyro_bias_rad_s * source.standard_normal()
    errors[ROLL_OFFSET] = sensors.tilt_offset_rad * source.standard_normal()
    errors[PITCH_OFFSET] = sensors.tilt_offset_rad * source.standard_normal()
    errors[YAW_OFFSET] = sensors.yaw_offset_rad * source.standard_normal()
    errors[GPS_NORTH_ERROR] = sensors.gps_position_m * source.standard_normal()
    errors[GPS_EAST_ERROR] = sensors.gps_position_m * source.standard_normal()

    chance = source.random(CHANCES)
    _release(
        flights.state[f],
        flights.held[f],
        body,
        flights.gust[f],
        profile,
        flights.forecast[f],
        height,
        release,
        source.standard_normal(6),
        np.array([error_north, error_east]),
        config.home.altitude_m,
    )
    guidance.start_guidance(flights.guidance[f])
    flights.limits[f] = _limits(config)
    flights.circumstances[f, SLACK_M] = config.faults.slack_m
    return chance


@plant_kernel
def _release(
    state: NDArray[np.float64],
    held: NDArray[np.float64],
    body: NDArray[np.float64],
    gust: NDArray[np.float64],
    profile: NDArray[np.float64],
    forecast: NDArray[np.float64],
    height_m: float,
    release: NDArray[np.float64],
    normal: NDArray[np.float64],
    forecast_error_m_s: NDArray[np.float64],
    home_altitude_m: float,
) -> None:
    """Forecast, turbulence and state at release; height_m above the target, normal: (6,), N(0, 1)."""
    guidance.fill_forecast(forecast, profile, forecast_error_m_s[0], forecast_error_m_s[1], home_altitude_m)
    for axis in range(3):  # both filters stationary, with the correlation that they have
        gust[FIRST_NORTH + axis] = normal[axis]
        gust[SECOND_NORTH + axis] = 0.5 * (normal[axis] + normal[FIRST_DOWN + 1 + axis])
    density = dynamics.density_kg_m3(home_altitude_m + height_m)
    dynamics.hold(held, body, density)

    distance = 2.9 * height_m * release[_DISTANCE_FRACTION]
    state[dynamics.NORTH] = distance * math.cos(release[_BEARING]) - guidance.forecast_at(
        forecast, guidance.DRIFT_NORTH, height_m
    )
    state[dynamics.EAST] = distance * math.sin(release[_BEARING]) - guidance.forecast_at(
        forecast, guidance.DRIFT_EAST, height_m
    )
    state[dynamics.DOWN] = -height_m
    state[dynamics.PHI] = release[_ROLL]
    state[dynamics.THETA] = -0.04
    state[dynamics.PSI] = release[_HEADING]
    state[dynamics.P] = release[_ROLL_RATE]
    thin = math.sqrt(dynamics.SEA_LEVEL_DENSITY_KG_M3 / density)
    north, east = mean_wind(profile, height_m)
    u, v, w = dynamics.ned_to_body(state, north, east, 0.0)
    state[dynamics.U] = 17.1 * thin + u
    state[dynamics.V] = v
    state[dynamics.W] = 4.4 * thin + w
