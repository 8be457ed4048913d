"""The envelope monitor of a line motor: is the spool where a sound motor could have brought it?

Kernels (fdi/kernel.py) over one output of one flight.  An interval holds every position that a motor within its spread
can have; an encoder outside of it, three times in a row, accuses the motor.  Each row judges the commands and the encoder
of two rows ago: by then a message that came late is there, and a lost one is known to be lost, so that a bad link widens
the interval instead of accusing a motor.  Source: docs/parafoil_method.md, "Ours".
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.kernel import kernel
from fdi.reach import highest_reach, lowest_reach

FloatArray = NDArray[np.float64]

ROWS_KEPT = 4  # of commands and encoder readings, the newest first
JUDGED = 2  # the row that is judged, in these

# columns of the state of one output, (MOTOR,)
(
    ROWS,  # rows since the start
    LOW_M,
    HIGH_M,
    OUTSIDE_ROWS,  # in a row that the encoder stood outside
    STANDING,  # 1 while accused
    SINCE_ROWS,  # since the first of the rows that accused it
    KIND,
    VALUE_M,  # where it is stuck, or its limit
    HIGHEST_M,  # encoder since it was accused, or since it last fell though it was asked to rise
    BASE_M,  # the encoder when kinds began to be told apart
    TOP_M,  # the highest at which it may have been kept
    BELOW_ROWS,  # in a row that the command stood well below
    FOLLOWED_ROWS,  # that speak against the accusation
    OUTSIDE_M,  # by which the encoder stands outside; below zero inside
    OUTSIDE_AGO,  # rows since that was known
) = range(15)
MOTOR = 15
KIND_UNKNOWN, KIND_STUCK, KIND_SATURATION = 0.0, 1.0, 2.0


class MotorFigures(NamedTuple):
    """Figures of the envelope."""

    period_s: float
    travel_m: float
    slow: tuple[float, float]  # share of the lag, largest step (m): the slowest sound motor
    fast: tuple[float, float]
    tolerance_m: float
    rows_outside: int  # in a row, that accuse
    settle_rows: float  # after an accusation, until its kind is looked for: a motor that runs away has arrived
    moved_m: float  # that an encoder must move to have moved
    commanded_m: float  # below the encoder, that ask a motor to move
    commanded_rows: float  # for so long
    clear_rows: float  # beyond the value of the fault, that take the accusation back


@kernel
def start_motor(motor: FloatArray, kept: FloatArray, low_m: float, high_m: float) -> None:
    """Begin with the spool somewhere in an interval; motor: (MOTOR,), kept: (2, ROWS_KEPT), commands and encoder."""
    for i in range(MOTOR):
        motor[i] = 0.0
    motor[LOW_M] = low_m
    motor[HIGH_M] = high_m
    motor[OUTSIDE_AGO] = math.inf
    for i in range(ROWS_KEPT):
        kept[0, i] = math.nan
        kept[1, i] = math.nan


@kernel
def keep(kept: FloatArray, value: float, age_rows: float) -> None:
    """A new row of one of both kinds; kept: (ROWS_KEPT,).  A late value goes where it belongs; NaN is none; age >= 0."""
    for i in range(ROWS_KEPT - 1, 0, -1):
        kept[i] = kept[i - 1]
    kept[0] = math.nan
    if math.isnan(value) or age_rows >= ROWS_KEPT:
        return
    place = int(age_rows)
    if math.isnan(kept[place]):
        kept[place] = value


@kernel
def step_motor(motor: FloatArray, kept: FloatArray, figures: MotorFigures) -> None:
    """One row; `keep` has been called for both kinds."""
    motor[ROWS] += 1.0
    motor[SINCE_ROWS] += motor[STANDING]
    motor[OUTSIDE_AGO] += 1.0
    if motor[ROWS] < ROWS_KEPT:
        return
    low_m, high_m = math.inf, -math.inf
    for i in range(ROWS_KEPT):
        command_m = kept[0, i]
        if not math.isnan(command_m):
            low_m = min(low_m, command_m)
            high_m = max(high_m, command_m)
    surrounded = not math.isnan(kept[0, JUDGED + 1]) and not math.isnan(kept[0, JUDGED - 1])
    if math.isnan(kept[0, JUDGED]) and not surrounded:
        low_m, high_m = 0.0, figures.travel_m
    motor[LOW_M] = lowest_reach(motor[LOW_M], low_m, figures.slow, figures.fast)
    motor[HIGH_M] = highest_reach(motor[HIGH_M], high_m, figures.slow, figures.fast)
    encoder_m = kept[1, JUDGED]
    if math.isnan(encoder_m):
        return
    outside_m = max(motor[LOW_M] - encoder_m, encoder_m - motor[HIGH_M])
    motor[OUTSIDE_M] = outside_m
    motor[OUTSIDE_AGO] = 0.0
    if outside_m > figures.tolerance_m:
        motor[OUTSIDE_ROWS] += 1.0
        motor[FOLLOWED_ROWS] = 0.0
    else:
        motor[OUTSIDE_ROWS] = 0.0
        motor[LOW_M] = max(motor[LOW_M], encoder_m - figures.tolerance_m)
        motor[HIGH_M] = min(motor[HIGH_M], encoder_m + figures.tolerance_m)
        if motor[LOW_M] > motor[HIGH_M]:
            motor[LOW_M] = encoder_m
            motor[HIGH_M] = encoder_m
    if motor[STANDING] > 0.0:
        _tell_kind(motor, encoder_m, kept[1, JUDGED + 1], kept[0, JUDGED], figures)
        if motor[FOLLOWED_ROWS] >= figures.clear_rows:
            motor[STANDING] = 0.0
    elif motor[OUTSIDE_ROWS] >= figures.rows_outside:
        motor[STANDING] = 1.0
        motor[SINCE_ROWS] = motor[OUTSIDE_ROWS] - 1.0 + JUDGED
        motor[KIND] = KIND_UNKNOWN
        motor[VALUE_M] = encoder_m
        motor[HIGHEST_M] = encoder_m
        motor[TOP_M] = encoder_m
        motor[BELOW_ROWS] = 0.0
        motor[FOLLOWED_ROWS] = 0.0


@kernel
def _tell_kind(motor: FloatArray, encoder_m: float, before_m: float, command_m: float, figures: MotorFigures) -> None:
    """Stuck or limited, once it is asked to come down: only a limited motor does.  Beyond its value it is mended.

    A limit is the highest that the motor has been: it may be on its way down from there before it is known what it has.
    While it falls though more is asked of it, it still comes from above its limit.
    """
    held = command_m > encoder_m + figures.commanded_m
    motor[HIGHEST_M] = encoder_m if held and encoder_m < before_m else max(motor[HIGHEST_M], encoder_m)
    if held and abs(encoder_m - before_m) < 0.5 * figures.moved_m:
        motor[TOP_M] = max(motor[TOP_M], encoder_m)
    settled = motor[SINCE_ROWS] > figures.settle_rows
    if motor[KIND] == KIND_UNKNOWN:
        motor[VALUE_M] = max(motor[VALUE_M], encoder_m) if settled else encoder_m
    if not settled:
        motor[BASE_M] = encoder_m
        motor[TOP_M] = motor[HIGHEST_M]
        return
    inside = motor[OUTSIDE_ROWS] == 0.0
    if motor[KIND] != KIND_SATURATION and inside and encoder_m < motor[BASE_M] - figures.moved_m:
        motor[KIND] = KIND_SATURATION
        motor[VALUE_M] = motor[HIGHEST_M]
    if motor[KIND] == KIND_UNKNOWN:
        below = not math.isnan(command_m) and command_m < encoder_m - figures.commanded_m
        motor[BELOW_ROWS] = motor[BELOW_ROWS] + 1.0 if below else 0.0
        if motor[BELOW_ROWS] >= figures.commanded_rows:
            motor[KIND] = KIND_STUCK
            motor[VALUE_M] = encoder_m
    # Accused, it stands where it is stuck or at its limit, or comes down to there: whatever it has, it is no higher.
    known_m = motor[VALUE_M] if motor[KIND] == KIND_STUCK else motor[TOP_M]
    if inside and encoder_m > known_m + figures.moved_m:
        motor[FOLLOWED_ROWS] += 1.0
