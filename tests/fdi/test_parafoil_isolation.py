"""The two phases by scripted residuals: 0 broken left, 1 broken right, 2 crossed; thresholds as packaged."""

import numpy as np
import pytest

from fdi.parafoil.isolation import TwoPhaseIsolation, smallest_left
from fdi.verdict import NO_FAULT, Phase

MOTOR_LEFT, MOTOR_RIGHT, BROKEN_LEFT, BROKEN_RIGHT, CROSSED = range(5)


class Script:
    """One flight; every call of `run` is a stretch of equal rows."""

    def __init__(self, config):
        self.isolation = TwoPhaseIsolation(config.paper, config.period_s, flights=1)
        self.limits = config.paper.thresholds

    def run(self, rows, *, turn=0.0, motors=(0.0, 0.0), lines=(0.0, 0.0, 0.0), turn_known=True, motors_known=True):
        """Residuals as multiples of their thresholds."""
        for _ in range(rows):
            self.isolation.step(
                np.array([turn_known]),
                np.array([motors_known]),
                np.array([turn]) * self.limits.heading_rate_rad2_s2,
                np.array(motors)[:, None] * self.limits.motor_m,
                np.array(lines)[:, None]
                * np.array([[self.limits.broken_rad2_s2], [self.limits.broken_rad2_s2], [self.limits.crossed_rad2_s2]]),
            )
        return Phase(self.isolation.phase[0]), int(self.isolation.fault[0])


@pytest.fixture
def script(config):
    return Script(config)


def test_a_residual_at_its_threshold_is_healthy_and_above_it_detected(script):
    assert script.run(100, turn=1.0) == (Phase.HEALTHY, NO_FAULT)
    assert script.run(1, turn=1.001) == (Phase.DETECTED, NO_FAULT)


@pytest.mark.parametrize(("motors", "fault"), [((1.2, 0.0), MOTOR_LEFT), ((1.2, 1.3), MOTOR_RIGHT)])
def test_the_larger_motor_residual_is_named_at_once(script, motors, fault):
    assert script.run(1, turn=1.1, motors=motors) == (Phase.ISOLATED, fault)


def test_a_motor_is_named_up_to_five_seconds_after_detection_and_not_later(script, config):
    script.run(50, turn=1.1)
    assert script.run(1, turn=1.1, motors=(1.1, 0.0)) == (Phase.ISOLATED, MOTOR_LEFT)
    late = Script(config)
    late.run(51, turn=1.1)
    assert late.run(1, turn=1.1, motors=(1.1, 0.0)) == (Phase.DETECTED, NO_FAULT)


def test_a_motor_outranks_lines_that_are_eliminated_in_the_motor_phase(script):
    script.run(50, turn=1.1, lines=(0.5, 1.1, 1.1))
    assert script.run(1, turn=1.1, motors=(0.0, 1.1), lines=(0.5, 1.1, 1.1)) == (Phase.ISOLATED, MOTOR_RIGHT)


@pytest.mark.parametrize(
    ("lines", "fault"), [((0.9, 1.1, 1.1), BROKEN_LEFT), ((1.1, 0.9, 1.1), BROKEN_RIGHT), ((1.1, 1.1, 0.9), CROSSED)]
)
def test_the_line_fault_that_is_left_is_named_when_the_motor_phase_is_over(script, lines, fault):
    assert script.run(50, turn=1.1, lines=lines) == (Phase.DETECTED, NO_FAULT)
    assert script.run(1, turn=1.1) == (Phase.ISOLATED, fault)


def test_an_elimination_is_kept_though_the_residual_falls_again(script):
    script.run(60, turn=1.1, lines=(0.2, 1.1, 0.2))
    script.run(200, turn=1.1, lines=(0.2, 0.1, 0.2))
    assert script.run(1, turn=1.1, lines=(0.2, 0.1, 1.1)) == (Phase.ISOLATED, BROKEN_LEFT)


def test_what_exceeded_before_the_detection_eliminates_nothing(script):
    script.run(60, turn=0.9, lines=(1.5, 1.5, 0.1))
    assert script.run(60, turn=1.1) == (Phase.DETECTED, NO_FAULT)


def test_three_eliminations_are_inconclusive(script):
    assert script.run(51, turn=1.1, lines=(1.1, 1.1, 1.1)) == (Phase.INCONCLUSIVE, NO_FAULT)


def test_after_75_seconds_the_smallest_of_those_left_is_named_by_size(script, config):
    script.run(1, turn=1.1, lines=(0.8, 0.3, 0.7))
    assert script.run(749, turn=1.1, lines=(0.1, 1.2, 0.1)) == (Phase.DETECTED, NO_FAULT)
    assert script.run(1, turn=1.1) == (Phase.ISOLATED, CROSSED)  # 0.7, though broken right had been at 0.3
    assert script.isolation.confidence[0] == config.paper.confidence.crossed_lines_by_size


def test_smallest_left_skips_what_is_eliminated():
    maxima = np.array([[0.5, 1.5, 0.9], [0.4, 0.2, 2.0], [0.9, 0.9, 4.0]])
    assert smallest_left(maxima, np.array([1.0, 1.0, 2.0])).tolist() == [1, 1, 0]


def test_an_unknown_turn_residual_detects_eliminates_and_times_nothing(script):
    assert script.run(100, turn=5.0, turn_known=False) == (Phase.HEALTHY, NO_FAULT)
    script.run(60, turn=1.1)
    script.run(2000, turn=5.0, lines=(9.0, 9.0, 0.1), turn_known=False)
    assert script.run(600, turn=1.1, lines=(0.1, 0.2, 0.2)) == (Phase.DETECTED, NO_FAULT)
    assert script.run(100, turn=1.1, lines=(0.1, 0.2, 0.2)) == (Phase.ISOLATED, BROKEN_LEFT)


def test_while_a_motor_is_unknown_it_is_neither_accused_nor_ruled_out(script):
    eliminated = {"turn": 1.1, "lines": (0.5, 1.1, 1.1)}
    assert script.run(2000, **eliminated, motors=(3.0, 0.0), motors_known=False) == (Phase.DETECTED, NO_FAULT)
    assert script.run(1, **eliminated, motors=(3.0, 0.0)) == (Phase.ISOLATED, MOTOR_LEFT)


def test_a_motor_that_falls_silent_after_its_phase_holds_the_naming_of_a_line(script):
    script.run(60, turn=1.1)
    assert script.run(900, turn=1.1, lines=(0.5, 1.1, 1.1), motors_known=False) == (Phase.DETECTED, NO_FAULT)
    assert script.run(1, turn=1.1) == (Phase.ISOLATED, BROKEN_LEFT)


@pytest.mark.parametrize("ending", [(0.2, 1.1, 1.1), (1.1, 1.1, 1.1)])
def test_a_verdict_on_lines_stays_while_it_shows_and_clears_after_half_a_minute_below(script, ending):
    phase, fault = script.run(51, turn=1.1, lines=ending)
    assert phase > Phase.DETECTED
    assert script.run(1000, turn=1.1) == (phase, fault)
    assert script.run(299, turn=0.9) == (phase, fault)
    script.run(1, turn=1.1)
    assert script.run(299, turn=0.9) == (phase, fault)
    script.run(500, turn=0.1, turn_known=False)  # not seen is not quiet
    assert script.run(0) == (phase, fault)
    assert script.run(1, turn=0.9) == (Phase.HEALTHY, NO_FAULT)
    assert script.run(1, turn=1.1) == (Phase.DETECTED, NO_FAULT)


def test_a_verdict_on_a_motor_clears_by_the_motor_residuals(script):
    script.run(1, turn=1.1, motors=(1.1, 0.0))
    assert script.run(500, turn=0.1, motors=(1.1, 0.0)) == (Phase.ISOLATED, MOTOR_LEFT)
    assert script.run(299, turn=0.1) == (Phase.ISOLATED, MOTOR_LEFT)
    assert script.run(1, turn=0.1) == (Phase.HEALTHY, NO_FAULT)


def test_time_since_detection_and_the_delay_of_the_design_follow_the_verdict(script, config):
    delays = config.paper.delays
    script.run(21, turn=1.1)
    assert (script.isolation.since[0], script.isolation.delay_s[0]) == (20.0, delays.any_s)
    script.run(30, turn=1.1, lines=(1.1, 1.1, 0.1))
    assert (script.isolation.since[0], script.isolation.delay_s[0]) == (50.0, delays.crossed_lines_s)
