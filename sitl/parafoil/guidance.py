"""The autopilot's guidance: where to steer, how hard to turn, which toggles to pull.  It knows nothing of faults.

Kernels over one flight, run every 0.2 s.  The vehicle glides in the air mass: wind is taken off the way to the target as
a drift, height that is left over is spent by S-turns about the way to it, and the last 50 s are flown into the wind.
What a companion may set (turn direction, a stuck side, limits, probing) are orders; without any the vehicle is whole.

Source: ours throughout; see docs/parafoil.md.  The structure is that of parafoil guidance with energy management by
S-turns, as Stoeckle, Fejzic, Breger, How suppose it in "Fault Detection and Isolation for Autonomous Parafoils".
"""

import math

import numpy as np
from numpy.typing import NDArray

from sitl.angles import wrap_pi
from sitl.kernel import plant_kernel
from sitl.parafoil.dynamics import DC_GAIN_RAD_S_M, SEA_LEVEL_DENSITY_KG_M3, TRAVEL_M, density_kg_m3
from sitl.parafoil.navigation import AIRSPEED, ESTIMATED_EAST, ESTIMATED_NORTH, HEADING, HEADING_RATE
from sitl.wind import profile_wind

PERIOD_MS = 200
PERIOD_S = 0.2

FORECAST_STEP_M = 50.0
FORECAST_ROWS = 121  # up to 6000 m
FORECAST_NORTH, FORECAST_EAST, DRIFT_NORTH, DRIFT_EAST = range(4)

# columns of the guidance state, (GUIDANCE,)
(
    SINK_M_S,
    LEG_CLOCK_MS,
    LEG_SIGN,  # +1 right
    FINAL,  # 1 once latched
    INTEGRAL_M,
    CIRCLING,  # 1 while it spends height by circling, one-sided guidance only
    TURN_COMMAND_RAD_S,
    LEFT_M,  # commands of the toggles, by function
    RIGHT_M,
    QUIET_LEFT_MS,  # since that toggle was last asked for enough line to tell whether it works
    QUIET_RIGHT_MS,
    PULSE_MS,  # left of a probing pulse
    WANTED_RAD,  # heading wanted in the air mass
    SPARE_HEIGHT_M,
) = range(14)
GUIDANCE = 14

# columns of the orders, (ORDERS,)
TURN_DIRECTION, STUCK_SIDE, STUCK_VALUE_M, LIMIT_LEFT_M, LIMIT_RIGHT_M, PROBE = range(6)
ORDERS = 6
STUCK_LEFT, STUCK_RIGHT = 1.0, 2.0

# columns of the limits, (LIMITS,)
TURN_LIMIT_RAD_S, S_TURN_LIMIT_RAD, FINAL_LIMIT_RAD, FINAL_LEG_S, FLARE_HEIGHT_M, FLARE_M, INTEGRAL_LIMIT_M = range(7)
LIMITS = 7

SINK_START_M_S = 5.5
PROBE_ENOUGH_M, PROBE_PULL_M = 0.72, 0.80
PROBE_QUIET_MS, PROBE_PULSE_MS, PROBE_HEIGHT_M = 30000.0, 2500.0, 300.0
STUCK_LOW_M, STUCK_HIGH_M = 0.10, 1.10  # beyond these a stuck side leaves turns to one side only


@plant_kernel
def clipped(value: float, low: float, high: float) -> float:
    """The value, or the end of [low, high] that it lies beyond."""
    return min(max(value, low), high)


@plant_kernel
def nominal_sink_m_s(altitude_m: float) -> float:
    """Sink that the forecast's drift supposes, m/s, at an altitude above sea level, m."""
    return 5.0 * math.sqrt(SEA_LEVEL_DENSITY_KG_M3 / density_kg_m3(altitude_m))


@plant_kernel
def fill_forecast(
    forecast: NDArray[np.float64],
    profile: NDArray[np.float64],
    error_north_m_s: float,
    error_east_m_s: float,
    home_altitude_m: float,
) -> None:
    """Write the forecast, (FORECAST_ROWS, 4): wind, m/s, and drift down to the ground, m, every FORECAST_STEP_M.

    The forecast is the true wind without its shear wave, plus a constant error.  Drift by trapezoids of the wind over
    the nominal sink at mid-interval.
    """
    for i in range(FORECAST_ROWS):
        height = i * FORECAST_STEP_M
        north, east = profile_wind(profile, height)
        forecast[i, FORECAST_NORTH] = north + error_north_m_s
        forecast[i, FORECAST_EAST] = east + error_east_m_s
        if i == 0:
            forecast[i, DRIFT_NORTH] = 0.0
            forecast[i, DRIFT_EAST] = 0.0
            continue
        seconds = FORECAST_STEP_M / nominal_sink_m_s(home_altitude_m + height - 0.5 * FORECAST_STEP_M)
        for k in range(2):
            mean = 0.5 * (forecast[i - 1, FORECAST_NORTH + k] + forecast[i, FORECAST_NORTH + k])
            forecast[i, DRIFT_NORTH + k] = forecast[i - 1, DRIFT_NORTH + k] + mean * seconds


@plant_kernel
def forecast_at(forecast: NDArray[np.float64], column: int, height_m: float) -> float:
    """One column of the forecast at a height above ground, m; linear between rows, the end rows' beyond."""
    place = clipped(height_m / FORECAST_STEP_M, 0.0, FORECAST_ROWS - 1.0)
    i = min(int(place), FORECAST_ROWS - 2)
    low, high = forecast[i, column], forecast[i + 1, column]
    return float(low + (place - i) * (high - low))


@plant_kernel
def start_guidance(guidance: NDArray[np.float64]) -> None:
    """The guidance at release: toggles up, first leg to the right."""
    for i in range(GUIDANCE):
        guidance[i] = 0.0
    guidance[SINK_M_S] = SINK_START_M_S
    guidance[LEG_SIGN] = 1.0


@plant_kernel
def allowed_direction(orders: NDArray[np.float64]) -> float:
    """+1 right turns only, -1 left turns only, 0 both; by order, or because a stuck side leaves no other."""
    stuck, value = orders[STUCK_SIDE], orders[STUCK_VALUE_M]
    if stuck == STUCK_LEFT and value < STUCK_LOW_M:
        return 1.0
    if stuck == STUCK_LEFT and value > STUCK_HIGH_M:
        return -1.0
    if stuck == STUCK_RIGHT and value < STUCK_LOW_M:
        return -1.0
    if stuck == STUCK_RIGHT and value > STUCK_HIGH_M:
        return 1.0
    return float(orders[TURN_DIRECTION])


@plant_kernel
def differential_range_m(orders: NDArray[np.float64], direction: float) -> tuple[float, float]:
    """Lowest and highest differential toggle (right minus left), m, that the vehicle can follow."""
    left, right, value = orders[LIMIT_LEFT_M], orders[LIMIT_RIGHT_M], orders[STUCK_VALUE_M]
    if orders[STUCK_SIDE] == STUCK_LEFT:
        return -value, right - value
    if orders[STUCK_SIDE] == STUCK_RIGHT:
        return value - left, value
    return (0.0 if direction > 0.0 else -left), (0.0 if direction < 0.0 else right)


@plant_kernel
def _one_sided_rate(
    guidance: NDArray[np.float64],
    limit: NDArray[np.float64],
    direction: float,
    aim_m: float,
    off_rad: float,
    glide_ratio: float,
    airspeed_m_s: float,
    time_to_go_s: float,
) -> float:
    """Turn rate, rad/s, positive to the right, for a vehicle that turns to one side only.

    aim_m, off_rad: distance to the aim and its bearing off the heading; glide_ratio: that distance over the distance
    the height is good for.  It circles the height away, then flies an arc to the aim whose length uses up what is left
    (an arc of half angle x is x/sin x as long as its chord, about 1 + x^2/6).
    """
    off = off_rad * direction  # positive: on the side it can turn to
    half_arc = math.sqrt(6.0 * max(1.0 - min(glide_ratio, 1.0), 0.0))
    if guidance[CIRCLING] != 0.0:
        if time_to_go_s < 12.0 or (glide_ratio > 0.60 and 0.0 < off < half_arc + 0.25):
            guidance[CIRCLING] = 0.0
    elif time_to_go_s > 25.0 and (glide_ratio < 0.50 or off < -0.45):
        guidance[CIRCLING] = 1.0
    if guidance[CIRCLING] != 0.0:
        return direction * (0.26 if glide_ratio >= 0.60 else 0.18)
    rate = 2.0 * airspeed_m_s * math.sin(min(half_arc, 1.5)) / max(aim_m, 50.0) if off > 0.0 else 0.0
    rate += 0.40 * (off - half_arc if off > half_arc else min(off, 0.0))
    return direction * clipped(rate, 0.0, limit[TURN_LIMIT_RAD_S])


@plant_kernel
def _s_turn_heading(
    guidance: NDArray[np.float64],
    orders: NDArray[np.float64],
    limit: NDArray[np.float64],
    estimate: NDArray[np.float64],
    aim_north_m: float,
    aim_east_m: float,
    airspeed_m_s: float,
    time_to_go_s: float,
) -> float:
    """Heading wanted, rad: to the aim, off it by the angle that spends the spare time, sign changing from leg to leg."""
    distance = math.sqrt(aim_north_m * aim_north_m + aim_east_m * aim_east_m)
    bearing = math.atan2(aim_east_m, aim_north_m)
    turn_s = 0.6 * abs(wrap_pi(bearing - estimate[HEADING])) / limit[TURN_LIMIT_RAD_S]
    if time_to_go_s < 80.0 and (airspeed_m_s * (time_to_go_s - turn_s) <= 1.05 * distance or time_to_go_s < 30.0):
        guidance[FINAL] = 1.0
    final = guidance[FINAL] != 0.0
    available_s = time_to_go_s
    if not final:  # aim at the beginning of the last leg, which is flown into the wind
        wind_north, wind_east = estimate[ESTIMATED_NORTH], estimate[ESTIMATED_EAST]
        wind = math.sqrt(wind_north * wind_north + wind_east * wind_east)
        leg_m = airspeed_m_s * limit[FINAL_LEG_S]
        if wind < 1.5:
            aim_north_m -= leg_m * math.cos(bearing)
            aim_east_m -= leg_m * math.sin(bearing)
        else:
            aim_north_m += leg_m * wind_north / wind
            aim_east_m += leg_m * wind_east / wind
        available_s -= limit[FINAL_LEG_S]
        distance = math.sqrt(aim_north_m * aim_north_m + aim_east_m * aim_east_m)
        bearing = math.atan2(aim_east_m, aim_north_m)

    off = math.acos(min(distance / max(airspeed_m_s * available_s, 1.0), 1.0))
    off = min(off, limit[FINAL_LIMIT_RAD] if final else limit[S_TURN_LIMIT_RAD])
    if final and time_to_go_s < 5.0:
        off = 0.0
    if orders[STUCK_SIDE] != 0.0:
        off = min(off, 0.7 + 1.46 * min(orders[STUCK_VALUE_M], TRAVEL_M - orders[STUCK_VALUE_M]))
    period_ms = 5000.0 if final else 1000.0 * clipped(0.16 * time_to_go_s, 8.0, 20.0)
    guidance[LEG_CLOCK_MS] += PERIOD_MS
    if guidance[LEG_CLOCK_MS] >= period_ms:
        guidance[LEG_CLOCK_MS] = 0.0
        guidance[LEG_SIGN] = -guidance[LEG_SIGN]
    return float(bearing + guidance[LEG_SIGN] * off)


@plant_kernel
def _pull(
    guidance: NDArray[np.float64],
    orders: NDArray[np.float64],
    limit: NDArray[np.float64],
    direction: float,
    turn_rate_rad_s: float,
    heading_rate_rad_s: float,
    height_m: float,
) -> None:
    """Turn the rate wanted into commands of both toggles, m: feed-forward, proportional, integral."""
    low, high = differential_range_m(orders, direction)
    rate = clipped(turn_rate_rad_s, -limit[TURN_LIMIT_RAD_S], limit[TURN_LIMIT_RAD_S])
    if orders[STUCK_SIDE] != 0.0:
        rate = clipped(rate, DC_GAIN_RAD_S_M * low, DC_GAIN_RAD_S_M * high)
    error = rate - heading_rate_rad_s
    raw = (rate + 0.40 * error) / DC_GAIN_RAD_S_M + guidance[INTEGRAL_M]
    differential = clipped(raw, low, high)
    if not ((raw >= high and error > 0.0) or (raw <= low and error < 0.0)):
        bound = limit[INTEGRAL_LIMIT_M]
        step = 0.05 * error / DC_GAIN_RAD_S_M * PERIOD_S
        guidance[INTEGRAL_M] = clipped(guidance[INTEGRAL_M] + step, -bound, bound)
    guidance[TURN_COMMAND_RAD_S] = rate

    if orders[STUCK_SIDE] == STUCK_LEFT:  # neither flare nor probe: on one side alone they would turn the vehicle
        guidance[LEFT_M] = clipped(orders[STUCK_VALUE_M], 0.0, orders[LIMIT_LEFT_M])
        guidance[RIGHT_M] = clipped(orders[STUCK_VALUE_M] + differential, 0.0, orders[LIMIT_RIGHT_M])
        return
    if orders[STUCK_SIDE] == STUCK_RIGHT:
        guidance[RIGHT_M] = clipped(orders[STUCK_VALUE_M], 0.0, orders[LIMIT_RIGHT_M])
        guidance[LEFT_M] = clipped(orders[STUCK_VALUE_M] - differential, 0.0, orders[LIMIT_LEFT_M])
        return
    both = limit[FLARE_M] if height_m < limit[FLARE_HEIGHT_M] else 0.0
    both += _probe_m(guidance, orders, height_m)
    guidance[LEFT_M] = clipped(max(-differential, 0.0) + both, 0.0, orders[LIMIT_LEFT_M])
    guidance[RIGHT_M] = clipped(max(differential, 0.0) + both, 0.0, orders[LIMIT_RIGHT_M])
    guidance[QUIET_LEFT_MS] = 0.0 if guidance[LEFT_M] >= PROBE_ENOUGH_M else guidance[QUIET_LEFT_MS] + PERIOD_MS
    guidance[QUIET_RIGHT_MS] = 0.0 if guidance[RIGHT_M] >= PROBE_ENOUGH_M else guidance[QUIET_RIGHT_MS] + PERIOD_MS


@plant_kernel
def _probe_m(guidance: NDArray[np.float64], orders: NDArray[np.float64], height_m: float) -> float:
    """Pull on both toggles, m, that shows whether a side long unused still works."""
    quiet = max(guidance[QUIET_LEFT_MS], guidance[QUIET_RIGHT_MS])
    if orders[PROBE] != 0.0 and guidance[PULSE_MS] <= 0.0 and quiet > PROBE_QUIET_MS and height_m > PROBE_HEIGHT_M:
        guidance[PULSE_MS] = PROBE_PULSE_MS
    if guidance[PULSE_MS] <= 0.0:
        return 0.0
    guidance[PULSE_MS] -= PERIOD_MS
    return PROBE_PULL_M


@plant_kernel
def guide(
    guidance: NDArray[np.float64],
    orders: NDArray[np.float64],
    limit: NDArray[np.float64],
    estimate: NDArray[np.float64],
    forecast: NDArray[np.float64],
    north_m: float,
    east_m: float,
    height_m: float,
    home_altitude_m: float,
    sink_m_s: float,
) -> None:
    """One step of guidance, at a GPS fix; changes guidance, (GUIDANCE,), in place.

    estimate: the navigation filter's, after this fix; north_m, east_m: measured, from the target; height_m above it,
    > 0; sink_m_s: measured vertical speed, positive down.
    """
    guidance[SINK_M_S] += 0.01 * (sink_m_s - guidance[SINK_M_S])
    half_altitude = home_altitude_m + 0.5 * height_m
    # speeds in the air below are lower than here: mean over the way down, taken at half height
    mean_factor = math.sqrt(density_kg_m3(home_altitude_m + height_m) / density_kg_m3(half_altitude))
    time_to_go_s = height_m / max(guidance[SINK_M_S] * mean_factor, 2.0)
    airspeed_m_s = estimate[AIRSPEED] * mean_factor
    share = time_to_go_s * nominal_sink_m_s(half_altitude) / height_m
    drift_north = forecast_at(forecast, DRIFT_NORTH, height_m) * share
    drift_east = forecast_at(forecast, DRIFT_EAST, height_m) * share
    drift_north += 0.85 * (estimate[ESTIMATED_NORTH] - forecast_at(forecast, FORECAST_NORTH, height_m)) * time_to_go_s
    drift_east += 0.85 * (estimate[ESTIMATED_EAST] - forecast_at(forecast, FORECAST_EAST, height_m)) * time_to_go_s
    aim_north = -north_m - drift_north
    aim_east = -east_m - drift_east
    distance = math.sqrt(aim_north * aim_north + aim_east * aim_east)
    bearing = math.atan2(aim_east, aim_north)
    glide_ratio = distance / max(airspeed_m_s * time_to_go_s, 1.0)

    direction = allowed_direction(orders)
    if direction != 0.0:
        off = wrap_pi(bearing - estimate[HEADING])
        wanted = bearing
        rate = _one_sided_rate(guidance, limit, direction, distance, off, glide_ratio, estimate[AIRSPEED], time_to_go_s)
    else:
        wanted = _s_turn_heading(guidance, orders, limit, estimate, aim_north, aim_east, airspeed_m_s, time_to_go_s)
        rate = 0.40 * wrap_pi(wanted - estimate[HEADING])
    _pull(guidance, orders, limit, direction, rate, estimate[HEADING_RATE], height_m)

    guidance[WANTED_RAD] = wrap_pi(wanted)
    guidance[SPARE_HEIGHT_M] = height_m * (1.0 - glide_ratio)


@plant_kernel
def glide_blind(guidance: NDArray[np.float64], limit: NDArray[np.float64], height_m: float) -> None:
    """Without GPS for a while: toggles up, straight on, flare as ever."""
    both = limit[FLARE_M] if height_m < limit[FLARE_HEIGHT_M] else 0.0
    guidance[TURN_COMMAND_RAD_S] = 0.0
    guidance[INTEGRAL_M] = 0.0
    guidance[LEFT_M] = both
    guidance[RIGHT_M] = both
