"""Pacing of simulated time against a wall clock that the test moves."""

import math

import pytest

from sitl.clock import LARGEST_LAG_S, Clock


class Wall:
    def __init__(self):
        self.now_s = 1000.0

    def __call__(self):
        return self.now_s


@pytest.mark.parametrize(("speedup", "wait_s"), [(1.0, 0.1), (10.0, 0.01), (0.5, 0.2)])
def test_a_step_is_due_when_its_time_has_passed_on_the_wall(speedup, wait_s):
    wall = Wall()
    clock = Clock(speedup, monotonic_s=wall)
    clock.wait_s(0)
    assert clock.wait_s(100_000) == pytest.approx(wait_s)
    wall.now_s += wait_s
    assert clock.wait_s(100_000) == pytest.approx(0.0, abs=1e-9)


def test_small_delays_are_caught_up_and_the_pace_is_kept():
    wall = Wall()
    clock = Clock(1.0, monotonic_s=wall)
    clock.wait_s(0)
    wall.now_s += 0.35
    assert [clock.wait_s(t_us) for t_us in (100_000, 200_000, 300_000)] == [0.0, 0.0, 0.0]
    assert clock.wait_s(400_000) == pytest.approx(0.05)


def test_a_long_sleep_is_not_made_up_for():
    wall = Wall()
    clock = Clock(1.0, monotonic_s=wall)
    clock.wait_s(0)
    wall.now_s += 100.0 + LARGEST_LAG_S
    assert clock.wait_s(100_000) == 0.0
    assert clock.wait_s(200_000) == pytest.approx(0.1)


@pytest.mark.parametrize("clock", [Clock(math.inf), Clock(lockstep=True), Clock.parse("max")])
def test_as_fast_as_it_goes_never_waits(clock):
    assert [clock.wait_s(t_us) for t_us in (0, 10**12)] == [0.0, 0.0]


def test_what_the_command_line_says_is_understood():
    assert Clock.parse("2.5").speedup == 2.5
    assert Clock.parse("lockstep").lockstep
    assert not Clock.parse("max").lockstep


@pytest.mark.parametrize("text", ["", "fast", "0", "-1", "nan"])
def test_a_speedup_that_is_none_is_refused_in_a_sentence(text):
    with pytest.raises(ValueError, match="give a number > 0"):
        Clock.parse(text)
