"""Stamps are multiples of four, never run back, and do not know what NTP does to the wall clock."""

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.clock import VehicleClock, WallClock

START_NS = 1_767_607_872_400_123_456


class FakeTime:
    """The two clocks of the machine, moved by hand."""

    def __init__(self, monkeypatch):
        self.wall_ns, self.monotonic_ns = START_NS, 5_000_000_000
        monkeypatch.setattr(time, "time_ns", lambda: self.wall_ns)
        monkeypatch.setattr(time, "monotonic_ns", lambda: self.monotonic_ns)

    def passes(self, ns):
        self.wall_ns += ns
        self.monotonic_ns += ns


@pytest.fixture
def fake(monkeypatch):
    return FakeTime(monkeypatch)


def test_the_first_stamp_is_the_wall_clock_in_microseconds(fake):
    assert WallClock().now_us() == START_NS // 1000 // 4 * 4


def test_stamps_are_multiples_of_four_and_keep_pace_with_the_monotonic_clock(fake):
    clock = WallClock()
    first_us, passed_ns = clock.now_us(), 0
    for step_ns in (1, 999, 1000, 3999, 4000, 12_345_678, 10**9, 10**15):
        fake.passes(step_ns)
        passed_ns += step_ns
        stamp_us = clock.now_us()
        assert stamp_us % 4 == 0
        assert abs(stamp_us - first_us - passed_ns / 1000) <= 5


@pytest.mark.parametrize("step_s", [-3600, -1, 1, 3600, 50 * 365 * 86_400])
def test_a_step_of_ntp_moves_no_stamp(fake, step_s):
    clock = WallClock()
    fake.passes(10_000_000)
    before_us = clock.now_us()
    fake.wall_ns += step_s * 10**9
    assert clock.now_us() == before_us
    fake.passes(1_000_000)
    assert clock.now_us() == before_us + 1000


def test_beside_a_fast_simulator_time_goes_faster_and_waits_are_shorter(fake):
    clock = WallClock(speedup=20.0)
    before_us = clock.now_us()
    fake.passes(1_000_000_000)
    assert clock.now_us() - before_us == 20_000_000
    assert clock.wait_s(0.1) == pytest.approx(0.005)
    assert WallClock().wait_s(0.1) == 0.1


def test_real_time_does_not_wait_for_the_vehicle(fake):
    clock = WallClock()
    before_us = clock.now_us()
    clock.advance_to(10**12)
    assert clock.now_us() == before_us


def test_real_stamps_never_run_back():
    clock = WallClock()
    stamps = [clock.now_us() for _ in range(10_000)]
    assert stamps == sorted(stamps)
    assert all(stamp % 4 == 0 for stamp in stamps)


def test_in_lockstep_time_passes_when_the_vehicle_says_so():
    clock = VehicleClock(epoch_us=1_000_000_000_000)
    assert [clock.now_us(), clock.now_us()] == [1_000_000_000_000] * 2
    clock.advance_to(2_500_003)
    assert clock.now_us() == 1_000_002_500_000
    assert clock.wait_s(0.1) == 0.1


def test_in_lockstep_the_epoch_is_the_wall_clock_of_the_start(fake):
    clock = VehicleClock()
    fake.passes(10**9)
    clock.advance_to(8)
    assert clock.now_us() == (START_NS // 1000 + 8) // 4 * 4


@given(st.lists(st.integers(0, 10**10), max_size=50))
def test_in_lockstep_too_stamps_are_multiples_of_four_and_never_run_back(reached_us):
    clock = VehicleClock(epoch_us=1_767_607_872_400_121)
    stamps = [clock.now_us()]
    for vehicle_us in reached_us:  # a message that comes late, a vehicle that reboots
        clock.advance_to(vehicle_us)
        stamps.append(clock.now_us())
    assert stamps == sorted(stamps)
    assert all(stamp % 4 == 0 for stamp in stamps)
