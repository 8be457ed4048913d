"""Our monitor of the parafoil: envelopes of the motors and a multiple-model CUSUM of the turns, whatever fires first.

The class holds the arrays; the rest are kernels (fdi/kernel.py) over one flight, so that a flight has the same bits alone
and in company, in plain Python and compiled.  Source: docs/parafoil_method.md, "Ours".
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.kernel import Compiler, compiled, kernel
from fdi.parafoil.config import Config, GpsBank, GyroBank
from fdi.parafoil.hypotheses import (
    GPS_STATES,
    GYRO_STATES,
    HEALTHY,
    HYPOTHESES,
    LINEAR_STATES,
    WIND_EAST,
    WIND_NORTH,
    ColouredError,
    GpsFilter,
    GyroFilter,
)
from fdi.parafoil.motors import (
    MOTOR,
    OUTSIDE_AGO,
    OUTSIDE_M,
    ROWS_KEPT,
    SINCE_ROWS,
    STANDING,
    VALUE_M,
    MotorFigures,
    keep,
    start_motor,
    step_motor,
)
from fdi.parafoil.tables import CHANNELS, LIMITS, PARAMETERS, RESIDUALS, SIGNALS
from fdi.parafoil.turns import (
    ALARM_ROWS,
    BANKS,
    CLIPPED,
    CLOCKS,
    CONFIDENCE,
    FILTERS,
    GPS,
    GYRO,
    KNOWN,
    LEARNT,
    MODE,
    MODE_ROWS,
    NO_ALARM,
    NOTED,
    ONSET_ROWS,
    ROWS_ABOVE,
    SUM_AT_NAMING,
    SUMS,
    WARM_UP_GPS,
    WARM_UP_GYRO,
    Bank,
    Level,
    TurnFigures,
    Turns,
    begin_again,
    decide_turns,
    hear_gps,
    hear_gyro,
    leader,
    note,
    start_gps,
    start_gyro,
    start_turns,
    step_responses,
    turn_steadily,
)
from fdi.reach import lag_share
from fdi.verdict import NO_FAULT, Phase, Verdict

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

STAMP_TOLERANCE_S = 5e-7  # half the resolution of a stamp
OLDEST_S = 1e6  # no sample is held for longer; its rows can be counted
WARMING_PHASE, HEALTHY_PHASE = float(Phase.WARMING), float(Phase.HEALTHY)  # kernels know numbers only
DETECTED_PHASE, ISOLATED_PHASE = float(Phase.DETECTED), float(Phase.ISOLATED)

_AT = {name: index for index, name in enumerate(CHANNELS)}
ARMED = _AT["armed"]
NORTH, EAST, ALTITUDE = _AT["velocity_north_m_s"], _AT["velocity_east_m_s"], _AT["altitude_m"]
OUTPUT_1, ENCODER_1 = _AT["output_1_us"], _AT["wheel_distance_1_m"]
YAW_RATE, PITCH_RATE = _AT["yaw_rate_rad_s"], _AT["pitch_rate_rad_s"]
ROLL, PITCH = _AT["roll_rad"], _AT["pitch_rad"]
TURN_COMMAND = _AT["turn_rate_command_rad_s"]
WIND_SPEED, WIND_DIRECTION = _AT["wind_speed_m_s"], _AT["wind_direction_rad"]

# columns of the marks, (MARKS,)
(
    RUNNING,
    UNSETTLED,  # started without a forecast, wind not yet found
    FUNCTION_1,
    FUNCTION_2,
    FORECAST_NORTH,
    FORECAST_EAST,
    FIX_AGO_S,
    TURN_AGO_S,  # since the turn rate was measured
    LINES_AGO_S,  # since both encoders were known
    SCALE,  # of turn rates, for the density of the air
) = range(10)
MARKS = 10

# columns of the verdict's numbers, (NUMBERS,)
PHASE, FAULT, CONFIDENT, SIZE, ONSET = range(5)
NUMBERS = 5


class Figures(NamedTuple):
    """Every number of the configuration, as the kernels take them."""

    use_gyro: bool
    period_s: float
    gap_s: float
    function_left: float
    function_right: float
    pulses: tuple[float, float, float]  # of a released toggle, us; line per pulse, m/us; travel, m
    limits: FloatArray  # (channel, 2): what lies beyond is unknown
    airspeed_m_s: float
    reference_density_kg_m3: float
    forecast_variance: float
    calm_variance: float
    airspeed_variance: float
    heading_variance: float
    settled_variance: float
    turn_gain: float  # rad/s per metre of line, held
    motor_confidence: float
    motor: MotorFigures
    turns: TurnFigures


class State(NamedTuple):
    """All that the next row depends on; every array begins with the axis of flights."""

    marks: FloatArray  # (flight, MARKS)
    motors: FloatArray  # (flight, 2, MOTOR), by output
    kept: FloatArray  # (flight, 2, 2, ROWS_KEPT): commands and encoder, by output
    turns: Turns


@kernel
def density_kg_m3(altitude_m: float) -> float:
    """Of the standard atmosphere; as fdi/atmosphere.py, for one number."""
    return 1.225 * math.exp(4.2559 * math.log(max(1.0 - 2.25577e-5 * altitude_m, 0.1)))


@kernel
def is_known(values: FloatArray, age_s: FloatArray, channel: int, limits: FloatArray) -> bool:
    """A value within its limits, (channel, 2), however old, and not from the future; NaN is none."""
    return bool(limits[channel, 0] <= values[channel] <= limits[channel, 1]) and bool(0.0 <= age_s[channel] <= OLDEST_S)


@kernel
def is_fresh(values: FloatArray, age_s: FloatArray, channel: int, limits: FloatArray, period_s: float) -> bool:
    """A value of this very row."""
    return is_known(values, age_s, channel, limits) and bool(age_s[channel] < period_s - STAMP_TOLERANCE_S)


@kernel
def pull_m(output_us: float, zero_us: float, pull_m_per_us: float, travel_m: float) -> float:
    """The line that a pulse asks for, m."""
    return min(max((output_us - zero_us) * pull_m_per_us, 0.0), travel_m)


@kernel
def is_swapped(marks: FloatArray, left: float, right: float) -> bool:
    """Is the function of the left toggle on output 2?  left, right: the values of both functions."""
    return bool(marks[FUNCTION_1] == right and marks[FUNCTION_2] == left)


@kernel
def is_assigned(marks: FloatArray, left: float, right: float) -> bool:
    """One output left, the other right, whichever."""
    return is_swapped(marks, left, right) or bool(marks[FUNCTION_1] == left and marks[FUNCTION_2] == right)


@kernel
def reset(state: State, f: int, figures: Figures) -> None:
    """Back to before release; what was told of the outputs stays."""
    marks = state.marks[f]
    marks[RUNNING] = 0.0
    marks[UNSETTLED] = 0.0
    marks[FORECAST_NORTH] = math.nan
    marks[FORECAST_EAST] = math.nan
    marks[FIX_AGO_S] = math.inf
    marks[TURN_AGO_S] = math.inf
    marks[LINES_AGO_S] = math.inf
    marks[SCALE] = 1.0
    for output in range(2):
        start_motor(state.motors[f, output], state.kept[f, output], 0.0, 0.0)
    start_turns(state.turns, f, figures.turns)


@kernel
def arm(state: State, f: int, values: FloatArray, age_s: FloatArray, figures: Figures) -> bool:
    """Begin with release, end with touchdown, remember the forecast; -> whether there is something to judge."""
    limits = figures.limits
    marks = state.marks[f]
    heard = is_known(values, age_s, ARMED, limits)
    if heard and values[ARMED] <= 0.5:
        if marks[RUNNING] > 0.0:
            reset(state, f, figures)
    elif heard and marks[RUNNING] == 0.0:
        marks[RUNNING] = 1.0
        for output in range(2):
            low_m, high_m = 0.0, figures.motor.travel_m  # in flight a spool may be anywhere, also far from its command
            if is_fresh(values, age_s, ENCODER_1 + output, limits, figures.period_s):
                low_m = values[ENCODER_1 + output]
                high_m = low_m
            start_motor(state.motors[f, output], state.kept[f, output], low_m, high_m)
    # After release the vehicle reports its own estimate, no longer the forecast: the first value is kept.
    wind = is_known(values, age_s, WIND_SPEED, limits) and is_known(values, age_s, WIND_DIRECTION, limits)
    if wind and math.isinf(marks[FIX_AGO_S]) and (marks[RUNNING] == 0.0 or math.isnan(marks[FORECAST_NORTH])):
        marks[FORECAST_NORTH] = -values[WIND_SPEED] * math.cos(values[WIND_DIRECTION])
        marks[FORECAST_EAST] = -values[WIND_SPEED] * math.sin(values[WIND_DIRECTION])
    return heard and marks[RUNNING] > 0.0


@kernel
def watch_motors(state: State, f: int, values: FloatArray, age_s: FloatArray, figures: Figures) -> None:
    """This row's commands and encoders to the envelopes."""
    limits = figures.limits
    for output in range(2):
        for kind in range(2):
            channel = (OUTPUT_1 if kind == 0 else ENCODER_1) + output
            value, rows = math.nan, 0.0
            if is_known(values, age_s, channel, limits):
                value = pull_m(values[channel], *figures.pulses) if kind == 0 else values[channel]
                rows = math.floor((age_s[channel] + STAMP_TOLERANCE_S) / figures.period_s)
            keep(state.kept[f, output, kind], value, rows)
        step_motor(state.motors[f, output], state.kept[f, output], figures.motor)


@kernel
def move_lines(state: State, f: int, values: FloatArray, age_s: FloatArray, figures: Figures) -> None:
    """All responses one row on, with the encoders by function; held ones for as long as a gap may last."""
    limits = figures.limits
    marks = state.marks[f]
    oldest_s = 0.0
    for output in range(2):
        known = is_known(values, age_s, ENCODER_1 + output, limits)
        oldest_s = max(oldest_s, age_s[ENCODER_1 + output] if known else math.inf)
    marks[LINES_AGO_S] += figures.period_s
    if oldest_s > figures.gap_s + STAMP_TOLERANCE_S:
        return
    if marks[LINES_AGO_S] > figures.gap_s + figures.period_s:
        turn_steadily(state.turns, f, figures.turns, 0.0)
        state.turns.clocks[f, WARM_UP_GPS] = figures.turns.warm_up_rows
        state.turns.clocks[f, WARM_UP_GYRO] = figures.turns.warm_up_rows
    marks[LINES_AGO_S] = 0.0
    swapped = is_swapped(state.marks[f], figures.function_left, figures.function_right)
    left, right = (ENCODER_1 + 1, ENCODER_1) if swapped else (ENCODER_1, ENCODER_1 + 1)
    step_responses(state.turns, f, figures.turns, values[left], values[right], marks[SCALE])


@kernel
def hear_fix(
    state: State,
    f: int,
    values: FloatArray,
    age_s: FloatArray,
    figures: Figures,
    cross: FloatArray,
    densities: FloatArray,
) -> None:
    """A new fix, once, with the time since the one before; the first one, and one behind a gap, begins anew."""
    limits = figures.limits
    marks = state.marks[f]
    marks[FIX_AGO_S] += figures.period_s
    if is_known(values, age_s, ALTITUDE, limits):
        marks[SCALE] = math.sqrt(figures.reference_density_kg_m3 / density_kg_m3(values[ALTITUDE]))
    elif math.isinf(marks[FIX_AGO_S]):
        return
    if not (
        is_fresh(values, age_s, NORTH, limits, figures.period_s) and is_fresh(values, age_s, EAST, limits, figures.period_s)
    ):
        return
    elapsed_s = marks[FIX_AGO_S] - age_s[NORTH]
    if elapsed_s <= STAMP_TOLERANCE_S:
        return
    nominal_m_s = figures.airspeed_m_s * marks[SCALE]
    if elapsed_s > figures.gap_s + STAMP_TOLERANCE_S:
        _first_fix(state, f, figures, values[NORTH], values[EAST], nominal_m_s)
    else:
        hear_gps(
            state.turns,
            f,
            figures.turns,
            cross,
            densities,
            elapsed_s,
            values[NORTH],
            values[EAST],
            nominal_m_s,
            marks[SCALE],
        )
    marks[FIX_AGO_S] = age_s[NORTH]
    if marks[UNSETTLED] > 0.0:
        covariance = state.turns.gps_covariance[f, KNOWN]
        limit = figures.settled_variance
        if covariance[WIND_NORTH, WIND_NORTH] < limit and covariance[WIND_EAST, WIND_EAST] < limit:
            marks[UNSETTLED] = 0.0


@kernel
def _first_fix(state: State, f: int, figures: Figures, north_m_s: float, east_m_s: float, nominal_m_s: float) -> None:
    marks = state.marks[f]
    known = state.turns.gps_mean[f, KNOWN]
    if math.isfinite(marks[FIX_AGO_S]):  # behind a gap: the wind found before it
        wind_north, wind_east = known[WIND_NORTH], known[WIND_EAST]
    elif math.isnan(marks[FORECAST_NORTH]):
        marks[UNSETTLED] = 1.0
        wind_north, wind_east = 0.0, 0.0
    else:
        wind_north, wind_east = marks[FORECAST_NORTH], marks[FORECAST_EAST]
    variance = figures.calm_variance if marks[UNSETTLED] > 0.0 else figures.forecast_variance
    heading_rad = math.atan2(east_m_s - wind_east, north_m_s - wind_north)
    start_gps(
        state.turns,
        f,
        figures.turns,
        wind_north,
        wind_east,
        variance,
        nominal_m_s,
        figures.airspeed_variance,
        heading_rad,
        figures.heading_variance,
    )


@kernel
def turn_rate_rad_s(values: FloatArray) -> float:
    """Rate of the yaw angle from body rates and attitude."""
    roll, pitch = values[ROLL], values[PITCH]
    return float((values[PITCH_RATE] * math.sin(roll) + values[YAW_RATE] * math.cos(roll)) / math.cos(pitch))


@kernel
def hear_attitude(
    state: State,
    f: int,
    values: FloatArray,
    age_s: FloatArray,
    figures: Figures,
    cross: FloatArray,
    densities: FloatArray,
) -> None:
    """A new turn rate, once; the first one, and one behind a gap, begins anew."""
    limits = figures.limits
    marks = state.marks[f]
    marks[TURN_AGO_S] += figures.period_s
    for channel in (YAW_RATE, PITCH_RATE, ROLL, PITCH):
        if not is_fresh(values, age_s, channel, limits, figures.period_s):
            return
    elapsed_s = marks[TURN_AGO_S] - age_s[YAW_RATE]
    if elapsed_s <= STAMP_TOLERANCE_S or math.isinf(marks[FIX_AGO_S]):
        return
    if elapsed_s > figures.gap_s + STAMP_TOLERANCE_S:
        start_gyro(state.turns, f, figures.turns)
    else:
        turn = turn_rate_rad_s(values)
        hear_gyro(state.turns, f, figures.turns, cross, densities, elapsed_s, turn, marks[SCALE])
    marks[TURN_AGO_S] = age_s[YAW_RATE]


@kernel
def judging_bank(marks: FloatArray, use_gyro: bool, gap_s: float) -> int:
    """The bank whose word counts: the gyro's where it is wanted and there, else that of GPS."""
    return GYRO if use_gyro and marks[TURN_AGO_S] <= gap_s + STAMP_TOLERANCE_S else GPS


@kernel
def can_judge(state: State, f: int, figures: Figures) -> bool:
    """Fixes and encoders flow, the wind is found, the outputs are assigned, and the warm-up is over."""
    marks, clocks = state.marks[f], state.turns.clocks[f]
    oldest_s = figures.gap_s + STAMP_TOLERANCE_S
    flowing = marks[FIX_AGO_S] <= oldest_s and marks[LINES_AGO_S] <= oldest_s
    warm = clocks[WARM_UP_GPS] <= 0.0 and (
        judging_bank(state.marks[f], figures.use_gyro, figures.gap_s) == GPS or clocks[WARM_UP_GYRO] <= 0.0
    )
    return (
        flowing
        and warm
        and marks[UNSETTLED] == 0.0
        and is_assigned(state.marks[f], figures.function_left, figures.function_right)
    )


@kernel
def conclude(state: State, f: int, figures: Figures, judged: bool, numbers: FloatArray, residuals: FloatArray) -> None:
    """The row's verdict: the newest fault that stands, else an alarm, else that all is well; residuals beside it."""
    clocks = state.turns.clocks[f]
    mode = int(clocks[MODE])
    numbers[FAULT] = NO_FAULT
    numbers[CONFIDENT] = 0.0
    numbers[SIZE] = math.nan
    numbers[ONSET] = math.nan
    since_rows = math.inf
    for output in range(2):
        motor = state.motors[f, output]
        if motor[STANDING] > 0.0 and motor[SINCE_ROWS] < since_rows:
            since_rows = motor[SINCE_ROWS]
            numbers[FAULT] = output
            numbers[CONFIDENT] = figures.motor_confidence
            numbers[SIZE] = motor[VALUE_M]
            numbers[ONSET] = motor[SINCE_ROWS] * figures.period_s
    if mode != HEALTHY and clocks[MODE_ROWS] < since_rows:
        numbers[FAULT] = mode + 1  # behind both motors in the table
        numbers[CONFIDENT] = clocks[CONFIDENCE]
        numbers[SIZE] = math.nan
        numbers[ONSET] = (clocks[MODE_ROWS] + clocks[ONSET_ROWS]) * figures.period_s
    bank = judging_bank(state.marks[f], figures.use_gyro, figures.gap_s)
    if numbers[FAULT] != NO_FAULT:
        numbers[PHASE] = ISOLATED_PHASE
    elif not judged:
        numbers[PHASE] = WARMING_PHASE
    elif clocks[ALARM_ROWS] != NO_ALARM:
        numbers[PHASE] = DETECTED_PHASE
        best, _ = leader(state.turns.sums[f, bank], mode)
        numbers[ONSET] = state.turns.sums[f, bank, ROWS_ABOVE, best] * figures.period_s
    else:
        numbers[PHASE] = HEALTHY_PHASE
    for output in range(2):
        motor = state.motors[f, output]
        known = motor[OUTSIDE_AGO] * figures.period_s <= figures.gap_s + STAMP_TOLERANCE_S
        residuals[1 + output] = motor[OUTSIDE_M] if known else math.nan
    _turn_residuals(state, f, bank, judged, residuals)


@kernel
def _turn_residuals(state: State, f: int, bank: int, judged: bool, residuals: FloatArray) -> None:
    """What speaks for each fault: its clipped sum; of the one named the sum at the naming less what spoke against it since.

    That of the healthy hypothesis, what speaks against it, is the largest of them.
    """
    clocks, sums = state.turns.clocks[f], state.turns.sums[f, bank]
    mode = int(clocks[MODE])
    residuals[0] = 0.0 if judged else math.nan
    for i in range(1, HYPOTHESES):
        speaks_for = max(sums[CLIPPED, i], 0.0)
        if i == mode:
            speaks_for = max(clocks[SUM_AT_NAMING] - max(sums[CLIPPED, HEALTHY], 0.0), 0.0)
        residuals[2 + i] = speaks_for if judged else math.nan
        if judged:
            residuals[0] = max(residuals[0], speaks_for)


@kernel
def wait(state: State, f: int, figures: Figures) -> None:
    """A row in which nothing enters: not armed, or not known whether; in flight the spools move on all the same."""
    marks = state.marks[f]
    marks[FIX_AGO_S] += figures.period_s
    marks[TURN_AGO_S] += figures.period_s
    marks[LINES_AGO_S] += figures.period_s
    if marks[RUNNING] > 0.0:
        state.turns.clocks[f, MODE_ROWS] += 1.0
        for output in range(2):
            for kind in range(2):
                keep(state.kept[f, output, kind], math.nan, 0.0)
            step_motor(state.motors[f, output], state.kept[f, output], figures.motor)


@kernel
def step_flight(
    state: State,
    f: int,
    values: FloatArray,
    age_s: FloatArray,
    figures: Figures,
    cross: FloatArray,
    densities: FloatArray,
    numbers: FloatArray,
    residuals: FloatArray,
) -> None:
    """One row of one flight."""
    judged = False
    if arm(state, f, values, age_s, figures):
        watch_motors(state, f, values, age_s, figures)
        move_lines(state, f, values, age_s, figures)
        hear_fix(state, f, values, age_s, figures, cross, densities)
        hear_attitude(state, f, values, age_s, figures, cross, densities)
        clocks = state.turns.clocks[f]
        clocks[MODE_ROWS] += 1.0
        judged = can_judge(state, f, figures)
        if judged:
            decide_turns(state.turns, f, figures.turns, judging_bank(state.marks[f], figures.use_gyro, figures.gap_s))
            note(state.turns, f, figures.turns)
        clocks[WARM_UP_GPS] = max(clocks[WARM_UP_GPS] - 1.0, 0.0)
        clocks[WARM_UP_GYRO] = max(clocks[WARM_UP_GYRO] - 1.0, 0.0)
    else:
        wait(state, f, figures)
    conclude(state, f, figures, judged, numbers, residuals)


@kernel
def step_flights(
    state: State,
    values: FloatArray,
    age_s: FloatArray,
    figures: Figures,
    cross: FloatArray,
    densities: FloatArray,
    numbers: FloatArray,
    residuals: FloatArray,
    signals: FloatArray,
) -> None:
    """One row of all flights; numbers (flight, NUMBERS), residuals and signals (flight, ...) are filled."""
    for f in range(values.shape[0]):
        step_flight(state, f, values[f], age_s[f], figures, cross, densities, numbers[f], residuals[f])
        tell_signals(state, f, values[f], age_s[f], figures, signals[f])


@kernel
def tell_signals(state: State, f: int, values: FloatArray, age_s: FloatArray, figures: Figures, signals: FloatArray) -> None:
    """Turn rate as commanded and as flown, rad/s; NaN where unknown."""
    limits = figures.limits
    signals[0] = math.nan
    if is_known(values, age_s, TURN_COMMAND, limits):
        signals[0] = values[TURN_COMMAND]
    elif (
        is_assigned(state.marks[f], figures.function_left, figures.function_right)
        and is_known(values, age_s, OUTPUT_1, limits)
        and is_known(values, age_s, OUTPUT_1 + 1, limits)
    ):
        first_m, second_m = pull_m(values[OUTPUT_1], *figures.pulses), pull_m(values[OUTPUT_1 + 1], *figures.pulses)
        signals[0] = figures.turn_gain * (
            first_m - second_m
            if is_swapped(state.marks[f], figures.function_left, figures.function_right)
            else second_m - first_m
        )
    signals[1] = math.nan
    for channel in (YAW_RATE, PITCH_RATE, ROLL, PITCH):
        if not is_known(values, age_s, channel, limits):
            return
    signals[1] = turn_rate_rad_s(values)


@kernel
def take_functions(state: State, f: int, figures: Figures) -> None:
    """The outputs have other functions now: turns are judged anew, from the turn that is being flown.

    Motors stay as they are, they go by output.  A swap is taken as the mending of crossed lines.
    """
    begin_again(state.turns, f, figures.turns, 1.0 / state.marks[f, SCALE])


def figures_of(config: Config) -> Figures:
    """The configuration as the kernels take it."""
    envelope, motor, turns, navigation = config.envelope, config.motor, config.turns, config.navigation
    period_s = config.period_s

    def extreme(rate_factor: float, lag_factor: float) -> tuple[float, float]:
        return lag_share(period_s, motor.lag_s * lag_factor), motor.rate_m_s * rate_factor * period_s

    def bank(table: GpsBank | GyroBank) -> tuple[ColouredError, Bank]:
        error = ColouredError(table.coloured_time_s, table.coloured_rad_s, table.coloured_per_change)
        return error, Bank(table.threshold, table.margin)

    gps_error, gps_bank = bank(turns.gps)
    gyro_error, gyro_bank = bank(turns.gyro)
    model = config.lateral_model
    steady = -np.linalg.solve(np.array(model.dynamics), np.array(model.input))  # state per metre held for ever
    gain = float(np.array(model.output) @ steady)
    limits = np.array([LIMITS[name] for name in CHANNELS])
    return Figures(
        use_gyro=config.detector == "gyro",
        period_s=period_s,
        gap_s=config.gap_s,
        function_left=float(config.outputs.function_left),
        function_right=float(config.outputs.function_right),
        pulses=(config.outputs.zero_us, config.outputs.pull_m_per_us, motor.travel_m),
        limits=limits,
        airspeed_m_s=navigation.airspeed_m_s,
        reference_density_kg_m3=navigation.reference_density_kg_m3,
        forecast_variance=navigation.start_wind_variance_m2_s2,
        calm_variance=navigation.start_calm_variance_m2_s2,
        airspeed_variance=navigation.start_airspeed_variance_m2_s2,
        heading_variance=navigation.start_heading_variance_rad2,
        settled_variance=config.settled_wind_variance_m2_s2,
        turn_gain=gain,
        motor_confidence=envelope.confidence,
        motor=MotorFigures(
            period_s=period_s,
            travel_m=motor.travel_m,
            slow=extreme(envelope.slowest_rate_factor, envelope.slowest_lag_factor),
            fast=extreme(envelope.fastest_rate_factor, envelope.fastest_lag_factor),
            tolerance_m=envelope.tolerance_m,
            rows_outside=envelope.samples_outside,
            settle_rows=envelope.settle_s / period_s,
            moved_m=envelope.moved_m,
            commanded_m=envelope.commanded_m,
            commanded_rows=envelope.commanded_s / period_s,
            clear_rows=envelope.clear_s / period_s,
        ),
        turns=TurnFigures(
            period_s=period_s,
            transition=np.array(config.response.transition),
            held_input=np.array(config.response.input),
            heading_output=np.array(model.output),
            yaw_output=np.array([0.0, 0.0, 0.0, 1.0]),
            steady_turn=steady / gain,
            slack_m=turns.slack_m,
            curvature_per_m=turns.curvature_per_m,
            gps=GpsFilter(
                navigation.airspeed_relaxation_s,
                turns.gps.wind_noise_m_s_sqrt_s,
                navigation.airspeed_noise_m_s_sqrt_s,
                turns.gps.velocity_noise_m_s,
                turns.gps.bias_noise_rad_s_sqrt_s,
                gps_error,
            ),
            gyro=GyroFilter(turns.gyro.rate_noise_rad_s, turns.gyro.bias_noise_rad_s_sqrt_s, gyro_error),
            gps_bank=gps_bank,
            gyro_bank=gyro_bank,
            agreement=turns.gyro.agreement,
            clip=turns.clip,
            drift=turns.drift,
            floor=turns.floor,
            whole_clip=turns.whole_clip,
            surest=turns.surest,
            hold_rows=turns.hold_s / period_s,
            warm_up_rows=config.warm_up_s / period_s,
            noted_rows=turns.noted_s / period_s,
            bias_prior_rad_s=turns.bias_prior_rad_s,
            effectiveness_prior=turns.effectiveness_prior,
            bias_limit_rad_s=turns.bias_limit_rad_s,
            effectiveness_limit=turns.effectiveness_limit,
            bias_floor_rad_s=turns.bias_floor_rad_s,
            effectiveness_floor=turns.effectiveness_floor,
            level=Level(turns.level_s, turns.level_clip, turns.level_squared, turns.level_limit),
            calm=turns.calm,
            usual_factor=turns.usual_factor,
            usual_kept=math.exp(-turns.noted_s / turns.usual_s),
        ),
    )


class MultipleModel:
    """Our monitor over a batch of flights; one row of the grid a step.

    `Verdict.confidence` of a line fault is its posterior probability among the hypotheses, each as likely before, as
    far as the models are right; of a motor a number of the configuration; 0 while
    none is named.  `size` is where a motor is stuck, or its limit, m.  `onset_s` of a line fault counts from the last
    moment at which nothing spoke for it, of a motor from the first reading that it could not have.
    """

    def __init__(self, config: Config, flights: int, compiler: Compiler | None = None) -> None:
        """flights: length of the batch's leading axis; compiler: such as numba.njit, None: plain Python.

        Raises ValueError if flights is below 1.
        """
        if flights < 1:
            raise ValueError(f"flights = {flights}: a batch has at least one flight")
        self.config = config
        self.flights = flights
        self._figures = figures_of(config)
        self._step = step_flights if compiler is None else compiled(step_flights, compiler)
        n = flights
        self._state = State(
            np.zeros((n, MARKS)),
            np.zeros((n, 2, MOTOR)),
            np.zeros((n, 2, 2, ROWS_KEPT)),
            Turns(
                np.zeros((n, BANKS, HYPOTHESES, LINEAR_STATES)),
                np.zeros((n, FILTERS, GPS_STATES)),
                np.zeros((n, FILTERS, GPS_STATES, GPS_STATES)),
                np.zeros((n, FILTERS, GYRO_STATES)),
                np.zeros((n, FILTERS, GYRO_STATES, GYRO_STATES)),
                np.zeros((n, BANKS, SUMS, HYPOTHESES)),
                np.zeros((n, BANKS, NOTED + 1, LEARNT)),
                np.zeros((n, HYPOTHESES + 1)),
                np.zeros((n, BANKS, 2)),
                np.zeros((n, CLOCKS)),
            ),
        )
        self._state.marks[:, FUNCTION_1] = self._figures.function_left  # until told: the normal assignment
        self._state.marks[:, FUNCTION_2] = self._figures.function_right
        for f in range(n):
            reset(self._state, f, self._figures)
        self._cross = np.zeros(GPS_STATES + 1)
        self._densities = np.zeros(FILTERS)
        turns = config.turns
        bank = turns.gyro if config.detector == "gyro" else turns.gps
        tolerance_m = config.envelope.tolerance_m
        self._thresholds = np.array([bank.threshold, tolerance_m, tolerance_m, *(bank.threshold,) * 3])

    def _arrays(self) -> dict[str, FloatArray]:
        state = self._state
        return {"marks": state.marks, "motors": state.motors, "kept": state.kept, **state.turns._asdict()}

    @property
    def state(self) -> dict[str, FloatArray]:
        """Everything the next step depends on: copies, (flight, ...), by name.  Assigning such a dict resumes there.

        Assigning a dict with other names or shapes raises ValueError.
        """
        return {name: array.copy() for name, array in self._arrays().items()}

    @state.setter
    def state(self, state: Mapping[str, FloatArray]) -> None:
        arrays = self._arrays()
        if {name: array.shape for name, array in state.items()} != {name: array.shape for name, array in arrays.items()}:
            raise ValueError("the state is not one of this monitor: names or shapes differ")
        for name, array in arrays.items():
            array[...] = state[name]

    def told(self, flight: int, parameters: Mapping[str, float]) -> None:
        """Take note of the output functions that the vehicle itself reports; both, or the one that is known."""
        functions = self._state.marks[flight, FUNCTION_1 : FUNCTION_2 + 1]
        told = np.array([parameters.get(name, functions[i]) for i, name in enumerate(PARAMETERS)])
        if np.array_equal(told, functions, equal_nan=True):
            return
        functions[:] = told
        take_functions(self._state, flight, self._figures)

    def step(self, values: FloatArray, age_s: FloatArray) -> Verdict:
        """Judge one row of the grid: values and age_s, (flight, channel) in the order of CHANNELS.

        A value that is NaN or beyond its limits is unknown.  Raises ValueError on a wrong shape.
        """
        shape = (self.flights, len(CHANNELS))
        if values.shape != shape or age_s.shape != shape:
            raise ValueError(f"values have shape {values.shape}, age_s {age_s.shape}; this monitor takes {shape} of both")
        numbers = np.empty((self.flights, NUMBERS))
        residuals = np.empty((self.flights, len(RESIDUALS)))
        signals = np.empty((self.flights, len(SIGNALS)))
        self._step(self._state, values, age_s, self._figures, self._cross, self._densities, numbers, residuals, signals)
        return Verdict(
            phase=numbers[:, PHASE].astype(np.int64),
            fault=numbers[:, FAULT].astype(np.int64),
            confidence=numbers[:, CONFIDENT].copy(),
            size=numbers[:, SIZE].copy(),
            onset_s=numbers[:, ONSET].copy(),
            residuals=residuals,
            thresholds=self._thresholds.copy(),
            signals=signals,
        )
