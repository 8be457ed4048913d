"""The envelope of a motor against motors that obey a lag and a rate, sound and faulty, on clean and on bad links."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi.parafoil.motors import (
    HIGH_M,
    JUDGED,
    KIND,
    KIND_SATURATION,
    KIND_STUCK,
    KIND_UNKNOWN,
    LOW_M,
    MOTOR,
    OUTSIDE_AGO,
    OUTSIDE_M,
    ROWS_KEPT,
    STANDING,
    VALUE_M,
    keep,
    start_motor,
    step_motor,
)
from fdi.parafoil.multimodel import figures_of
from fdi.reach import lag_share, lagged_step

STEP_S, TRAVEL_M, RATE_M_S, LAG_S = 0.1, 1.4, 0.7, 0.25


@pytest.fixture(scope="module")
def figures(config):
    return figures_of(config).motor


class Watched:
    """A motor with its envelope, begun within an interval; `standing`, `kind`, `value_m`, `outside_m` by row."""

    def __init__(self, figures, low_m=0.0, high_m=None):
        self.figures, self.motor, self.kept = figures, np.zeros(MOTOR), np.zeros((2, ROWS_KEPT))
        start_motor(self.motor, self.kept, low_m, low_m if high_m is None else high_m)
        self.standing, self.kind, self.value_m, self.outside_m = [], [], [], []

    def step(self, command_m, encoder_m, command_rows=0, encoder_rows=0):
        keep(self.kept[0], command_m, command_rows)
        keep(self.kept[1], encoder_m, encoder_rows)
        step_motor(self.motor, self.kept, self.figures)
        self.standing.append(bool(self.motor[STANDING]))
        self.kind.append(float(self.motor[KIND]))
        self.value_m.append(float(self.motor[VALUE_M]))
        self.outside_m.append(float(self.motor[OUTSIDE_M]))


def moved(commands_m, rate_factor=1.0, lag_factor=1.0, limit_m=TRAVEL_M, start_m=0.0):
    """Positions of a motor that hears each command in its own row, (row,)."""
    positions_m, position_m = [], start_m
    share, largest_m = lag_share(STEP_S, lag_factor * LAG_S), rate_factor * RATE_M_S * STEP_S
    for command_m in commands_m:
        position_m = lagged_step(position_m, min(command_m, limit_m), share, largest_m)
        positions_m.append(position_m)
    return positions_m


def watch(figures, commands_m, encoders_m):
    """Begun where the encoder is first."""
    watched = Watched(figures, encoders_m[0])
    for command_m, encoder_m in zip(commands_m, encoders_m, strict=True):
        watched.step(command_m, encoder_m)
    return watched


def square(high_m, rows, half=60, low_m=0.0):
    """Commands of a toggle that is pulled and released by turns, six seconds each."""
    return [high_m if k % (2 * half) < half else low_m for k in range(rows)]


def holding(fewest_rows):
    return st.lists(st.tuples(st.floats(0.0, TRAVEL_M), st.integers(fewest_rows, 25)), min_size=1, max_size=12)


sound = st.tuples(st.floats(0.60, 1.4), st.floats(0.45, 1.7))


def held(pieces):
    return [command_m for command_m, rows in pieces for _ in range(rows)]


@settings(max_examples=100)
@given(pieces=holding(1), spread=sound, heard_late=st.integers(0, 1), seed=st.integers(0, 999))
def test_no_sound_motor_leaves_its_envelope(figures, pieces, spread, heard_late, seed):
    """Whichever of two rows it hears a command in, and with an encoder that is off by up to a centimetre."""
    commands_m = held(pieces)
    positions_m = moved([0.0] * heard_late + commands_m[: len(commands_m) - heard_late], *spread)
    noise_m = np.random.default_rng(seed).uniform(-0.01, 0.01, len(commands_m))
    watched = watch(figures, commands_m, np.array(positions_m) + noise_m)
    assert max(watched.outside_m) <= 0.02 + 1e-9  # the first reading's error and this one's
    assert not any(watched.standing)


def arriving(values, lost, late):
    """What a companion's rows hold of a message each row: (newest value that has come, its age in rows)."""
    rows, newest = [], None
    for k in range(len(values)):
        for sent, comes in ((k - 1, k - 1 >= 0 and late[k - 1]), (k, not late[k])):
            if comes and not lost[sent] and (newest is None or sent > newest):
                newest = sent
        rows.append((math.nan, 0) if newest is None or k - newest >= 10 else (values[newest], k - newest))
    return rows


@settings(max_examples=100)
@given(pieces=holding(2), spread=sound, seed=st.integers(0, 10_000), share=st.floats(0.0, 0.4))
def test_lost_and_late_messages_accuse_no_sound_motor(figures, pieces, spread, seed, share):
    """Of an autopilot that changes its commands no faster than every other row: a lost one lies between its neighbours."""
    commands_m = held(pieces)
    rng = np.random.default_rng(seed)
    chance = rng.random((4, len(commands_m))) < share
    commands = arriving(commands_m, chance[0], chance[1])
    encoders = arriving(moved(commands_m, *spread), chance[2], chance[3])
    watched = Watched(figures, 0.0, TRAVEL_M)  # the first reading may be lost, too
    for (command_m, command_rows), (encoder_m, encoder_rows) in zip(commands, encoders, strict=True):
        watched.step(command_m, encoder_m, command_rows, encoder_rows)
    assert max(watched.outside_m) <= 1e-9
    assert not any(watched.standing)


def test_a_late_encoder_is_judged_in_its_own_row_and_a_lost_one_not_at_all(figures):
    watched = Watched(figures)
    for k in range(20):
        if k == 10:
            watched.step(0.0, math.nan)
        elif k == 11:
            watched.step(0.0, 0.02, encoder_rows=1)  # that of row 10, a row late
        else:
            watched.step(0.0, 0.0)
        if k == 12:
            assert watched.motor[OUTSIDE_AGO] == 0.0
            assert watched.outside_m[-1] == pytest.approx(0.02, abs=1e-12)
        if k == 13:  # row 11 itself never came
            assert watched.motor[OUTSIDE_AGO] == 1.0


def test_an_unknown_command_opens_the_envelope_to_the_whole_travel_and_a_lone_gap_does_not(figures):
    def widths_m(missing):
        watched, widths_m = Watched(figures, 0.7), []
        for k in range(40):
            watched.step(math.nan if k in missing else 0.7, math.nan)
            widths_m.append(watched.motor[HIGH_M] - watched.motor[LOW_M])
        return widths_m

    assert max(widths_m({10})) == 0.0
    rate_m = 1.4 * RATE_M_S * STEP_S  # a row, of the fastest motor, up and down
    assert max(widths_m({10, 11})) == pytest.approx(2.0 * 2.0 * rate_m, abs=1e-9)
    assert max(widths_m(range(10, 30))) == pytest.approx(TRAVEL_M, abs=0.02)


@pytest.mark.parametrize("outside_m", [0.2, -0.2])
def test_three_encoder_samples_outside_accuse_and_two_do_not(figures, outside_m):
    def accused(rows):
        watched = Watched(figures, 0.5)
        for k in range(30):
            watched.step(0.5, 0.5 + (outside_m if k in rows else 0.0))
        return watched.standing

    three = accused({10, 11, 12})
    assert three.index(True) == 12 + JUDGED
    assert not any(accused({10, 11}))
    assert not any(accused({10, 11, 13, 14}))


def test_samples_that_are_lost_between_do_not_break_the_row_of_three(figures):
    watched = Watched(figures)
    for k in range(20):
        watched.step(0.0, math.nan if k in (11, 13) else 0.2 if k >= 10 else 0.0)
    assert watched.standing.index(True) == 14 + JUDGED


def test_within_the_tolerance_nothing_is_accused(figures):
    watched = Watched(figures)
    for k in range(200):
        watched.step(0.0, 0.029 if k % 2 else 0.0)
    assert not any(watched.standing)


@pytest.mark.parametrize("stuck_m", [0.2, 0.45, 0.9, 1.3])
def test_a_stuck_motor_is_told_from_a_limited_one_with_the_place_where_it_is(figures, stuck_m):
    commands_m = square(1.2 if stuck_m < 1.0 else 0.8, 400)
    encoders_m = moved(commands_m[:100]) + moved([stuck_m] * 300, lag_factor=0.01, start_m=moved(commands_m[:100])[-1])
    watched = watch(figures, commands_m, encoders_m)
    assert not any(watched.standing[:100])
    assert watched.standing[-1]
    assert watched.kind[-1] == KIND_STUCK
    assert watched.value_m[-1] == pytest.approx(stuck_m, abs=0.02)


@settings(max_examples=100)
@given(limit_m=st.floats(0.25, 0.9), spread=sound, low_m=st.floats(0.0, 0.1), seed=st.integers(0, 999))
def test_a_limited_motor_is_told_from_a_stuck_one_with_its_limit(figures, limit_m, spread, low_m, seed):
    commands_m = square(limit_m + 0.3, 500, low_m=low_m)
    noise_m = np.random.default_rng(seed).normal(0.0, 0.002, len(commands_m))
    watched = watch(figures, commands_m, np.array(moved(commands_m, *spread, limit_m=limit_m)) + noise_m)
    assert watched.standing[-1]
    assert set(watched.kind) == {KIND_UNKNOWN, KIND_SATURATION}
    assert watched.value_m[-1] == pytest.approx(limit_m, abs=0.02)


def test_the_kind_is_unknown_while_nothing_asks_the_motor_to_come_down(figures):
    watched = watch(figures, [0.9] * 300, moved([0.9] * 300, limit_m=0.5))
    assert watched.standing[-1]
    assert watched.kind[-1] == KIND_UNKNOWN
    assert watched.value_m[-1] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("fault", ["stuck", "limited"])
def test_the_accusation_is_taken_back_a_second_after_the_motor_has_passed_its_value(figures, fault):
    commands_m = square(0.9, 600)
    faulty_m = moved(commands_m[:300], limit_m=0.4)
    if fault == "stuck":
        faulty_m = [min(each, 0.4) if k < 20 else 0.4 for k, each in enumerate(faulty_m)]
    mended_m = moved(commands_m[300:], start_m=faulty_m[-1])
    watched = watch(figures, commands_m, faulty_m + mended_m)
    beyond = next(k for k in range(300, 600) if (faulty_m + mended_m)[k] > 0.4 + figures.moved_m)
    assert watched.standing[299]
    assert watched.kind[299] == (KIND_STUCK if fault == "stuck" else KIND_SATURATION)
    cleared = watched.standing.index(False, 300)
    assert cleared - beyond == pytest.approx(figures.clear_rows + JUDGED, abs=3.0)
    assert not any(watched.standing[cleared:])


@settings(max_examples=100)
@given(pieces=holding(1), limit_m=st.floats(0.2, 0.8), seed=st.integers(0, 999))
def test_a_motor_that_stays_limited_is_never_acquitted(figures, pieces, limit_m, seed):
    commands_m = square(limit_m + 0.3, 130) + held(pieces)
    noise_m = np.random.default_rng(seed).normal(0.0, 0.002, len(commands_m))
    watched = watch(figures, commands_m, np.array(moved(commands_m, limit_m=limit_m)) + noise_m)
    assert all(watched.standing[watched.standing.index(True) :])


def test_begun_in_flight_at_the_encoder_or_anywhere_no_sound_motor_is_accused(figures):
    commands_m = [0.2] * 60
    positions_m = moved(commands_m, start_m=1.1)

    def accused(low_m, high_m, unheard):
        watched = Watched(figures, low_m, high_m)
        for k, (command_m, position_m) in enumerate(zip(commands_m, positions_m, strict=True)):
            watched.step(command_m, math.nan if k < unheard else position_m)
        return any(watched.standing)

    assert not accused(positions_m[0], positions_m[0], unheard=0)
    assert not accused(0.0, TRAVEL_M, unheard=3)
    assert accused(0.0, 0.0, unheard=3)  # at rest is no place to begin


def test_beginning_forgets_an_accusation(figures):
    watched = watch(figures, [0.9] * 60, [0.0] * 60)
    assert watched.standing[-1]
    start_motor(watched.motor, watched.kept, 0.3, 0.4)
    assert watched.motor[STANDING] == 0.0
    assert (watched.motor[LOW_M], watched.motor[HIGH_M]) == (0.3, 0.4)
    assert math.isinf(watched.motor[OUTSIDE_AGO])
    assert np.isnan(watched.kept).all()


def test_kept_values_go_where_they_belong_and_the_first_of_a_row_stays():
    kept = np.full(ROWS_KEPT, math.nan)
    keep(kept, 0.1, 0)
    keep(kept, 0.2, 0)
    keep(kept, 0.9, 1)  # that row has its value: an old one is held
    assert kept[1:3].tolist() == [0.2, 0.1]
    assert math.isnan(kept[0])
    keep(kept, 0.3, 1)
    assert kept[1:4].tolist() == [0.3, 0.2, 0.1]
    for rows in (ROWS_KEPT, 1e9, math.inf):
        before = kept.copy()
        keep(kept, 0.4, rows)
        assert np.array_equal(kept[1:], before[:-1], equal_nan=True)
        assert math.isnan(kept[0])
