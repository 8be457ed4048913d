"""One step of all flights: air, motors, flight, sensors, navigation and guidance, in that order.

Kernels.  A flight never sees another: the loop over flights is the outermost, and each flight's arithmetic is the same
alone and in company.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sitl import wind
from sitl.angles import wrap_pi, wrap_turn
from sitl.kernel import plant_kernel
from sitl.parafoil import dynamics, guidance, navigation
from sitl.parafoil.faults import MOTOR_1, faulty_motor_step, pulled_lines
from sitl.parafoil.flights import (
    FILTER_RUNS,
    FIX_EAST,
    FIX_MS,
    FIX_NORTH,
    FIX_VELOCITY_DOWN,
    FIX_VELOCITY_EAST,
    FIX_VELOCITY_NORTH,
    FOLLOWED_1_M,
    FOLLOWED_TURN_RAD_S,
    FUNCTION_1,
    GPS_DISABLED,
    GPS_EAST_ERROR,
    GPS_NOISE,
    GPS_NORTH_ERROR,
    GYRO_BIAS,
    PITCH_OFFSET,
    ROLL_OFFSET,
    SLACK_M,
    YAW_OFFSET,
    Flights,
)
from sitl.parafoil.vehicle import CHANNELS, LEFT_TOGGLE, RIGHT_TOGGLE
from sitl.sensors import gauss_markov_step, quantised, standard_pressure_pa

FIX_PERIOD_MS = guidance.PERIOD_MS
FIX_PERIOD_S = guidance.PERIOD_S
HOLD_PERIOD_MS = 1000  # density and the mass matrix
LOST_MS = 1000  # without GPS for longer than this, the autopilot neither steers nor trusts its filter
EARTH_RADIUS_M = 6378137.0  # WGS 84, equatorial; a drop zone is small and near

# columns of the normal numbers of a step, (NORMALS,)
N_GUST, N_ROLL_GUST, N_ENCODER, N_GYRO, N_ACCELERATION, N_VELOCITY, N_POSITION, N_PRESSURE = 0, 3, 4, 6, 9, 12, 15, 17
NORMALS = 18

# columns of the sensors' figures, (SENSORS,), as config.Sensors
(
    GPS_POSITION_M,
    GPS_POSITION_TIME_S,
    GPS_VELOCITY_M_S,
    GYRO_RAD_S,
    ACCELERATION_M_S2,
    PRESSURE_HEIGHT_M,
    ENCODER_M,
    ENCODER_RESOLUTION_M,
) = range(8)
SENSORS = 8

# columns of home, (3,)
HOME_LATITUDE_RAD, HOME_LONGITUDE_RAD, HOME_ALTITUDE_M = range(3)

WORK = (6, dynamics.STATES)  # scratch of one flight at a time: five rows for the integration, one for the filter

C_VELOCITY_NORTH = CHANNELS.index("velocity_north_m_s")
C_VELOCITY_EAST = CHANNELS.index("velocity_east_m_s")
C_VELOCITY_DOWN = CHANNELS.index("velocity_down_m_s")
C_LATITUDE = CHANNELS.index("latitude_rad")
C_LONGITUDE = CHANNELS.index("longitude_rad")
C_ALTITUDE = CHANNELS.index("altitude_m")
C_HEIGHT = CHANNELS.index("height_m")
C_COURSE = CHANNELS.index("course_rad")
C_GROUND_SPEED = CHANNELS.index("ground_speed_m_s")
C_CLIMB_RATE = CHANNELS.index("climb_rate_m_s")
C_HEADING = CHANNELS.index("heading_rad")
C_ROLL = CHANNELS.index("roll_rad")
C_PITCH = CHANNELS.index("pitch_rad")
C_YAW = CHANNELS.index("yaw_rad")
C_ROLL_RATE = CHANNELS.index("roll_rate_rad_s")
C_ACCELERATION_X = CHANNELS.index("acceleration_x_m_s2")
C_PRESSURE_ALTITUDE = CHANNELS.index("pressure_altitude_m")
C_PRESSURE = CHANNELS.index("pressure_pa")
C_AIRSPEED = CHANNELS.index("airspeed_m_s")
C_WHEEL_1 = CHANNELS.index("wheel_distance_1_m")
C_OUTPUT_1 = CHANNELS.index("output_1_us")
C_TURN_COMMAND = CHANNELS.index("turn_rate_command_rad_s")
C_NAV_BEARING = CHANNELS.index("nav_bearing_rad")
C_TARGET_BEARING = CHANNELS.index("target_bearing_rad")
C_TARGET_DISTANCE = CHANNELS.index("target_distance_m")
C_ALTITUDE_ERROR = CHANNELS.index("altitude_error_m")
C_WIND_SPEED = CHANNELS.index("wind_speed_m_s")
C_WIND_DIRECTION = CHANNELS.index("wind_direction_rad")
C_LANDED = CHANNELS.index("landed")

# sampled at each fix, unlike the rest, which is sampled at each step
SLOW_CHANNELS = (
    *("velocity_north_m_s", "velocity_east_m_s", "velocity_down_m_s", "latitude_rad", "longitude_rad"),
    *("altitude_m", "height_m", "course_rad", "ground_speed_m_s", "climb_rate_m_s", "pressure_altitude_m", "pressure_pa"),
    *("airspeed_m_s", "nav_bearing_rad", "target_bearing_rad", "target_distance_m", "altitude_error_m"),
    *("wind_speed_m_s", "wind_direction_rad"),
)
GPS_CHANNELS = np.array(
    [
        *(C_VELOCITY_NORTH, C_VELOCITY_EAST, C_VELOCITY_DOWN, C_LATITUDE, C_LONGITUDE, C_ALTITUDE, C_HEIGHT),
        *(C_COURSE, C_GROUND_SPEED, C_CLIMB_RATE),
    ]
)


@plant_kernel
def _move_air(flights: Flights, f: int, normal: NDArray[np.float64], dt_s: float) -> None:
    """Turbulence of this step, and the wind where the vehicle is; held over the step."""
    state, gust, profile, air = flights.state[f], flights.gust[f], flights.profile[f], flights.air[f]
    height = -state[dynamics.DOWN]
    airspeed = dynamics.GLIDE_AIRSPEED_M_S * math.sqrt(dynamics.SEA_LEVEL_DENSITY_KG_M3 / flights.held[f, dynamics.DENSITY])
    length, sigma, sigma_vertical = wind.turbulence(height, profile[wind.SPEED_10M], profile[wind.SIGMA])
    wind.transverse_step(gust, normal[N_GUST:], length, airspeed, dt_s)
    gust_north = wind.transverse_gust(gust, 0, sigma)
    gust_east = wind.transverse_gust(gust, 1, sigma)
    north, east = wind.mean_wind(profile, height)
    air[dynamics.WIND_NORTH] = north + gust_north
    air[dynamics.WIND_EAST] = east + gust_east
    air[dynamics.WIND_DOWN] = wind.transverse_gust(gust, 2, sigma_vertical)
    sigma_roll = wind.roll_gust_sigma(sigma_vertical, length, dynamics.SPAN_M)
    air[dynamics.GUST_P] = wind.roll_gust_step(gust, sigma_roll, dynamics.SPAN_M, airspeed, dt_s, normal[N_ROLL_GUST])
    air[dynamics.GUST_R] = wind.yaw_gust_step(
        gust, gust_north, gust_east, state[dynamics.PSI], dynamics.SPAN_M, airspeed, dt_s
    )


@plant_kernel
def _move_motors(flights: Flights, f: int, t_ms: int, dt_s: float) -> None:
    """Motors follow the commands of the sample before; the plant sees the mean of their old and new positions."""
    circumstances, body, faults, motor = flights.circumstances[f], flights.body[f], flights.faults[f], flights.motor_m[f]
    followed = flights.followed[f]
    followed[FOLLOWED_TURN_RAD_S] = flights.guidance[f, guidance.TURN_COMMAND_RAD_S]
    old_1, old_2 = motor[0], motor[1]
    for output in range(2):
        function = circumstances[FUNCTION_1 + output]
        command = 0.0
        if function == LEFT_TOGGLE:
            command = flights.guidance[f, guidance.LEFT_M]
        elif function == RIGHT_TOGGLE:
            command = flights.guidance[f, guidance.RIGHT_M]
        followed[FOLLOWED_1_M + output] = command
        motor[output] = faulty_motor_step(
            faults[MOTOR_1 + output],
            t_ms,
            motor[output],
            command,
            dynamics.MOTOR_LAG_S * body[dynamics.LAG_FACTOR_1 + output],
            dynamics.MOTOR_RATE_M_S * body[dynamics.RATE_FACTOR_1 + output],
            dt_s,
        )
    left, right = pulled_lines(faults, t_ms, 0.5 * (old_1 + motor[0]), 0.5 * (old_2 + motor[1]), circumstances[SLACK_M])
    flights.line_m[f, 0] = left
    flights.line_m[f, 1] = right


@plant_kernel
def _touch_down(flights: Flights, f: int, t_ms: int) -> None:
    """End the flight: it stays where it is, level."""
    state = flights.state[f]
    state[dynamics.DOWN] = 0.0
    for i in range(dynamics.U, dynamics.THETA + 1):
        state[i] = 0.0
    flights.landed_ms[f] = t_ms


@plant_kernel
def _read_step_sensors(
    flights: Flights,
    f: int,
    sensors: NDArray[np.float64],
    normal: NDArray[np.float64],
    rate: NDArray[np.float64],
) -> None:
    """What is sampled at each step: gyro, accelerometer, attitude, encoders, outputs.  rate: d(state)/dt, (STATES,)."""
    state, errors, readings = flights.state[f], flights.errors[f], flights.readings[f]
    readings[C_ROLL] = wrap_pi(state[dynamics.PHI] + errors[ROLL_OFFSET])
    readings[C_PITCH] = state[dynamics.THETA] + errors[PITCH_OFFSET]
    yaw = state[dynamics.PSI] + errors[YAW_OFFSET]
    readings[C_YAW] = wrap_pi(yaw)
    readings[C_HEADING] = wrap_turn(yaw)
    u, v, w = state[dynamics.U], state[dynamics.V], state[dynamics.W]
    p, q, r = state[dynamics.P], state[dynamics.Q], state[dynamics.R]
    x, y, z = dynamics.ned_to_body(state, 0.0, 0.0, dynamics.GRAVITY_M_S2)
    if flights.landed_ms[f] < 0:
        x -= rate[dynamics.U] + q * w - r * v
        y -= rate[dynamics.V] + r * u - p * w
        z -= rate[dynamics.W] + p * v - q * u
    specific_force = (-x, -y, -z)
    for axis in range(3):
        readings[C_ROLL_RATE + axis] = (
            state[dynamics.P + axis] + errors[GYRO_BIAS] + sensors[GYRO_RAD_S] * normal[N_GYRO + axis]
        )
        readings[C_ACCELERATION_X + axis] = specific_force[axis] + sensors[ACCELERATION_M_S2] * normal[N_ACCELERATION + axis]
    for output in range(2):
        spool = flights.motor_m[f, output] + sensors[ENCODER_M] * normal[N_ENCODER + output]
        readings[C_WHEEL_1 + output] = quantised(spool, sensors[ENCODER_RESOLUTION_M])
        command = flights.followed[f, FOLLOWED_1_M + output]
        readings[C_OUTPUT_1 + output] = 1000.0 + 1000.0 * command / dynamics.TOGGLE_RANGE_M
    readings[C_TURN_COMMAND] = flights.followed[f, FOLLOWED_TURN_RAD_S]
    readings[C_LANDED] = 1.0 if flights.landed_ms[f] >= 0 else 0.0


@plant_kernel
def _read_fix_sensors(
    flights: Flights, f: int, home: NDArray[np.float64], sensors: NDArray[np.float64], normal: NDArray[np.float64]
) -> None:
    """What is sampled with GPS: position and velocity, if it is there at all, and pressure."""
    state, errors, fix, readings = flights.state[f], flights.errors[f], flights.fix[f], flights.readings[f]
    height = -state[dynamics.DOWN]
    readings[C_PRESSURE_ALTITUDE] = home[HOME_ALTITUDE_M] + height + sensors[PRESSURE_HEIGHT_M] * normal[N_PRESSURE]
    readings[C_PRESSURE] = standard_pressure_pa(readings[C_PRESSURE_ALTITUDE])
    for axis in range(2):  # the slow error walks on, whether anybody listens or not
        errors[GPS_NORTH_ERROR + axis] = gauss_markov_step(
            errors[GPS_NORTH_ERROR + axis],
            sensors[GPS_POSITION_M],
            sensors[GPS_POSITION_TIME_S],
            FIX_PERIOD_S,
            normal[N_POSITION + axis],
        )
    if flights.circumstances[f, GPS_DISABLED] != 0.0:
        for channel in GPS_CHANNELS:
            readings[channel] = math.nan
        return
    factor = flights.circumstances[f, GPS_NOISE]
    north, east, down = dynamics.velocity_ned_m_s(state)
    north += factor * sensors[GPS_VELOCITY_M_S] * normal[N_VELOCITY]
    east += factor * sensors[GPS_VELOCITY_M_S] * normal[N_VELOCITY + 1]
    down += factor * sensors[GPS_VELOCITY_M_S] * normal[N_VELOCITY + 2]
    fix[FIX_VELOCITY_NORTH], fix[FIX_VELOCITY_EAST], fix[FIX_VELOCITY_DOWN] = north, east, down
    fix[FIX_NORTH] = state[dynamics.NORTH] + factor * errors[GPS_NORTH_ERROR]
    fix[FIX_EAST] = state[dynamics.EAST] + factor * errors[GPS_EAST_ERROR]
    latitude = home[HOME_LATITUDE_RAD]
    readings[C_VELOCITY_NORTH], readings[C_VELOCITY_EAST], readings[C_VELOCITY_DOWN] = north, east, down
    readings[C_LATITUDE] = latitude + fix[FIX_NORTH] / EARTH_RADIUS_M
    readings[C_LONGITUDE] = wrap_pi(home[HOME_LONGITUDE_RAD] + fix[FIX_EAST] / (EARTH_RADIUS_M * math.cos(latitude)))
    readings[C_ALTITUDE] = home[HOME_ALTITUDE_M] + height
    readings[C_HEIGHT] = height
    readings[C_COURSE] = wrap_turn(math.atan2(east, north))
    readings[C_GROUND_SPEED] = math.sqrt(north * north + east * east)
    readings[C_CLIMB_RATE] = -down


@plant_kernel
def _navigate(flights: Flights, f: int, t_ms: int, home: NDArray[np.float64], work: NDArray[np.float64]) -> None:
    """Navigation filter and guidance, at a fix; without one, toggles stay for LOST_MS and go up then."""
    fix, estimate, covariance = flights.fix[f], flights.estimate[f], flights.covariance[f]
    height = -flights.state[f, dynamics.DOWN]
    gap_ms = t_ms - fix[FIX_MS]
    if flights.circumstances[f, GPS_DISABLED] != 0.0:
        if gap_ms > LOST_MS:
            guidance.glide_blind(flights.guidance[f], flights.limits[f], height)
        return
    north, east = fix[FIX_VELOCITY_NORTH], fix[FIX_VELOCITY_EAST]
    airspeed = navigation.polar_airspeed_m_s(home[HOME_ALTITUDE_M] + height)
    if fix[FILTER_RUNS] == 0.0:
        wind_north = guidance.forecast_at(flights.forecast[f], guidance.FORECAST_NORTH, height)
        wind_east = guidance.forecast_at(flights.forecast[f], guidance.FORECAST_EAST, height)
        navigation.start_estimate(estimate, covariance, wind_north, wind_east, airspeed, north, east)
        fix[FILTER_RUNS] = 1.0
    elif gap_ms > LOST_MS:  # the heading is anywhere by now, far outside what the filter can linearise; the wind is not
        wind_north, wind_east = estimate[navigation.ESTIMATED_NORTH], estimate[navigation.ESTIMATED_EAST]
        navigation.start_estimate(estimate, covariance, wind_north, wind_east, airspeed, north, east)
    else:
        navigation.predict_estimate(estimate, covariance, airspeed, gap_ms / 1000.0)
        navigation.update_estimate(estimate, covariance, north, east, work[5])
    fix[FIX_MS] = t_ms
    guidance.guide(
        flights.guidance[f],
        flights.orders[f],
        flights.limits[f],
        estimate,
        flights.forecast[f],
        fix[FIX_NORTH],
        fix[FIX_EAST],
        height,
        home[HOME_ALTITUDE_M],
        fix[FIX_VELOCITY_DOWN],
    )


@plant_kernel
def _show_navigation(flights: Flights, f: int, home: NDArray[np.float64]) -> None:
    """What the autopilot tells of its navigation: the forecast until its filter runs, its estimate from then on."""
    fix, readings, estimate = flights.fix[f], flights.readings[f], flights.estimate[f]
    height = -flights.state[f, dynamics.DOWN]
    if fix[FILTER_RUNS] == 0.0:
        north = guidance.forecast_at(flights.forecast[f], guidance.FORECAST_NORTH, height)
        east = guidance.forecast_at(flights.forecast[f], guidance.FORECAST_EAST, height)
        readings[C_AIRSPEED] = navigation.polar_airspeed_m_s(home[HOME_ALTITUDE_M] + height)
    else:
        north, east = estimate[navigation.ESTIMATED_NORTH], estimate[navigation.ESTIMATED_EAST]
        readings[C_AIRSPEED] = estimate[navigation.AIRSPEED]
    readings[C_WIND_SPEED] = math.sqrt(north * north + east * east)
    readings[C_WIND_DIRECTION] = wrap_turn(math.atan2(-east, -north))
    north, east = fix[FIX_NORTH], fix[FIX_EAST]
    readings[C_NAV_BEARING] = flights.guidance[f, guidance.WANTED_RAD]
    readings[C_TARGET_BEARING] = math.atan2(-east, -north)
    readings[C_TARGET_DISTANCE] = math.sqrt(north * north + east * east)
    readings[C_ALTITUDE_ERROR] = flights.guidance[f, guidance.SPARE_HEIGHT_M]


@plant_kernel
def begin(
    flights: Flights,
    normals: NDArray[np.float64],
    row: int,
    home: NDArray[np.float64],
    sensors: NDArray[np.float64],
    work: NDArray[np.float64],
) -> None:
    """Readings at release, before the first step, of all flights; normals: (flight, row, NORMALS); work as in `step`."""
    for f in range(flights.state.shape[0]):
        normal = normals[f, row]
        state, air = flights.state[f], flights.air[f]
        air[dynamics.WIND_NORTH], air[dynamics.WIND_EAST] = wind.mean_wind(flights.profile[f], -state[dynamics.DOWN])
        dynamics.derivative(state, 0.0, 0.0, air, flights.body[f], flights.held[f], work[3])
        _read_step_sensors(flights, f, sensors, normal, work[3])
        _read_fix_sensors(flights, f, home, sensors, normal)
        _show_navigation(flights, f, home)


@plant_kernel
def step(
    flights: Flights,
    normals: NDArray[np.float64],
    row: int,
    t_ms: int,
    dt_ms: int,
    home: NDArray[np.float64],
    sensors: NDArray[np.float64],
    work: NDArray[np.float64],
) -> None:
    """Advance all flights from t_ms by dt_ms; normals: (flight, row, NORMALS), work: WORK, overwritten."""
    dt_s = dt_ms / 1000.0
    after_ms = t_ms + dt_ms
    fix_due = after_ms % FIX_PERIOD_MS == 0
    for f in range(flights.state.shape[0]):
        normal = normals[f, row]
        state = flights.state[f]
        if flights.landed_ms[f] < 0:
            if t_ms % HOLD_PERIOD_MS == 0:
                altitude = home[HOME_ALTITUDE_M] - state[dynamics.DOWN]
                dynamics.hold(flights.held[f], flights.body[f], dynamics.density_kg_m3(altitude))
            _move_air(flights, f, normal, dt_s)
            _move_motors(flights, f, t_ms, dt_s)
            dynamics.runge_kutta(
                state,
                flights.line_m[f, 0],
                flights.line_m[f, 1],
                flights.air[f],
                flights.body[f],
                flights.held[f],
                dt_s,
                work,
            )
            if state[dynamics.DOWN] >= 0.0:
                _touch_down(flights, f, after_ms)
        _read_step_sensors(flights, f, sensors, normal, work[3])
        if fix_due:
            _read_fix_sensors(flights, f, home, sensors, normal)
            if flights.landed_ms[f] < 0:
                _navigate(flights, f, after_ms, home, work)
            _show_navigation(flights, f, home)
