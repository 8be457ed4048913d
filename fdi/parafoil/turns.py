"""The turn monitor: multiple-model CUSUM with a common restart, on GPS velocity and on the gyro.

Kernels (fdi/kernel.py) over one flight.  Every hypothesis predicts how the vehicle turns; sums of clipped log likelihood
ratios against the mode that is believed (healthy, until another is named) say which predicts best.  Whenever no sum is
above zero all begin anew together from what an uninterrupted filter of the believed mode knows, its bias and
effectiveness as they were half a minute ago: a filter that has just begun to explain a fault away must not hand that on.
A named fault becomes the believed mode and is itself tested against the others, so that a wrong name is taken back.
Source: docs/parafoil_method.md, "Ours".
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.kernel import kernel
from fdi.parafoil.hypotheses import (
    AIRSPEED,
    BIAS,
    COLOURED,
    CROSSED,
    EFFECTIVENESS,
    GPS_STATES,
    GYRO_BIAS,
    GYRO_COLOURED,
    GYRO_EFFECTIVENESS,
    GYRO_STATES,
    HEADING,
    HEALTHY,
    HYPOTHESES,
    LINEAR_STATES,
    WIND_EAST,
    WIND_NORTH,
    GpsFilter,
    GyroFilter,
    correct_gps,
    line_effect,
    line_input,
    predict_gps,
    step_gyro,
    step_response,
    turn_output,
)

FloatArray = NDArray[np.float64]

GPS, GYRO = 0, 1  # the banks
BANKS = 2
KNOWN = HYPOTHESES  # place of the uninterrupted filter among the filters of a bank
FILTERS = HYPOTHESES + 1
CLIPPED, WHOLE, ROWS_ABOVE = range(3)  # sums of a hypothesis, and the rows since the clipped one left zero
SUMS = 3
NOTED = 6  # values of bias and effectiveness that are kept; behind them the reference
LEARNT_BIAS, LEARNT_SHARE, DEVIATION_BIAS, DEVIATION_SHARE, LEARNT_LEVEL, LEARNT_PEAK = range(6)
LEARNT = 6
BEFORE_MODE, BEFORE_CROSSING = range(2)  # responses at the last measurement

# columns of the clocks, (CLOCKS,)
(
    MODE,  # the hypothesis that is believed
    MODE_ROWS,  # since then
    ALARM_ROWS,  # since an alarm that is not yet named
    NOTED_ROWS,
    WARM_UP_GPS,  # rows still to wait
    WARM_UP_GYRO,
    CONFIDENCE,  # of the last naming
    ONSET_ROWS,  # how long ago it had begun
    SUM_AT_NAMING,
    LEVEL_GPS,  # of the noise, a variance over the configured one
    LEVEL_GYRO,
    PEAK_GPS,  # largest sum since a value was noted
    PEAK_GYRO,
    USUAL_GPS,  # what the sums reach here while nothing is wrong
    USUAL_GYRO,
) = range(15)
CLOCKS = 15
NO_ALARM = -1.0
EARLY_LEVEL = 2.0  # of the noise, at most, until there is one from before: a fault raises it as well


class Turns(NamedTuple):
    """State of the turn monitor; every array begins with the axis of flights."""

    response: FloatArray  # (flight, BANKS, HYPOTHESES, LINEAR_STATES)
    gps_mean: FloatArray  # (flight, FILTERS, GPS_STATES)
    gps_covariance: FloatArray  # (flight, FILTERS, GPS_STATES, GPS_STATES)
    gyro_mean: FloatArray  # (flight, FILTERS, GYRO_STATES)
    gyro_covariance: FloatArray
    sums: FloatArray  # (flight, BANKS, SUMS, HYPOTHESES)
    learnt: FloatArray  # (flight, BANKS, NOTED + 1, LEARNT): bias, effectiveness and their deviations
    since_fix: FloatArray  # (flight, HYPOTHESES + 1): responses of the GPS bank added up, and how many
    before: FloatArray  # (flight, BANKS, 2)
    clocks: FloatArray  # (flight, CLOCKS)


class Bank(NamedTuple):
    """When a bank alarms and names."""

    threshold: float  # of the clipped sum
    margin: float  # by which the whole sum of the one named leads all others


class Level(NamedTuple):
    """How the level of the noise follows the innovations of the uninterrupted filter."""

    time_s: float
    clip: float  # of a squared normalised innovation
    squared: float  # that leaves the level as it is
    limit: float  # a variance over the configured one


class TurnFigures(NamedTuple):
    """Figures of the turn monitor."""

    period_s: float
    transition: FloatArray  # (LINEAR_STATES, LINEAR_STATES), of one row
    held_input: FloatArray  # (LINEAR_STATES,), per metre
    heading_output: FloatArray  # (LINEAR_STATES,), of the heading of the air velocity
    yaw_output: FloatArray  # of the yaw angle, as a gyro sees it
    steady_turn: FloatArray  # state of a steady turn of 1 rad/s
    slack_m: float
    curvature_per_m: float
    gps: GpsFilter
    gyro: GyroFilter
    gps_bank: Bank
    gyro_bank: Bank
    agreement: float  # lead that the GPS bank must confirm when the gyro names
    clip: float
    drift: float
    floor: float
    whole_clip: float
    surest: float  # no model is surer than this
    hold_rows: float  # from the alarm to the first naming
    warm_up_rows: float
    noted_rows: float  # between two values noted
    bias_prior_rad_s: float
    effectiveness_prior: float  # standard deviation about 1
    bias_limit_rad_s: float
    effectiveness_limit: float
    bias_floor_rad_s: float  # least deviation at a restart
    effectiveness_floor: float
    level: Level
    calm: float  # share of the threshold up to which a sum speaks of nothing: then noise and bias are learnt
    usual_factor: float
    usual_kept: float


@kernel
def clear(matrix: FloatArray, states: int) -> None:
    for i in range(states):
        for j in range(states):
            matrix[i, j] = 0.0


@kernel
def start_turns(turns: Turns, f: int, figures: TurnFigures) -> None:
    """Everything to nothing known."""
    for bank in range(BANKS):
        for i in range(HYPOTHESES):
            for j in range(LINEAR_STATES):
                turns.response[f, bank, i, j] = 0.0
        for i in range(NOTED + 1):
            turns.learnt[f, bank, i, LEARNT_BIAS] = 0.0
            turns.learnt[f, bank, i, LEARNT_SHARE] = 1.0
            turns.learnt[f, bank, i, DEVIATION_BIAS] = figures.bias_prior_rad_s
            turns.learnt[f, bank, i, DEVIATION_SHARE] = figures.effectiveness_prior
            turns.learnt[f, bank, i, LEARNT_LEVEL] = 0.0
            turns.learnt[f, bank, i, LEARNT_PEAK] = 0.0
        turns.before[f, bank, 0] = 0.0
        turns.before[f, bank, 1] = 0.0
    for i in range(FILTERS):
        for j in range(GPS_STATES):
            turns.gps_mean[f, i, j] = 0.0
        for j in range(GYRO_STATES):
            turns.gyro_mean[f, i, j] = 0.0
        clear(turns.gps_covariance[f, i], GPS_STATES)
        clear(turns.gyro_covariance[f, i], GYRO_STATES)
    for i in range(HYPOTHESES + 1):
        turns.since_fix[f, i] = 0.0
    for i in range(CLOCKS):
        turns.clocks[f, i] = 0.0
    turns.clocks[f, ALARM_ROWS] = NO_ALARM
    turns.clocks[f, LEVEL_GPS] = 1.0
    turns.clocks[f, LEVEL_GYRO] = 1.0
    clear_sums(turns.sums[f, GPS])
    clear_sums(turns.sums[f, GYRO])


@kernel
def clear_sums(sums: FloatArray) -> None:
    """Sums of a bank, (SUMS, HYPOTHESES), to zero."""
    for i in range(HYPOTHESES):
        for j in range(SUMS):
            sums[j, i] = 0.0


@kernel
def start_gps(
    turns: Turns,
    f: int,
    figures: TurnFigures,
    wind_north_m_s: float,
    wind_east_m_s: float,
    wind_variance: float,
    airspeed_m_s: float,
    airspeed_variance: float,
    heading_rad: float,
    heading_variance: float,
) -> None:
    """The uninterrupted filter of GPS velocity at a first fix, bias and effectiveness at their reference; a warm-up."""
    mean, covariance = turns.gps_mean[f, KNOWN], turns.gps_covariance[f, KNOWN]
    clear(covariance, GPS_STATES)
    mean[WIND_NORTH] = wind_north_m_s
    mean[WIND_EAST] = wind_east_m_s
    mean[AIRSPEED] = airspeed_m_s
    mean[HEADING] = heading_rad
    covariance[WIND_NORTH, WIND_NORTH] = wind_variance
    covariance[WIND_EAST, WIND_EAST] = wind_variance
    covariance[AIRSPEED, AIRSPEED] = airspeed_variance
    covariance[HEADING, HEADING] = heading_variance
    mean[BIAS] = turns.learnt[f, GPS, NOTED, LEARNT_BIAS]
    mean[EFFECTIVENESS] = turns.learnt[f, GPS, NOTED, LEARNT_SHARE]
    mean[COLOURED] = 0.0
    deviation = figures.gps.coloured.deviation_rad_s * math.sqrt(turns.clocks[f, LEVEL_GPS])
    covariance[COLOURED, COLOURED] = deviation * deviation
    covariance[BIAS, BIAS] = figures.bias_prior_rad_s * figures.bias_prior_rad_s
    covariance[EFFECTIVENESS, EFFECTIVENESS] = figures.effectiveness_prior * figures.effectiveness_prior
    for i in range(HYPOTHESES + 1):
        turns.since_fix[f, i] = 0.0
    turns.clocks[f, WARM_UP_GPS] = figures.warm_up_rows
    restart(turns, f, GPS, figures)


@kernel
def start_gyro(turns: Turns, f: int, figures: TurnFigures) -> None:
    """The uninterrupted filter of the gyro at its first reading; a warm-up."""
    mean, covariance = turns.gyro_mean[f, KNOWN], turns.gyro_covariance[f, KNOWN]
    clear(covariance, GYRO_STATES)
    mean[GYRO_BIAS] = turns.learnt[f, GYRO, NOTED, LEARNT_BIAS]
    mean[GYRO_EFFECTIVENESS] = turns.learnt[f, GYRO, NOTED, LEARNT_SHARE]
    mean[GYRO_COLOURED] = 0.0
    deviation = figures.gyro.coloured.deviation_rad_s * math.sqrt(turns.clocks[f, LEVEL_GYRO])
    covariance[GYRO_COLOURED, GYRO_COLOURED] = deviation * deviation
    covariance[GYRO_BIAS, GYRO_BIAS] = figures.bias_prior_rad_s * figures.bias_prior_rad_s
    covariance[GYRO_EFFECTIVENESS, GYRO_EFFECTIVENESS] = figures.effectiveness_prior * figures.effectiveness_prior
    turns.clocks[f, WARM_UP_GYRO] = figures.warm_up_rows
    restart(turns, f, GYRO, figures)


@kernel
def restart(turns: Turns, f: int, bank: int, figures: TurnFigures) -> None:
    """The common restart of a bank: sums to zero, all hypotheses from the uninterrupted filter and the reference."""
    clear_sums(turns.sums[f, bank])
    mode = int(turns.clocks[f, MODE])
    for i in range(HYPOTHESES):
        for j in range(LINEAR_STATES):
            turns.response[f, bank, i, j] = turns.response[f, bank, mode, j]
    reference = turns.learnt[f, bank, NOTED]
    bias, effectiveness = reference[LEARNT_BIAS], reference[LEARNT_SHARE]
    bias_rad_s = max(reference[DEVIATION_BIAS], figures.bias_floor_rad_s)
    share = max(reference[DEVIATION_SHARE], figures.effectiveness_floor)
    if bank == GPS:
        known = turns.gps_covariance[f, KNOWN]
        deviation = figures.gps.coloured.deviation_rad_s * math.sqrt(
            level_at_reference(turns.learnt[f, GPS], turns.clocks[f, LEVEL_GPS])
        )
        for i in range(HYPOTHESES):
            mean, covariance = turns.gps_mean[f, i], turns.gps_covariance[f, i]
            clear(covariance, GPS_STATES)
            for j in range(HEADING + 1):
                mean[j] = turns.gps_mean[f, KNOWN, j]
                for k in range(HEADING + 1):
                    covariance[j, k] = known[j, k]
            mean[BIAS] = bias
            mean[COLOURED] = 0.0
            mean[EFFECTIVENESS] = effectiveness
            covariance[BIAS, BIAS] = bias_rad_s * bias_rad_s
            covariance[COLOURED, COLOURED] = deviation * deviation
            covariance[EFFECTIVENESS, EFFECTIVENESS] = share * share
    else:
        deviation = figures.gyro.coloured.deviation_rad_s * math.sqrt(
            level_at_reference(turns.learnt[f, GYRO], turns.clocks[f, LEVEL_GYRO])
        )
        for i in range(HYPOTHESES):
            mean, covariance = turns.gyro_mean[f, i], turns.gyro_covariance[f, i]
            clear(covariance, GYRO_STATES)
            mean[GYRO_BIAS] = bias
            mean[GYRO_COLOURED] = 0.0
            mean[GYRO_EFFECTIVENESS] = effectiveness
            covariance[GYRO_BIAS, GYRO_BIAS] = bias_rad_s * bias_rad_s
            covariance[GYRO_COLOURED, GYRO_COLOURED] = deviation * deviation
            covariance[GYRO_EFFECTIVENESS, GYRO_EFFECTIVENESS] = share * share


@kernel
def step_responses(turns: Turns, f: int, figures: TurnFigures, left_m: float, right_m: float, scale: float) -> None:
    """One row with the lines as the encoders have them; scale: of a turn rate, for the density of the air."""
    left = line_effect(left_m, figures.slack_m, figures.curvature_per_m)
    right = line_effect(right_m, figures.slack_m, figures.curvature_per_m)
    for i in range(HYPOTHESES):
        pull = line_input(i, left, right)
        for bank in range(BANKS):
            step_response(turns.response[f, bank, i], figures.transition, figures.held_input, pull)
        turns.since_fix[f, i] += scale * turn_output(turns.response[f, GPS, i], figures.heading_output)
    turns.since_fix[f, HYPOTHESES] += 1.0


@kernel
def turn_steadily(turns: Turns, f: int, figures: TurnFigures, turn_rad_s: float) -> None:
    """All responses into the steady turn of this rate: what comes next is judged from there."""
    for bank in range(BANKS):
        for i in range(HYPOTHESES):
            for j in range(LINEAR_STATES):
                turns.response[f, bank, i, j] = turn_rad_s * figures.steady_turn[j]


@kernel
def _change(before: FloatArray, bank: int, of_mode: float, crossing: float) -> float:
    """How much the response moved since the last measurement: badly known in time and shape while it moves."""
    change = abs(of_mode - float(before[BEFORE_MODE]))
    if bank == GPS:
        change = 0.5 * (change + abs(crossing - float(before[BEFORE_CROSSING])))
    before[BEFORE_MODE] = of_mode
    before[BEFORE_CROSSING] = crossing
    return change


@kernel
def hear_gps(
    turns: Turns,
    f: int,
    figures: TurnFigures,
    cross: FloatArray,
    densities: FloatArray,
    elapsed_s: float,
    north_m_s: float,
    east_m_s: float,
    nominal_airspeed_m_s: float,
    scale: float,
) -> None:
    """A new fix; cross: (GPS_STATES,), densities: (FILTERS,), both scratch."""
    mode = int(turns.clocks[f, MODE])
    response, output = turns.response[f, GPS], figures.heading_output
    of_mode = scale * turn_output(response[mode], output)
    crossing = scale * turn_output(response[HEALTHY], output) - scale * turn_output(response[CROSSED], output)
    change = _change(turns.before[f, GPS], GPS, of_mode, crossing)
    reference_level = level_at_reference(turns.learnt[f, GPS], turns.clocks[f, LEVEL_GPS])
    rows = max(turns.since_fix[f, HYPOTHESES], 1.0)
    for i in range(FILTERS):
        mean_response = turns.since_fix[f, mode if i == KNOWN else i] / rows
        mean, covariance = turns.gps_mean[f, i], turns.gps_covariance[f, i]
        level = turns.clocks[f, LEVEL_GPS] if i == KNOWN else reference_level
        cross[GPS_STATES] = 0.0
        predict_gps(mean, covariance, figures.gps, elapsed_s, nominal_airspeed_m_s, mean_response, change, level)
        densities[i] = correct_gps(mean, covariance, cross, figures.gps, north_m_s, east_m_s)
    for i in range(HYPOTHESES + 1):
        turns.since_fix[f, i] = 0.0
    clocks = turns.clocks[f]
    if clocks[ALARM_ROWS] == NO_ALARM and largest_sum(turns.sums[f, GPS], mode) <= figures.calm * figures.gps_bank.threshold:
        clocks[LEVEL_GPS] = follow_level(clocks[LEVEL_GPS], figures.level, 0.5 * cross[GPS_STATES], elapsed_s)
    _sum_up(turns, f, GPS, figures, densities)


@kernel
def hear_gyro(
    turns: Turns,
    f: int,
    figures: TurnFigures,
    cross: FloatArray,
    densities: FloatArray,
    elapsed_s: float,
    turn_rad_s: float,
    scale: float,
) -> None:
    """A new turn rate from gyro and attitude."""
    mode = int(turns.clocks[f, MODE])
    response, output = turns.response[f, GYRO], figures.yaw_output
    of_mode = scale * turn_output(response[mode], output)
    change = _change(turns.before[f, GYRO], GYRO, of_mode, 0.0)
    reference_level = level_at_reference(turns.learnt[f, GYRO], turns.clocks[f, LEVEL_GYRO])
    for i in range(FILTERS):
        expected = scale * turn_output(response[mode if i == KNOWN else i], output)
        mean, covariance = turns.gyro_mean[f, i], turns.gyro_covariance[f, i]
        level = turns.clocks[f, LEVEL_GYRO] if i == KNOWN else reference_level
        cross[GYRO_STATES] = 0.0
        densities[i] = step_gyro(mean, covariance, cross, figures.gyro, elapsed_s, turn_rad_s, expected, change, level)
    clocks = turns.clocks[f]
    if (
        clocks[ALARM_ROWS] == NO_ALARM
        and largest_sum(turns.sums[f, GYRO], mode) <= figures.calm * figures.gyro_bank.threshold
    ):
        clocks[LEVEL_GYRO] = follow_level(clocks[LEVEL_GYRO], figures.level, cross[GYRO_STATES], elapsed_s)
    _sum_up(turns, f, GYRO, figures, densities)


@kernel
def level_at_reference(learnt: FloatArray, present: float) -> float:
    """The noise that the hypotheses reckon with; as it is now, until there is a reference; learnt: (NOTED + 1, LEARNT)."""
    level = learnt[NOTED, LEARNT_LEVEL]
    for i in range(NOTED - 1):
        level = max(level, learnt[i, LEARNT_LEVEL])
    return float(level) if level > 0.0 else min(present, EARLY_LEVEL)


@kernel
def follow_level(level: float, rule: Level, squared: float, elapsed_s: float) -> float:
    """The level of the noise, a variance over the configured one, after a squared normalised innovation."""
    step = elapsed_s / rule.time_s * (min(squared, rule.clip) - rule.squared)
    return min(max(level * (1.0 + step), 1.0), rule.limit)


@kernel
def _sum_up(turns: Turns, f: int, bank: int, figures: TurnFigures, densities: FloatArray) -> None:
    """Sums against the believed mode; the common restart where none is above zero, and during the warm-up."""
    mode = int(turns.clocks[f, MODE])
    sums = turns.sums[f, bank]
    above = False
    for i in range(HYPOTHESES):
        if i == mode:
            continue
        ratio = densities[i] - densities[mode]
        clipped = min(max(ratio, -figures.clip), figures.clip)
        sums[CLIPPED, i] = max(sums[CLIPPED, i] + clipped - figures.drift, figures.floor)
        sums[WHOLE, i] += min(max(ratio, -figures.whole_clip), figures.whole_clip)
        if sums[CLIPPED, i] > 0.0:
            above = True
        else:
            sums[ROWS_ABOVE, i] = 0.0
    if not above or turns.clocks[f, WARM_UP_GPS + bank] > 0.0:
        restart(turns, f, bank, figures)


@kernel
def note(turns: Turns, f: int, figures: TurnFigures) -> None:
    """Once a while, and not during an alarm: the oldest value noted becomes the reference, the present one is noted."""
    clocks = turns.clocks[f]
    clocks[NOTED_ROWS] += 1.0
    if clocks[NOTED_ROWS] < figures.noted_rows or clocks[ALARM_ROWS] != NO_ALARM:
        return
    if largest_sum(turns.sums[f, GPS], int(clocks[MODE])) > figures.calm * figures.gps_bank.threshold:
        return
    if largest_sum(turns.sums[f, GYRO], int(clocks[MODE])) > figures.calm * figures.gyro_bank.threshold:
        return
    clocks[NOTED_ROWS] = 0.0
    for bank in range(BANKS):
        if clocks[WARM_UP_GPS + bank] > 0.0:
            continue
        learnt = turns.learnt[f, bank]
        for j in range(LEARNT):
            learnt[NOTED, j] = learnt[0, j]
            for i in range(NOTED - 1):
                learnt[i, j] = learnt[i + 1, j]
        if bank == GPS:
            mean, covariance, at, of = turns.gps_mean[f, KNOWN], turns.gps_covariance[f, KNOWN], BIAS, EFFECTIVENESS
        else:
            mean, covariance = turns.gyro_mean[f, KNOWN], turns.gyro_covariance[f, KNOWN]
            at, of = GYRO_BIAS, GYRO_EFFECTIVENESS
        bias, share = mean[at], mean[of]
        clocks[USUAL_GPS + bank] = max(clocks[USUAL_GPS + bank] * figures.usual_kept, learnt[NOTED, LEARNT_PEAK])
        learnt[NOTED - 1, LEARNT_PEAK] = clocks[PEAK_GPS + bank]
        clocks[PEAK_GPS + bank] = 0.0
        learnt[NOTED - 1, LEARNT_LEVEL] = clocks[LEVEL_GPS + bank]
        learnt[NOTED - 1, DEVIATION_BIAS] = math.sqrt(covariance[at, at])
        learnt[NOTED - 1, DEVIATION_SHARE] = math.sqrt(covariance[of, of])
        limit = figures.effectiveness_limit
        learnt[NOTED - 1, LEARNT_BIAS] = min(max(bias, -figures.bias_limit_rad_s), figures.bias_limit_rad_s)
        learnt[NOTED - 1, LEARNT_SHARE] = min(max(share, 1.0 - limit), 1.0 + limit)


@kernel
def leader(sums: FloatArray, mode: int) -> tuple[int, float]:
    """The hypothesis whose whole sum is largest, other than the believed mode, and its lead over all others."""
    best = -1
    for i in range(HYPOTHESES):
        if i != mode and (best < 0 or sums[WHOLE, i] > sums[WHOLE, best]):
            best = i
    lead = sums[WHOLE, best]  # over the believed mode, whose sum is 0
    for i in range(HYPOTHESES):
        if i not in (mode, best):
            lead = min(lead, sums[WHOLE, best] - sums[WHOLE, i])
    return best, lead


@kernel
def largest_sum(sums: FloatArray, mode: int) -> float:
    """The largest clipped sum of a bank, (SUMS, HYPOTHESES)."""
    largest = -math.inf
    for i in range(HYPOTHESES):
        if i != mode:
            largest = max(largest, sums[CLIPPED, i])
    return largest


@kernel
def _agrees(turns: Turns, f: int, named: int, agreement: float) -> bool:
    """Does the GPS bank prefer the hypothesis that the gyro names to the other faults?"""
    whole = turns.sums[f, GPS, WHOLE]
    mode = int(turns.clocks[f, MODE])
    lead = math.inf
    for i in range(HYPOTHESES):
        if i not in (named, mode):
            lead = min(lead, whole[named] - whole[i])
    return lead > agreement


@kernel
def decide_turns(turns: Turns, f: int, figures: TurnFigures, bank: int) -> None:
    """Alarm, and another mode believed where the judging bank names one."""
    clocks = turns.clocks[f]
    for each in range(BANKS):
        for i in range(HYPOTHESES):
            turns.sums[f, each, ROWS_ABOVE, i] += 1.0
    rule = figures.gps_bank if bank == GPS else figures.gyro_bank
    threshold = max(
        rule.threshold * level_at_reference(turns.learnt[f, bank], turns.clocks[f, LEVEL_GPS + bank]),
        figures.usual_factor * clocks[USUAL_GPS + bank],
    )
    if clocks[ALARM_ROWS] == NO_ALARM:
        for each in range(BANKS):
            clocks[PEAK_GPS + each] = max(clocks[PEAK_GPS + each], largest_sum(turns.sums[f, each], int(clocks[MODE])))
        if largest_sum(turns.sums[f, bank], int(clocks[MODE])) > threshold:
            clocks[ALARM_ROWS] = 0.0
        return
    clocks[ALARM_ROWS] += 1.0
    if largest_sum(turns.sums[f, bank], int(clocks[MODE])) <= 0.0:
        clocks[ALARM_ROWS] = NO_ALARM
        return
    if clocks[ALARM_ROWS] < figures.hold_rows:
        return
    named, lead = leader(turns.sums[f, bank], int(clocks[MODE]))
    if turns.sums[f, bank, CLIPPED, named] <= threshold or lead <= rule.margin:
        return
    if bank == GYRO and not _agrees(turns, f, named, figures.agreement):
        return
    whole = turns.sums[f, bank, WHOLE]
    others = 0.0
    for i in range(HYPOTHESES):
        if i != named:
            others += math.exp(min((0.0 if i == int(clocks[MODE]) else whole[i]) - whole[named], 0.0))
    clocks[CONFIDENCE] = min(1.0 / (1.0 + others), figures.surest)
    clocks[ONSET_ROWS] = turns.sums[f, bank, ROWS_ABOVE, named]
    clocks[SUM_AT_NAMING] = turns.sums[f, bank, CLIPPED, named]
    believe(turns, f, figures, named)


@kernel
def believe(turns: Turns, f: int, figures: TurnFigures, mode: int) -> None:
    """Another mode from here on; what its own filters know goes on as the uninterrupted ones."""
    clocks = turns.clocks[f]
    for j in range(GPS_STATES):
        turns.gps_mean[f, KNOWN, j] = turns.gps_mean[f, mode, j]
        for k in range(GPS_STATES):
            turns.gps_covariance[f, KNOWN, j, k] = turns.gps_covariance[f, mode, j, k]
    for j in range(GYRO_STATES):
        turns.gyro_mean[f, KNOWN, j] = turns.gyro_mean[f, mode, j]
        for k in range(GYRO_STATES):
            turns.gyro_covariance[f, KNOWN, j, k] = turns.gyro_covariance[f, mode, j, k]
    clocks[MODE] = mode
    clocks[MODE_ROWS] = 0.0
    clocks[ALARM_ROWS] = NO_ALARM
    clocks[NOTED_ROWS] = 0.0
    for bank in range(BANKS):
        restart(turns, f, bank, figures)


@kernel
def begin_again(turns: Turns, f: int, figures: TurnFigures, unscale: float) -> None:
    """Believe in a healthy vehicle again, from the turn that the filters see; unscale: 1 / scale of turn rates.

    Bias and effectiveness return to what was known of the vehicle before: what was learnt under another mode, or while a
    fault was not yet named, would accuse the mended vehicle.
    """
    clocks = turns.clocks[f]
    gps, gyro = turns.gps_mean[f, KNOWN], turns.gyro_mean[f, KNOWN]
    response, mode = turns.response[f, GPS], int(clocks[MODE])
    turn = gps[BIAS] + gps[COLOURED] + gps[EFFECTIVENESS] * turn_output(response[mode], figures.heading_output) / unscale
    clocks[MODE] = HEALTHY
    clocks[MODE_ROWS] = 0.0
    clocks[ALARM_ROWS] = NO_ALARM
    clocks[NOTED_ROWS] = 0.0
    turn_steadily(turns, f, figures, turn * unscale)
    reference = turns.learnt[f, GPS, NOTED]
    gps[BIAS] = reference[LEARNT_BIAS]
    gps[EFFECTIVENESS] = reference[LEARNT_SHARE]
    gps[COLOURED] = 0.0
    reference = turns.learnt[f, GYRO, NOTED]
    gyro[GYRO_BIAS] = reference[LEARNT_BIAS]
    gyro[GYRO_EFFECTIVENESS] = reference[LEARNT_SHARE]
    gyro[GYRO_COLOURED] = 0.0
    restart(turns, f, GPS, figures)
    restart(turns, f, GYRO, figures)
