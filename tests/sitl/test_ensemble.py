"""Batches of flights: what is drawn for each, and the rows that a companion would take from them."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from sitl.autopilot.frames import frame_v2, layout, pack
from sitl.ensemble import RELEASE_US, Ensemble, Grid, draw_faults, last_onset_s, step_s
from sitl.link import Link, Listener, Pipe, Reading
from sitl.vehicle import Field, Stream, Vehicle

KNOWN = ("motor:left", "motor:right", "torn:left", "torn:right", "crossed")
PERIOD_US = 100_000
SECOND_US = 1_000_000
CHANNELS = ("armed", "height_m", "roll_rad", "wind_m_s")
AGES_US = (5 * SECOND_US, SECOND_US, SECOND_US, SECOND_US)
READINGS = (
    Reading("HEARTBEAT", "base_mode", 0, 1.0),
    Reading("GLOBAL_POSITION_INT", "relative_alt", 1, 1e-3),
    Reading("ATTITUDE", "roll", 2, 1.0),
    Reading("WIND", "speed", 3, 1.0),
)
VEHICLE = Vehicle(
    name="stone",
    mav_type=0,
    modes={},
    streams=(
        Stream("GLOBAL_POSITION_INT", 5.0, 5.0, (Field("relative_alt", "height_m", 1000.0),)),
        Stream("ATTITUDE", 10.0, 50.0, (Field("roll", "roll_rad"),)),
        Stream("WIND", 2.0, 2.0, (Field("speed", "wind_m_s"),)),
    ),
    parameters=(),
    injections=(),
    fault_ids=KNOWN,
    steps_s=(0.1, 0.02),
)


def listener(period_us=PERIOD_US, readings=READINGS, ages_us=AGES_US, lost=0.02, late=0.1, **rates_hz):
    return Listener(readings, rates_hz, period_us, ages_us, lost, late)


@dataclass
class Stones:
    """Falling stones: what each channel says is the time since release, so that a row tells when it was sensed."""

    landing_s: tuple[float, ...]
    channels: tuple[str, ...] = ("wind_m_s", "height_m", "roll_rad")
    home: tuple[float, float, float] = (0.0, 0.0, 0.0)
    dark_s: float = math.inf  # from here on there is no height
    time_s: float = 0.0
    steps: list[float] = field(default_factory=list)

    def step(self, dt_s):
        self.steps.append(dt_s)
        self.time_s = round(sum(self.steps), 6)
        return self.observe()

    def observe(self):
        values = np.full((len(self.landing_s), 3), self.time_s)
        if self.time_s >= self.dark_s:
            values[:, 1] = math.nan
        age_s = np.zeros_like(values)
        age_s[:, 1] = round(self.time_s % 0.2, 6)  # its sensor is slower
        return values, age_s

    def command(self, flight, name, value):
        raise KeyError(name)

    @property
    def landed(self):
        return self.time_s >= np.array(self.landing_s) - 1e-9


def fly(fleet, duration_s=3.0, listens=None, seeds=None, period_us=PERIOD_US):
    """-> (ensemble, rows by their time in ms)."""
    grid = Grid(CHANNELS, period_us, AGES_US)
    ensemble = Ensemble(VEHICLE, fleet, seeds or range(len(fleet.landing_s)), grid, listens)
    return ensemble, {row.t_us // 1000: row for row in ensemble.rows(duration_s)}


# Draws


def test_a_flights_fault_depends_on_its_seed_and_not_on_its_company():
    choices = ("none", "motor/stuck", "torn", "crossed")
    together = draw_faults(range(200), choices, KNOWN, 600.0)
    assert [draw_faults([seed], choices, KNOWN, 600.0)[0] for seed in range(200)] == together
    assert draw_faults(range(199, -1, -1), choices, KNOWN, 600.0) == together[::-1]


def test_each_choice_and_each_place_left_open_is_drawn_with_even_chance():
    drawn = [fault.id if fault else "none" for fault in draw_faults(range(4000), ("none", "motor", "crossed"), KNOWN, 600.0)]
    shares = {name: drawn.count(name) / len(drawn) for name in set(drawn)}
    expected = {"none": 1 / 3, "crossed": 1 / 3, "motor:left": 1 / 6, "motor:right": 1 / 6}
    assert shares == pytest.approx(expected, abs=0.03)  # four standard deviations


def test_a_kind_is_kept_behind_a_place_that_is_drawn():
    ids = {fault.id for fault in draw_faults(range(50), ("motor/stuck",), KNOWN, 600.0)}
    assert ids == {"motor:left/stuck", "motor:right/stuck"}


def test_onsets_are_whole_seconds_up_to_500_and_leave_100_seconds_of_the_flight():
    onsets_s = [fault.onset_s for fault in draw_faults(range(5000), ("crossed",), KNOWN, 600.0)]
    assert (min(onsets_s), max(onsets_s)) == (0.0, 500.0)
    assert all(onset_s == round(onset_s) for onset_s in onsets_s)
    assert np.mean(onsets_s) == pytest.approx(250.0, abs=8.0)
    assert [last_onset_s(duration_s) for duration_s in (2000.0, 600.0, 240.5, 100.0, 60.0)] == [500, 500, 140, 0, 0]


def test_a_fault_that_nobody_knows_is_refused_with_those_that_are():
    with pytest.raises(ValueError, match=r"unknown fault 'gremlins'; this airframe knows motor:left, .*, and none"):
        draw_faults([1], ("none", "gremlins"), KNOWN, 600.0)
    with pytest.raises(ValueError, match="unknown fault 'motor:middle'"):
        draw_faults([1], ("motor:middle",), KNOWN, 600.0)


# Rows


def test_rows_begin_on_the_ground_and_end_before_touchdown_or_with_the_flight():
    ensemble, rows = fly(Stones((1.0, math.inf)))
    assert min(rows) == -RELEASE_US // 1000 + 100
    assert max(rows) == 2900
    assert not any(rows[t_ms].flying.any() for t_ms in rows if t_ms < 0)
    assert [t_ms for t_ms in rows if rows[t_ms].flying[0]] == list(range(0, 900, 100))
    assert [t_ms for t_ms in rows if rows[t_ms].flying[1]] == list(range(0, 3000, 100))
    assert ensemble.touchdown_us.tolist() == [SECOND_US, -1]


def test_a_batch_ends_when_the_last_flight_is_down():
    fleet = Stones((1.0, 1.5))
    _, rows = fly(fleet, duration_s=600.0)
    assert max(rows) == 1400
    assert fleet.time_s == 1.5


def test_without_a_line_rows_hold_the_fleets_channels_by_name_with_their_ages():
    _, rows = fly(Stones((math.inf,)))
    for t_ms in (0, 100, 1300):
        assert rows[t_ms].values[0].tolist() == [1.0, t_ms / 1000, t_ms / 1000, t_ms / 1000]
        assert rows[t_ms].age_s[0] == pytest.approx([0.0, t_ms / 1000 % 0.2, 0.0, 0.0], abs=1e-9)


def test_arming_and_disarming_are_heard_of_a_row_early_for_a_heartbeat_carries_no_time():
    for listens in (None, listener()):
        _, rows = fly(Stones((1.0, 2.0)), listens=listens)
        assert [t_ms for t_ms in sorted(rows) if rows[t_ms].values[0, 0] == 1.0] == list(range(-100, 900, 100))
        assert rows[900].values[0, 0] == 0.0


def test_without_a_line_a_value_that_is_absent_or_older_than_its_maximal_age_is_unknown():
    _, rows = fly(Stones((math.inf,), dark_s=1.0))
    assert rows[900].values[0, 1] == 0.9
    assert np.isnan(rows[1000].values[0, 1])
    assert np.isnan(rows[1000].age_s[0, 1])
    grid = Grid(CHANNELS, PERIOD_US, (SECOND_US, 50_000, SECOND_US, SECOND_US))
    ensemble = Ensemble(VEHICLE, Stones((math.inf,)), [1], grid)
    held = {row.t_us: row.values[0, 1] for row in ensemble.rows(0.5)}
    assert held[200_000] == 0.2
    assert np.isnan(held[100_000])  # its sample is 0.1 s old


def test_a_channel_that_the_simulator_does_not_give_is_refused():
    with pytest.raises(ValueError, match="does not give the channel depth_m"):
        Ensemble(VEHICLE, Stones((1.0,)), [1], Grid(("armed", "depth_m"), PERIOD_US, (1, 1)))


def test_the_stock_step_is_made_where_it_fits_into_the_rows_and_else_a_shorter_one():
    assert step_s(VEHICLE, 200_000) == 0.1
    assert step_s(VEHICLE, 20_000) == 0.02
    with pytest.raises(ValueError, match="no step of the simulator"):
        step_s(VEHICLE, 30_000)


@pytest.mark.parametrize("listens", [None, listener(40_000, ATTITUDE=25.0)])
def test_several_steps_a_row_give_rows_of_the_grid(listens):
    fleet = Stones((math.inf,))
    _, rows = fly(fleet, duration_s=2.0, listens=listens, period_us=40_000)
    assert fleet.steps[0] == 0.02
    assert [t_ms for t_ms in sorted(rows) if t_ms >= 0] == list(range(0, 2000, 40))
    if listens is None:
        assert [rows[t_ms].values[0, 2] for t_ms in range(0, 2000, 40)] == pytest.approx(np.arange(0.0, 2.0, 0.04))
    else:
        on_time = [rows[t_ms].age_s[0, 2] for t_ms in range(0, 2000, 40)]
        assert 0.7 < on_time.count(0.0) / len(on_time) < 1.0
        assert set(np.round(on_time, 6)) <= {0.0, 0.04, 0.08, 0.12}


# The line


def line(fleet_values, *, seeds=(1,), lost=0.0, late=0.0, steps=40, listens=None):
    """Rows of a standing fleet behind the line: [(values, age_s), ...] from the row at 0.1 s on."""
    listens = replace(listens or listener(), lost=lost, late=late)
    link = Link(VEHICLE, ("wind_m_s", "height_m", "roll_rad"), listens, seeds)
    rows = []
    for k in range(1, steps + 1):
        values = np.tile(fleet_values(k), (len(seeds), 1))
        link.take(k * PERIOD_US, values, np.zeros_like(values), np.ones(len(seeds), dtype=bool))
        if k > 1:
            rows.append(link.row)
    return rows


def test_a_field_is_rounded_as_the_wire_rounds_it_and_read_by_the_listeners_factor():
    values, _ = line(lambda _: [1.0 / 3.0, 12.3456789, 0.1])[20]
    assert values[0].tolist() == [1.0, 12346 * 1e-3, float(np.float32(0.1)), float(np.float32(1.0 / 3.0))]


def test_a_channel_comes_as_often_as_its_message_and_is_held_with_its_age_until_it_is_too_old():
    rows = line(lambda k: [0.1 * k] * 3, listens=listener(ATTITUDE=0.5))
    ages_s = np.array([age_s[0] for _, age_s in rows])  # rows at 0.1, 0.2, ... s
    assert ages_s[10:20, 1] == pytest.approx([0.1, 0.0] * 5, abs=1e-9)  # 5 Hz
    winds_s = np.array([age_s[0, 3] for _, age_s in line(lambda k: [0.1 * k] * 3)])
    assert winds_s[10:20] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.0] * 2, abs=1e-9)  # 2 Hz
    assert ages_s[19:30, 2] == pytest.approx(np.arange(11) * 0.1, abs=1e-9)  # every 2 s
    assert np.isnan(ages_s[30:38, 2]).all()  # older than 1 s
    assert np.isnan(rows[34][0][0, 2])


def test_a_message_that_would_have_to_invent_a_number_stays_away_and_a_float_says_nothing():
    rows = line(lambda k: [math.nan if k > 20 else 0.1 * k] * 3)
    assert np.isnan(rows[-1][0][0, 1:]).all()
    assert rows[22][0][0, 1] == pytest.approx(2.0)  # held
    assert rows[22][1][0, 1] == pytest.approx(0.3)


def test_what_is_no_measurement_is_as_if_it_had_not_come():
    readings = (Reading("ATTITUDE", "roll", 0, 1.0, limit=10.0), Reading("WIND", "speed", 1, 1.0, unknown=7.0))
    listens = listener(readings=readings, ages_us=(SECOND_US, SECOND_US), WIND=10.0)
    rows = line(lambda k: [7.0 if k == 20 else 8.0, 1.0, 11.0 if k == 20 else 9.0], listens=listens)
    assert rows[19][0][0].tolist() == [9.0, 8.0]
    assert rows[19][1][0] == pytest.approx([0.1, 0.1])
    assert rows[20][1][0] == pytest.approx([0.0, 0.0])


def test_a_field_that_the_vehicle_does_not_fill_says_what_its_constant_says():
    stream = Stream("GPS_RAW_INT", 5.0, 5.0, (Field("vel", "wind_m_s", 100.0),), {"fix_type": 3})
    vehicle = Vehicle("stone", 0, {}, (stream,), (), (), KNOWN, (0.1,))
    readings = (Reading("GPS_RAW_INT", "fix_type", 0, 1.0), Reading("GPS_RAW_INT", "eph", 1, 0.01, unknown=65535.0))
    listens = listener(readings=readings, ages_us=(SECOND_US, SECOND_US), lost=0.0, late=0.0)
    link = Link(vehicle, ("wind_m_s",), listens, [1])
    for k in range(1, 6):
        link.take(k * PERIOD_US, np.ones((1, 1)), np.zeros((1, 1)), np.ones(1, dtype=bool))
    assert link.row[0][0, 0] == 3.0
    assert np.isnan(link.row[0][0, 1])  # not known, and said so


def test_messages_are_lost_whole_in_their_share_and_late_ones_come_a_row_later_if_nothing_newer_did():
    seeds = range(40)
    rows = line(lambda k: [float(k)] * 3, seeds=seeds, lost=0.05, late=0.10, steps=1000)
    ages = np.rint(np.array([age_s for _, age_s in rows[20:]]) * 10)  # in rows
    stamps = np.array([values for values, _ in rows[20:]]) + ages
    rolls = ages[..., 2]
    # 85 % are on time.  Of the late, one in 13 still makes its row: nothing stamped arrived before it in the next step.
    assert np.mean(rolls == 0) == pytest.approx(0.85 + 0.10 * 0.15 * 0.525, abs=0.006)
    assert np.mean(rolls == 1) == pytest.approx(0.142 * 0.95, abs=0.006)  # it missed, the one before did not
    heights = ages[..., 1][np.arange(21, 21 + len(ages)) % 2 == 0]  # rows at which one is sent
    assert np.mean(heights == 0) == pytest.approx(0.95, abs=0.006)  # a receiver's line loses, and delays nothing
    assert (stamps[..., 2] == stamps[0, 0, 2] + np.arange(len(stamps))[:, None]).all()  # the age tells when it was sensed


def test_a_flights_line_has_the_same_draws_alone_and_in_company():
    together = line(lambda k: [float(k)] * 3, seeds=(5, 6, 7), lost=0.3, late=0.3, steps=250)
    for f, seed in enumerate((5, 6, 7)):
        alone = line(lambda k: [float(k)] * 3, seeds=(seed,), lost=0.3, late=0.3, steps=250)
        for (values, age_s), (own_values, own_age_s) in zip(together, alone, strict=True):
            assert np.array_equal(values[f], own_values[0], equal_nan=True)
            assert np.array_equal(age_s[f], own_age_s[0], equal_nan=True)


def test_an_unstamped_message_belongs_to_the_newest_stamp_before_it():
    readings = (Reading("WIND", "speed", 0, 1.0), Reading("ATTITUDE", "roll", 1, 1.0))
    streams = (VEHICLE.streams[2], VEHICLE.streams[1])  # the wind is sent first
    vehicle = Vehicle("stone", 0, {}, streams, (), (), KNOWN, (0.1,))
    listens = listener(readings=readings, ages_us=(SECOND_US, SECOND_US), lost=0.0, late=0.0)
    link = Link(vehicle, ("wind_m_s", "roll_rad"), listens, [1])
    seen = {}
    for k in range(1, 12):
        link.take(k * PERIOD_US, np.full((1, 2), float(k)), np.zeros((1, 2)), np.ones(1, dtype=bool))
        seen[k - 1] = link.row
    assert seen[9][0][0].tolist() == [10.0, 9.0]  # the wind of 1.0 s came before any stamp of 1.0 s
    assert seen[9][1][0] == pytest.approx([0.0, 0.0])


def frames(now_us, armed):
    """What the autopilot sends in one step: a heartbeat each second, attitude, and an answer that nobody judges by."""
    mode = 128 if armed else 0
    beats = [pack("HEARTBEAT", base_mode=mode)] * (2 if now_us == 2 * SECOND_US else now_us % SECOND_US == 0)
    attitude = pack("ATTITUDE", time_boot_ms=now_us // 1000, roll=now_us * 1e-6)
    return [frame_v2(each, 0, 1, 1) for each in (*beats, attitude, pack("COMMAND_ACK", command=1))]


def test_the_pipe_loses_and_delays_the_frames_whose_samples_the_batch_loses_and_delays():
    listens, seed = listener(lost=0.2, late=0.3), 9
    channels = ("wind_m_s", "height_m", "roll_rad")
    pipe = Pipe(VEHICLE, channels, listens, seed)
    link = Link(VEHICLE, channels, listens, [seed])
    arrived_us, rows = [], []  # by step: stamps of the attitudes in the order of their arrival; rows from the one at 0 s
    for k in range(1, 300):
        now_us, armed = k * PERIOD_US, k >= 20
        arrived = pipe.carry(frames(now_us, armed), now_us, armed)
        attitudes = [frame for frame in arrived if int.from_bytes(frame[7:10], "little") == layout("ATTITUDE").id]
        arrived_us.append([int.from_bytes(frame[10:14], "little") * 1000 for frame in attitudes])
        link.take(now_us, np.array([[math.nan, math.nan, now_us * 1e-6]]), np.zeros((1, 3)), np.array([armed]))
        rows.append(link.row)
    stamps_us = [stamp_us for step in arrived_us for stamp_us in step]
    assert len(stamps_us) == pytest.approx(0.8 * 299, abs=20)  # a fifth is lost,
    assert stamps_us != sorted(stamps_us)  # and some arrive behind newer ones
    newest_us = -1
    for k in range(1, 299):
        newest_us = max([newest_us, *arrived_us[k - 1]])
        for stamp_us in arrived_us[k]:  # of the next step what comes before the row is closed
            if stamp_us > k * PERIOD_US:
                break
            newest_us = max(newest_us, stamp_us)
        age_s = (k * PERIOD_US - newest_us) * 1e-6
        assert newest_us < 0 or age_s > 1.0 or rows[k][1][0, 2] == pytest.approx(age_s, abs=1e-9)


def test_the_pipe_lets_pass_what_the_listener_does_not_read():
    pipe = Pipe(VEHICLE, ("wind_m_s", "height_m", "roll_rad"), listener(lost=1.0, late=0.0), 3)
    acknowledgement = frame_v2(pack("COMMAND_ACK", command=1), 0, 1, 1)
    attitude = frame_v2(pack("ATTITUDE", roll=1.0), 0, 1, 1)
    assert pipe.carry([attitude, acknowledgement], PERIOD_US, False) == [acknowledgement]
