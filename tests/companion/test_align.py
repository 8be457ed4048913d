"""The grid closes by stamps alone: regular, bounded, deaf to strange clocks, the same however often somebody looks."""

import math
from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.align import PAUSE_AFTER_US, Aligner, Restart
from companion.decode import ClockKind, Sampled

MS, S = 1000, 1_000_000
PERIOD_US = 100 * MS
MAXIMAL_AGE_US = (1 * S, 250 * MS, 5 * S)
EPOCH_US = 1_700_000_000 * S
WRAP_MS = 2**32


def aligner():
    return Aligner(PERIOD_US, MAXIMAL_AGE_US)


def boot(t_ms, value=0.0, channel=0):
    return Sampled(ClockKind.BOOT_MS, t_ms % WRAP_MS, ((channel, value),))


def plain(value=0.0, channel=1):
    return Sampled(ClockKind.NONE, 0, ((channel, value),))


def usec(stamp, value=0.0, channel=1, kind=ClockKind.USEC64):
    return Sampled(kind, stamp, ((channel, value),))


def push(grid, sampled, arrival_us):
    return grid.due(arrival_us) + grid.push(sampled, arrival_us)


def identity(rows):
    return [(row.t_us, row.values.tobytes(), row.age_s.tobytes(), row.restart) for row in rows]


def flown(grid, start_ms, count, step_ms=20, arrival_us=EPOCH_US, channel=0):
    """Stamped samples in order, arriving as they are made; each carries its own time as its value."""
    rows = []
    for k in range(count):
        t_ms = start_ms + k * step_ms
        rows += push(grid, boot(t_ms, float(t_ms), channel), arrival_us + k * step_ms * MS)
    return rows


# -- properties -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Arrival:
    """One message, and how long after the one before it it came."""

    gap_us: int
    sampled: Sampled


@st.composite
def anything(draw):
    """Messages of every clock: steady, late, corrupt, rebooted, silent for a while."""
    t_ms = draw(st.integers(0, 100_000))
    out = []
    for _ in range(draw(st.integers(1, 60))):
        gap_ms = draw(st.sampled_from((0, 1, 20, 20, 20, 20, 99, 100, 101, 300, 2500, 11_000)))
        t_ms += gap_ms
        if draw(st.integers(0, 25)) == 0:
            t_ms = draw(st.integers(0, 200_000))  # a reboot or a jump
        kind = draw(st.sampled_from(("boot", "boot", "boot", "plain", "late", "corrupt", "usec", "usec32", "unix")))
        channel, value = draw(st.integers(0, 2)), draw(st.floats(-1e6, 1e6))
        sampled = {
            "boot": lambda t=t_ms, c=channel, v=value: boot(t, v, c),
            "plain": lambda c=channel, v=value: plain(v, c),
            "late": lambda t=t_ms, c=channel, v=value: boot(max(0, t - 150), v, c),
            "corrupt": lambda t=t_ms, c=channel, v=value: boot(t ^ (1 << 21), v, c),
            "usec": lambda t=t_ms, c=channel, v=value: usec(t * MS + 7, v, c),
            "usec32": lambda t=t_ms, c=channel, v=value: usec((t * MS + 7) % 2**32, v, c, ClockKind.USEC32),
            "unix": lambda t=t_ms, c=channel, v=value: usec(EPOCH_US + t * MS, v, c),
        }[kind]()
        out.append(Arrival(gap_ms * MS + draw(st.integers(0, 8)) * 4, sampled))
    return out


def feed(arrivals, looks=()):
    """-> (grid, rows); `looks`: (message, share of the gap before it) at which somebody looks besides."""
    grid, now_us, rows = aligner(), EPOCH_US, []
    for place, arrival in enumerate(arrivals):
        for share in sorted(share for at, share in looks if at == place):
            rows += grid.due(now_us + int(share * arrival.gap_us))
        now_us += arrival.gap_us
        rows += push(grid, arrival.sampled, now_us)
    for share in sorted(share for at, share in looks if at >= len(arrivals)):
        rows += grid.due(now_us + int(share * 20 * S))
    return grid, rows + grid.due(now_us + 20 * S)


@settings(max_examples=150)
@given(anything(), st.lists(st.tuples(st.integers(0, 60), st.floats(0.0, 1.0)), max_size=40))
def test_however_often_somebody_looks_the_rows_are_the_same(arrivals, looks):
    seldom_grid, seldom = feed(arrivals)
    often_grid, often = feed(arrivals, looks)
    assert identity(seldom) == identity(often)
    assert seldom_grid.counts == often_grid.counts


@settings(max_examples=150)
@given(anything())
def test_rows_are_regular_and_only_a_restart_breaks_them(arrivals):
    _, rows = feed(arrivals)
    assert all(row.t_us % PERIOD_US == 0 for row in rows)
    for before, after in pairwise(rows):
        assert after.restart is not None or after.t_us - before.t_us == PERIOD_US
    if rows:
        assert rows[0].restart is not None


@settings(max_examples=150)
@given(anything())
def test_no_value_is_older_than_its_channel_allows_and_unknown_has_no_age(arrivals):
    _, rows = feed(arrivals)
    for row in rows:
        assert row.values.shape == row.age_s.shape == (1, 3)
        assert np.array_equal(np.isnan(row.values), np.isnan(row.age_s))
        known = ~np.isnan(row.age_s)
        assert np.all(row.age_s[known] >= 0.0)
        assert np.all((row.age_s <= np.array(MAXIMAL_AGE_US) / S)[known])


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(1, 400)), min_size=1, max_size=60), st.data())
def test_a_row_holds_the_newest_sample_not_newer_than_itself(samples, data):
    """The judge looks at all samples at once; the link delays each by less than the patience of one period."""
    grid, rows, t_ms, arrived_us = aligner(), [], 5000, 0
    stamps, kept = ([], [], []), ([], [], [])
    for channel, step_ms in samples:
        t_ms += step_ms
        arrived_us = max(arrived_us, EPOCH_US + t_ms * MS + data.draw(st.integers(0, 99)) * MS)
        value = float(len(stamps[channel]) + 1000 * channel)
        stamps[channel].append(t_ms * MS)
        kept[channel].append(value)
        rows += push(grid, boot(t_ms, value, channel), arrived_us)
    for row in rows:
        for channel in range(3):
            place = bisect_right(stamps[channel], row.t_us) - 1
            age_us = row.t_us - stamps[channel][place] if place >= 0 else math.inf
            if age_us <= MAXIMAL_AGE_US[channel]:
                assert row.values[0, channel] == kept[channel][place]
                assert row.age_s[0, channel] == pytest.approx(age_us / S, abs=1e-12)
            else:
                assert math.isnan(row.values[0, channel])
    if rows:
        assert [row.t_us for row in rows] == list(range(rows[0].t_us, t_ms * MS, PERIOD_US))


# -- rows, one by one -------------------------------------------------------------------------------------------------


def test_a_row_closes_when_a_newer_sample_comes_and_not_at_its_own_time():
    grid = aligner()
    assert push(grid, boot(950, 1.0), EPOCH_US) == []
    assert push(grid, boot(1000, 2.0), EPOCH_US + 50 * MS) == []
    (row,) = push(grid, boot(1001, 3.0), EPOCH_US + 51 * MS)
    assert (row.t_us, row.values[0, 0], row.age_s[0, 0], row.restart) == (1 * S, 2.0, 0.0, Restart.FIRST)


def test_a_row_that_nothing_closes_is_overdue_one_period_after_its_time():
    grid = aligner()
    push(grid, boot(1000, 1.0), EPOCH_US)
    assert grid.due(EPOCH_US + PERIOD_US) == []
    assert [row.t_us for row in grid.due(EPOCH_US + PERIOD_US + 1)] == [1 * S]
    assert [row.t_us for row in grid.due(EPOCH_US + 3 * PERIOD_US + 1)] == [1 * S + PERIOD_US, 1 * S + 2 * PERIOD_US]


def test_the_smallest_delay_seen_tells_when_a_row_is_overdue():
    grid = aligner()
    push(grid, boot(1000), EPOCH_US + 80 * MS)
    push(grid, boot(1010), EPOCH_US + 20 * MS + 80 * MS)
    push(grid, boot(1100), EPOCH_US + 100 * MS)  # this one took no time at all
    push(grid, boot(1130), EPOCH_US + 180 * MS)
    assert grid.offset_us == EPOCH_US - 1000 * MS
    assert grid.due(EPOCH_US + 200 * MS)[1:] == []
    assert grid.due(EPOCH_US + 300 * MS) == []
    assert len(grid.due(EPOCH_US + 300 * MS + 1)) == 1


def test_a_clock_that_drifts_is_followed_within_ten_seconds():
    grid = aligner()
    flown(grid, 1000, 50)
    slower_us = EPOCH_US + 300 * MS  # the link got longer
    flown(grid, 2000, 600, arrival_us=slower_us + 1000 * MS)
    assert grid.offset_us == slower_us - 1000 * MS


def test_a_late_sample_neither_opens_a_closed_row_nor_overwrites_a_newer_one():
    grid = aligner()
    push(grid, boot(1000, 1.0), EPOCH_US)
    (first,) = push(grid, boot(1050, 2.0), EPOCH_US + 50 * MS)
    assert first.t_us == 1 * S
    assert push(grid, boot(1040, 3.0), EPOCH_US + 60 * MS) == []
    assert push(grid, boot(1045, 4.0, channel=1), EPOCH_US + 60 * MS) == []
    assert push(grid, boot(995, 6.0, channel=2), EPOCH_US + 60 * MS) == []
    (second,) = push(grid, boot(1101, 5.0), EPOCH_US + 101 * MS)
    assert second.t_us == 1 * S + PERIOD_US
    assert second.values[0, 0] == 2.0
    assert second.values[0, 1] == 4.0
    assert second.age_s[0, 1] == pytest.approx(0.055)
    assert second.values[0, 2] == 6.0


def test_a_sample_newer_than_a_row_leaves_no_trace_in_it():
    grid = aligner()
    push(grid, boot(990, 1.0), EPOCH_US)
    (row,) = push(grid, boot(1010, 2.0, channel=1), EPOCH_US + 20 * MS)
    assert row.values[0, 0] == 1.0
    assert math.isnan(row.values[0, 1])


def test_a_value_is_held_for_just_as_long_as_its_channel_allows():
    grid = aligner()
    push(grid, boot(1000, 1.0), EPOCH_US)
    rows = {row.t_us: row for row in grid.due(EPOCH_US + 5 * S)}
    assert rows[2 * S].values[0, 0] == 1.0
    assert rows[2 * S].age_s[0, 0] == 1.0
    assert math.isnan(rows[2 * S + PERIOD_US].values[0, 0])


# -- messages without a clock of the vehicle --------------------------------------------------------------------------


def test_before_any_clock_is_known_samples_without_one_are_counted_and_nothing_else():
    grid = aligner()
    assert push(grid, plain(1.0), EPOCH_US) == []
    assert push(grid, usec(5 * S), EPOCH_US) == []
    assert grid.due(EPOCH_US + 100 * S) == []
    assert grid.counts == {"before_clock": 2}
    assert grid.vehicle_time_us(EPOCH_US) is None


def test_an_unstamped_sample_belongs_to_the_newest_stamped_one():
    grid = aligner()
    push(grid, boot(1040), EPOCH_US)
    push(grid, plain(7.0), EPOCH_US + 50 * MS)
    (row,) = push(grid, boot(1101), EPOCH_US + 61 * MS)
    assert row.values[0, 1] == 7.0
    assert row.age_s[0, 1] == pytest.approx(0.060)


def test_where_stamped_messages_have_stopped_the_arrival_less_offset_and_patience_stands_in():
    grid = aligner()
    push(grid, boot(1000), EPOCH_US)
    push(grid, plain(7.0), EPOCH_US + 450 * MS)
    (row,) = grid.due(EPOCH_US + 550 * MS)[-1:]
    assert (row.t_us, row.values[0, 1]) == (1 * S + 400 * MS, 7.0)
    assert row.age_s[0, 1] == pytest.approx(0.050)


def test_unix_time_in_time_usec_is_taken_as_no_stamp_at_all():
    told = []
    for sample in (usec(EPOCH_US + 123, 7.0), plain(7.0)):
        grid = aligner()
        push(grid, boot(1040), EPOCH_US)
        push(grid, sample, EPOCH_US + 50 * MS)
        told.append(identity(push(grid, boot(1201), EPOCH_US + 161 * MS)))
        assert grid.counts == {}
    assert len(told[0]) == 2
    assert told[0] == told[1]


def test_microseconds_since_boot_are_a_clock():
    grid = aligner()
    push(grid, boot(1000), EPOCH_US)
    push(grid, usec(1_030_500, 7.0), EPOCH_US + 31 * MS)
    row = push(grid, boot(1101), EPOCH_US + 101 * MS)[-1]
    assert row.age_s[0, 1] == pytest.approx(0.0695)


def test_a_stamp_in_microseconds_alone_restarts_nothing():
    grid = aligner()
    flown(grid, 20_000, 50)
    for k in range(10):
        push(grid, usec(17_500_000 + 20_000 * k, kind=ClockKind.USEC32), EPOCH_US + (1000 + 20 * k) * MS)
    assert grid.counts == {"off_clock": 10}
    assert grid.newest_us == (20_000 + 49 * 20) * MS


# -- clocks that wrap, run back, jump ---------------------------------------------------------------------------------


def test_milliseconds_wrap_after_forty_nine_days_and_nobody_notices():
    grid = aligner()
    rows = flown(grid, WRAP_MS - 1000, 100)
    assert grid.counts == {}
    assert grid.newest_us == (WRAP_MS - 1000 + 99 * 20) * MS
    assert all(after.t_us - before.t_us == PERIOD_US for before, after in pairwise(rows))
    assert [row.restart for row in rows if row.restart] == [Restart.FIRST]


def test_the_clock_goes_on_over_any_number_of_wraps():
    grid = aligner()
    day_ms = 86_400_000
    for days in range(0, 400, 10):
        push(grid, boot(days * day_ms + 1000), EPOCH_US + days * day_ms * MS)
        assert grid.newest_us == (days * day_ms + 1000) * MS
    assert grid.counts == {}


def test_a_late_sample_from_before_the_wrap_is_just_late():
    grid = aligner()
    flown(grid, WRAP_MS - 1000, 51, channel=0)
    for _ in range(5):
        push(grid, boot(WRAP_MS - 30, 7.0, channel=1), EPOCH_US + 1000 * MS)
    assert grid.counts == {}
    row = push(grid, boot(WRAP_MS + 105), EPOCH_US + 1105 * MS)[-1]
    assert row.values[0, 1] == 7.0
    assert row.restart is None


def test_microseconds_of_32_bits_wrap_after_seventy_one_minutes():
    grid = aligner()
    start_ms = 2**32 // 1000 - 500
    flown(grid, start_ms, 50)
    rows, stamps = [], []
    for k in range(50):
        t_ms = start_ms + 1000 + 20 * k
        now_us = EPOCH_US + (1000 + 20 * k) * MS
        rows += push(grid, boot(t_ms), now_us)
        stamps.append((t_ms + 7) * MS)
        rows += push(grid, usec(stamps[-1] % 2**32, float(k), kind=ClockKind.USEC32), now_us + 7 * MS)
    assert grid.counts == {}
    assert stamps[0] > 2**32
    for row in rows[1:]:
        place = bisect_right(stamps, row.t_us) - 1
        assert row.values[0, 1] == float(place)
        assert row.age_s[0, 1] == pytest.approx((row.t_us - stamps[place]) / S, abs=1e-12)


@pytest.mark.parametrize(
    ("stamps_ms", "expected"),
    [
        ((100, 120, 140), Restart.REBOOT),
        ((400_000, 400_020, 400_040), Restart.JUMP),
        ((WRAP_MS - 1000, WRAP_MS - 980, WRAP_MS - 960), Restart.JUMP),
    ],
)
def test_three_stamps_that_agree_restart_the_grid(stamps_ms, expected):
    grid = aligner()
    flown(grid, 60_000, 100)
    now_us = EPOCH_US + 2000 * MS
    for k, t_ms in enumerate(stamps_ms):
        assert grid.newest_us == (60_000 + 99 * 20) * MS
        push(grid, boot(t_ms), now_us + k * 20 * MS)
    assert grid.newest_us == stamps_ms[2] * MS
    rows = flown(grid, stamps_ms[2] + 20, 20, arrival_us=now_us + 60 * MS)
    assert rows[0].restart is expected
    assert rows[0].t_us == math.ceil(stamps_ms[2] / 100) * PERIOD_US
    assert math.isnan(rows[0].values[0, 1])
    assert all(row.restart is None for row in rows[1:])


def test_nothing_of_before_a_reboot_is_held():
    grid = aligner()
    push(grid, boot(60_000, 9.0, channel=2), EPOCH_US)
    flown(grid, 60_020, 10, arrival_us=EPOCH_US + 20 * MS)
    rows = flown(grid, 1000, 20, arrival_us=EPOCH_US + 400 * MS)
    assert rows[-1].t_us < 2 * S
    after = [row for row in rows if row.t_us < 2 * S]
    assert len(after) == 3
    assert all(math.isnan(row.values[0, 2]) for row in after)
    assert [row.values[0, 0] for row in after] == [1100.0, 1200.0, 1300.0]


@pytest.mark.parametrize("corrupt_ms", [0, 1000, 50_000, 90_000, 1_000_000, 2**31, 2**32 - 1])
@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_strange_stamps_restart_nothing_and_are_not_used(corrupt_ms, count):
    grid, clean = aligner(), aligner()
    flown(grid, 60_000, 101)
    flown(clean, 60_000, 101)
    for k in range(count):
        assert push(grid, boot(corrupt_ms + k, 99.0), EPOCH_US + 2010 * MS) == []
    assert grid.counts["off_clock"] == count
    rest = [flown(each, 62_020, 50, arrival_us=EPOCH_US + 2020 * MS) for each in (grid, clean)]
    assert identity(rest[0]) == identity(rest[1])


def test_strange_stamps_that_do_not_agree_restart_nothing_however_many():
    grid = aligner()
    flown(grid, 60_000, 101)
    for k, corrupt_ms in enumerate((0, 1_000_000, 30_000, 2**31, 7_000, 500_000)):
        assert push(grid, boot(corrupt_ms, 99.0), EPOCH_US + (2010 + k) * MS) == []
    assert grid.counts == {"off_clock": 6}
    assert flown(grid, 62_020, 50, arrival_us=EPOCH_US + 2020 * MS)[0].restart is None


def test_a_good_stamp_in_between_clears_the_suspicion():
    grid = aligner()
    flown(grid, 60_000, 101)
    for k in range(20):
        push(grid, boot(100 + k, 99.0), EPOCH_US + (2000 + 20 * k) * MS)
        push(grid, boot(62_010 + 20 * k), EPOCH_US + (2010 + 20 * k) * MS)
    assert grid.counts == {"off_clock": 20}


def test_up_to_two_seconds_back_is_a_late_message_and_no_reboot():
    grid = aligner()
    flown(grid, 60_000, 101)
    for k in range(10):
        push(grid, boot(60_000 + k, 99.0, channel=1), EPOCH_US + 2010 * MS)
    assert grid.counts == {}
    assert grid.newest_us == 62_000 * MS


# -- silence ----------------------------------------------------------------------------------------------------------


def test_rows_go_on_for_ten_seconds_of_silence_and_then_pause():
    grid = aligner()
    flown(grid, 60_000, 51)
    rows = grid.due(EPOCH_US + 3600 * S)
    assert rows[-1].t_us == 61_000 * MS + PAUSE_AFTER_US
    assert np.isnan(rows[-1].values).all()
    assert grid.due(EPOCH_US + 7200 * S) == []


def test_after_a_pause_the_grid_begins_anew_where_the_vehicle_is():
    grid = aligner()
    flown(grid, 60_000, 51)
    grid.due(EPOCH_US + 40 * S)
    rows = flown(grid, 120_050, 20, arrival_us=EPOCH_US + 60 * S + 50 * MS)
    assert (rows[0].restart, rows[0].t_us) == (Restart.SILENCE, 120_100 * MS)


def test_a_shorter_silence_is_bridged_without_a_restart():
    grid = aligner()
    rows = flown(grid, 60_000, 51)
    rows += flown(grid, 70_500, 20, arrival_us=EPOCH_US + 10_500 * MS)
    assert [row.restart for row in rows if row.restart] == [Restart.FIRST]
    assert all(after.t_us - before.t_us == PERIOD_US for before, after in pairwise(rows))


def test_vehicle_time_is_told_between_rows_and_never_before_the_newest_stamp():
    grid = aligner()
    flown(grid, 60_000, 51)
    assert grid.vehicle_time_us(EPOCH_US + 1000 * MS) == 61_000 * MS
    assert grid.vehicle_time_us(EPOCH_US + 1500 * MS) == 61_500 * MS
    assert grid.vehicle_time_us(EPOCH_US) == 61_000 * MS


def test_the_stamp_at_which_a_row_falls_due_is_told_beforehand():
    grid = aligner()
    assert grid.due_us == math.inf
    for turn, delay_ms in enumerate((40, 10, 70, 10)):
        flown(grid, 60_000 + 2_500 * turn, 21, arrival_us=EPOCH_US + (2_500 * turn + delay_ms) * MS)
        due_us = grid.due_us
        assert grid.due(due_us - 1) == []
        assert len(grid.due(due_us)) == 1
        assert grid.due_us == due_us + PERIOD_US
