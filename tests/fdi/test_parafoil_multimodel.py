"""Our detectors over flights of the simulated vehicle and of the linear one: what they name, when, and what they bear."""

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import fdi.parafoil as parafoil
from fdi.parafoil import turns
from fdi.parafoil.hypotheses import BROKEN_LEFT, CROSSED, GPS_STATES, GYRO_STATES, HEALTHY, HYPOTHESES, LINEAR_STATES
from fdi.parafoil.motors import KIND, KIND_SATURATION, KIND_STUCK
from fdi.parafoil.multimodel import FIX_AGO_S, figures_of
from fdi.verdict import NO_FAULT, Phase
from sitl.vehicle import Injected

AT = {name: index for index, name in enumerate(parafoil.CHANNELS)}
RESIDUAL = {name: index for index, name in enumerate(parafoil.RESIDUALS)}
IDS = [fault.id for fault in parafoil.FAULTS]
NORMAL, SWAPPED = ({"SERVO1_FUNCTION": a, "SERVO2_FUNCTION": b} for a, b in ((77, 78), (78, 77)))
GPS = slice(AT["velocity_north_m_s"], AT["altitude_m"] + 1)
ATTITUDE = slice(AT["yaw_rate_rad_s"], AT["pitch_rad"] + 1)
COMMANDS = slice(AT["output_1_us"], AT["output_2_us"] + 1)
ENCODERS = slice(AT["wheel_distance_1_m"], AT["wheel_distance_2_m"] + 1)
KINDS = (
    "motor:left/stuck",
    "motor:right/stuck",
    "motor:left/saturation",
    "motor:right/saturation",
    "broken_line:left",
    "broken_line:right",
    "crossed_lines",
)
SIZES_M = {"stuck": 0.3, "saturation": 0.4}
VERDICT = ("phase", "fault", "confidence", "size", "onset_s", "residuals", "signals")


def injected(kind, onset_s, clear_s=None):
    return Injected(kind, onset_s, SIZES_M.get(kind.partition("/")[2]), clear_s)


def swap(seconds, flight):
    return [(seconds, flight, name, value) for name, value in SWAPPED.items()]


def lost(values, age_s, rows, columns, flight=slice(None)):
    """Copies in which these channels are unknown in these rows."""
    values, age_s = values.copy(), age_s.copy()
    values[rows, flight, columns] = math.nan
    age_s[rows, flight, columns] = math.nan
    return values, age_s


@pytest.fixture(scope="module")
def healthy(simulate):
    """200 s of eight sound vehicles."""
    return simulate([None] * 8, 200.0, 7300)


@pytest.fixture(scope="module")
def faulty(simulate):
    """200 s of every kind, in the order of KINDS; onset after 60 s."""
    return simulate([injected(kind, 60.0) for kind in KINDS], 200.0, 7500)


@pytest.fixture(scope="module")
def rough(simulate):
    """50 s of a sound vehicle and every kind, onset after 20 s, through a bad link and with holes: every branch is taken."""
    values, age_s = simulate([None, *(injected(kind, 20.0) for kind in KINDS)], 50.0, 7600, link=True)
    rng = np.random.default_rng(8)
    values[rng.random(values.shape) < 0.02] = math.nan
    values[60:80, 1, GPS] = math.nan
    values[100:130, 2, ENCODERS] = math.nan
    values[150:170, 3, ATTITUDE] = math.nan
    values[180:200, 4, AT["armed"]] = math.nan
    return values, age_s


# -- what is named, and when --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_every_fault_is_named_in_simulated_flights_and_nothing_is_said_before(our_config, simulate, judge, kind):
    flights = range(4)
    judged, monitor = judge(
        our_config, *simulate([injected(kind, 60.0)] * len(flights), 200.0, 7000 + 10 * KINDS.index(kind))
    )
    fault_id, _, size_kind = kind.partition("/")
    for f in flights:
        assert set(judged.phases(f)[100:600]) == {Phase.HEALTHY}
        assert Phase.DETECTED not in judged.phases(f)[:600]
        assert set(judged.ids(f)) == {None, fault_id}
        named = judged.ids(f).index(fault_id)
        assert named < 1400
        assert judged.phases(f)[-1] == Phase.ISOLATED
        assert (judged.confidence[named:, f] > 0.9).all()
        assert (judged.confidence[named:, f] <= our_config.turns.surest).all()
        assert (judged.confidence[:named, f] == 0.0).all()
        begun_s = named * 0.1 - judged.onset_s[named, f]
        assert 58.0 < begun_s <= named * 0.1
        assert judged.onset_s[-1, f] == pytest.approx(200.0 - begun_s, abs=0.15)
        if size_kind:
            output = IDS.index(fault_id)
            expected = KIND_STUCK if size_kind == "stuck" else KIND_SATURATION
            assert monitor.state["motors"][f, output, KIND] == expected
            assert judged.size[-1, f] == pytest.approx(SIZES_M[size_kind], abs=0.02)
        else:
            assert np.isnan(judged.size[:, f]).all()


def test_a_sound_vehicle_is_healthy_from_the_end_of_its_warm_up_on(our_config, healthy, judge):
    judged, _ = judge(our_config, *healthy)
    warm = round(our_config.warm_up_s / our_config.period_s) + 2
    assert (judged.phase[0] == Phase.WARMING).all()
    assert (judged.phase[warm:] == Phase.HEALTHY).all()
    assert (judged.fault == NO_FAULT).all()
    assert (judged.confidence == 0.0).all()
    assert np.isnan(judged.onset_s).all()
    assert np.isnan(judged.size).all()
    thresholds = parafoil.Monitor(our_config, 1).step(healthy[0][0, :1], healthy[1][0, :1]).thresholds
    assert (np.nan_to_num(judged.residuals) < thresholds).all()


def test_the_residual_of_what_is_named_stands_above_its_threshold_at_the_naming(our_config, faulty, judge):
    judged, _ = judge(our_config, *faulty)
    threshold = (our_config.turns.gyro if our_config.detector == "gyro" else our_config.turns.gps).threshold
    for kind, residual in (
        ("broken_line:left", "broken_left"),
        ("broken_line:right", "broken_right"),
        ("crossed_lines", "crossed"),
    ):
        f = KINDS.index(kind)
        named = judged.ids(f).index(kind)
        assert judged.residuals[named, f, RESIDUAL[residual]] > threshold
        assert judged.residuals[named, f, RESIDUAL["heading_rate"]] > threshold
    for kind, residual in (("motor:left/stuck", "motor_1"), ("motor:right/saturation", "motor_2")):
        f = KINDS.index(kind)
        named = judged.ids(f).index(kind.partition("/")[0])
        assert judged.residuals[named, f, RESIDUAL[residual]] > our_config.envelope.tolerance_m


def test_a_needless_swap_is_named_crossed_lines_within_ten_seconds(our_config, simulate, judge):
    flights = range(6)
    values, age_s = simulate([None] * 6, 120.0, 7100, [order for f in flights for order in swap(60.0, f)])
    before, monitor = judge(our_config, values[:601], age_s[:601])
    for f in flights:
        monitor.told(f, SWAPPED)
    after, _ = judge(monitor, values[601:], age_s[601:])
    assert (before.fault == NO_FAULT).all()
    for f in flights:
        assert after.named_s("crossed_lines", f) < 10.0
        assert set(after.ids(f)) == {None, "crossed_lines"}
        assert after.ids(f)[-1] == "crossed_lines"


def test_a_mending_swap_takes_the_name_back_at_once_and_the_vehicle_stays_healthy(our_config, simulate, judge):
    flights = range(6)
    orders = [order for f in flights for order in swap(65.0, f)]
    values, age_s = simulate([injected("crossed_lines", 50.0)] * 6, 165.0, 7150, orders)
    before, monitor = judge(our_config, values[:651], age_s[:651])
    assert [before.ids(f)[-1] for f in flights] == ["crossed_lines"] * 6
    for f in flights:
        monitor.told(f, SWAPPED)
    after, _ = judge(monitor, values[651:], age_s[651:])
    assert (after.phase == Phase.HEALTHY).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_that_passes_is_taken_back(our_config, simulate, judge, kind):
    """Once the vehicle has shown it: a mended motor by moving beyond its value, a mended line by being pulled."""
    judged, _ = judge(our_config, *simulate([injected(kind, 60.0, 90.0)] * 4, 300.0, 7200 + 10 * KINDS.index(kind)))
    fault_id = kind.partition("/")[0]
    for f in range(4):
        assert set(judged.ids(f)) <= {None, fault_id}
        assert judged.phases(f)[-1] == Phase.HEALTHY
    named = [f for f in range(4) if fault_id in judged.ids(f)]
    assert len(named) >= 3
    for f in named:
        assert judged.ids(f)[899] == fault_id


@pytest.mark.parametrize("mode", range(1, HYPOTHESES))
def test_a_wrong_name_is_taken_back(our_config, healthy, judge, mode):
    values, age_s = healthy
    _, monitor = judge(our_config, values[:600], age_s[:600])
    state = monitor.state
    state["clocks"][:, turns.MODE] = mode
    monitor.state = state
    judged, _ = judge(monitor, values[600:], age_s[600:])
    for f in range(8):
        assert judged.ids(f)[0] == IDS[mode + 1]
        assert judged.phases(f)[-1] == Phase.HEALTHY
        assert set(judged.ids(f)) == {None, IDS[mode + 1]}


def test_a_wrong_name_is_replaced_by_the_right_one(our_config, faulty, judge):
    values, age_s = (each[:, 6:7] for each in faulty)
    _, monitor = judge(our_config, values[:590], age_s[:590])
    state = monitor.state
    state["clocks"][:, turns.MODE] = BROKEN_LEFT
    monitor.state = state
    judged, _ = judge(monitor, values[590:], age_s[590:])
    assert judged.ids()[0] == "broken_line:left"
    assert judged.ids()[-1] == "crossed_lines"


def test_the_second_motor_is_named_while_the_first_stands(our_config, simulate, judge):
    orders = []
    for f in range(3):
        for name, value in (("SIM_FLT_SIDE", 1.0), ("SIM_FLT_VALUE", 0.4), ("SIM_FLT_TIME", 90.0), ("SIM_FLT_TYPE", 2.0)):
            orders.append((80.0, f, name, value))
    values, age_s = simulate([injected("motor:left/stuck", 60.0)] * 3, 240.0, 7700, orders)
    judged, _ = judge(our_config, values, age_s)
    for f in range(3):
        ids = judged.ids(f)
        assert ids[899] == "motor:left"
        assert set(ids[900:]) == {"motor:left", "motor:right"}
        assert ids[-1] == "motor:right"
        assert judged.size[899, f] == pytest.approx(0.3, abs=0.02)
        assert judged.size[-1, f] == pytest.approx(0.4, abs=0.02)


def test_a_line_that_breaks_while_a_motor_stands_accused_is_named_as_the_newer_fault(our_config, simulate, judge):
    orders = []
    for name, value in (("SIM_FLT_SIDE", 0.0), ("SIM_FLT_TIME", 100.0), ("SIM_FLT_TYPE", 4.0)):
        orders.append((80.0, 0, name, value))
    judged, _ = judge(our_config, *simulate([injected("motor:right/saturation", 60.0)], 240.0, 7720, orders))
    assert judged.ids()[999] == "motor:right"
    assert judged.ids()[-1] == "crossed_lines"
    assert np.isnan(judged.size[-1, 0])


# -- the same bits --------------------------------------------------------------------------------------------------------


def test_plain_python_and_machine_code_have_the_same_bits(our_config, rough, machine):
    values, age_s = rough
    plain, compiled = (parafoil.MultipleModel(our_config, values.shape[1], each) for each in (None, machine))
    seen = set()
    for k, (row, age) in enumerate(zip(values, age_s, strict=True)):
        here, there = plain.step(row, age), compiled.step(row, age)
        for name in VERDICT:
            assert getattr(here, name).tobytes() == getattr(there, name).tobytes(), (k, name)
        seen |= set(here.fault.tolist())
        if k % 50 == 0 or k == len(values) - 1:
            other = compiled.state
            for name, array in plain.state.items():
                assert array.tobytes() == other[name].tobytes(), (k, name)
    assert seen == {NO_FAULT, *range(len(IDS))}


def test_a_flight_in_company_has_the_bits_of_a_flight_alone(our_config, rough, judge):
    values, age_s = rough
    together, everyone = judge(our_config, values, age_s)
    for f in range(values.shape[1]):
        alone, one = judge(our_config, values[:, f : f + 1], age_s[:, f : f + 1])
        for name in VERDICT:
            assert getattr(alone, name)[:, 0].tobytes() == getattr(together, name)[:, f].tobytes(), (f, name)
        for name, array in one.state.items():
            assert array[0].tobytes() == everyone.state[name][f].tobytes(), (f, name)


def test_a_monitor_resumes_from_its_state_to_the_bit(our_config, rough, judge, machine):
    values, age_s = rough
    whole, through = judge(our_config, values, age_s)
    _, first = judge(our_config, values[:290], age_s[:290])
    second = parafoil.Monitor(our_config, values.shape[1], machine)
    second.state = first.state
    rest, _ = judge(second, values[290:], age_s[290:])
    for name in VERDICT:
        assert getattr(rest, name).tobytes() == getattr(whole, name)[290:].tobytes(), name
    assert all(array.tobytes() == through.state[name].tobytes() for name, array in second.state.items())
    for wrong in ({}, {**first.state, "other": np.zeros(1)}, {**first.state, "clocks": np.zeros((1, 1))}):
        with pytest.raises(ValueError, match="not one of this monitor"):
            second.state = wrong


def test_the_state_is_a_copy_and_verdicts_are_not_changed_by_later_steps(our_config, rough, judge):
    values, age_s = rough
    monitor = parafoil.Monitor(our_config, values.shape[1])
    kept = monitor.step(values[0], age_s[0])
    copies = {name: np.array(getattr(kept, name)) for name in (*VERDICT, "thresholds")}
    state = monitor.state
    as_it_was = {name: array.copy() for name, array in state.items()}
    for array in state.values():
        array += 1.0
    assert all(np.array_equal(array, as_it_was[name], equal_nan=True) for name, array in monitor.state.items())
    judge(monitor, values[1:30], age_s[1:30])
    assert all(np.array_equal(getattr(kept, name), copy, equal_nan=True) for name, copy in copies.items())


def test_mirroring_left_and_right_mirrors_the_verdict(our_config, fly, scenario, judge):
    cases = [{}, *({"fault": fault_id, "stuck_m": 0.3, "turn_m": 1.15} for fault_id in IDS)]
    judged, _ = judge(our_config, *fly([scenario(**case) for case in cases], 90.0))
    reflected, _ = judge(our_config, *fly([scenario(**case, mirrored=True) for case in cases], 90.0))
    order = ("motor:right", "motor:left", "broken_line:right", "broken_line:left", "crossed_lines")
    mirror = np.array([*(IDS.index(name) for name in order), NO_FAULT])  # NO_FAULT is the last one, too
    columns = [RESIDUAL[n] for n in ("heading_rate", "motor_2", "motor_1", "broken_right", "broken_left", "crossed")]
    assert judged.fault[-1].tolist() == [NO_FAULT, *range(len(IDS))]
    assert np.array_equal(reflected.phase, judged.phase)
    assert np.array_equal(reflected.fault, mirror[judged.fault])
    assert reflected.residuals == pytest.approx(judged.residuals[..., columns], abs=1e-6, nan_ok=True)
    assert reflected.signals == pytest.approx(-judged.signals, abs=1e-9, nan_ok=True)
    assert reflected.onset_s == pytest.approx(judged.onset_s, abs=1e-9, nan_ok=True)


# -- what it bears --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e308])
@pytest.mark.parametrize("channel", parafoil.CHANNELS)
def test_a_channel_that_is_lost_never_ends_in_a_fault(our_config, healthy, judge, channel, bad):
    values, age_s = (each[:1000].copy() for each in healthy)
    values[400:, :, AT[channel]] = bad
    judged, _ = judge(our_config, values, age_s)
    assert (judged.phase <= Phase.HEALTHY).all()
    needed = {"armed", "velocity_north_m_s", "velocity_east_m_s", "wheel_distance_1_m", "wheel_distance_2_m"}
    assert (judged.phase[-1] == (Phase.WARMING if channel in needed else Phase.HEALTHY)).all()
    for motor, output in (("motor_1", "wheel_distance_1_m"), ("motor_2", "wheel_distance_2_m")):
        assert np.isnan(judged.residuals[-1, :, RESIDUAL[motor]]).all() == (channel in (output, "armed"))


@pytest.mark.parametrize("rows", [4, 10, 30, 100])
@pytest.mark.parametrize("columns", [slice(0, 1), slice(0, None), COMMANDS, ENCODERS, GPS, ATTITUDE], ids=str)
def test_channels_that_come_back_accuse_nobody(our_config, healthy, judge, columns, rows):
    """Among them the heartbeat, without which no row is judged, while the motors move on."""
    for first in (430, 600):
        judged, _ = judge(our_config, *lost(*healthy, slice(first, first + rows), columns))
        assert (judged.phase <= Phase.HEALTHY).all()
        assert (judged.phase[-1] == Phase.HEALTHY).all()


@pytest.mark.parametrize("channel", parafoil.CHANNELS)
def test_a_fault_already_named_is_not_taken_back_because_a_channel_is_lost(our_config, faulty, judge, channel):
    values, age_s = lost(*faulty, slice(1400, None), AT[channel])
    judged, _ = judge(our_config, values, age_s)
    assert (judged.phase[1400:] == Phase.ISOLATED).all()
    assert (judged.fault[1400:] == judged.fault[1400]).all()
    assert judged.fault[-1].tolist() == [IDS.index(kind.partition("/")[0]) for kind in KINDS]


def test_half_a_minute_without_gps_is_not_judged_and_raises_no_alarm(our_config, simulate, judge):
    """As the vehicle flies it: without GPS its autopilot glides straight."""
    orders = [(at_s, f, "SIM_GPS_DISABLE", value) for f in range(8) for at_s, value in ((60.0, 1.0), (90.0, 0.0))]
    judged, _ = judge(our_config, *simulate([None] * 8, 200.0, 7800, orders))
    assert (judged.phase <= Phase.HEALTHY).all()
    assert (judged.phase[620:980] == Phase.WARMING).all()
    assert (judged.phase[985:] == Phase.HEALTHY).all()
    assert np.isnan(judged.residuals[620:900, :, RESIDUAL["heading_rate"]]).all()


def test_a_fault_named_before_a_gap_keeps_its_onset(our_config, faulty, judge):
    f = KINDS.index("crossed_lines")
    values, age_s = lost(*(each[:, f : f + 1] for each in faulty), slice(900, 1200), GPS)
    judged, _ = judge(our_config, values, age_s)
    assert judged.ids()[-1] == "crossed_lines"
    assert judged.onset_s[-1, 0] - judged.onset_s[890, 0] == pytest.approx((len(values) - 1 - 890) * 0.1, abs=1e-6)


def test_a_bad_link_accuses_nobody_and_hides_no_fault(our_config, simulate, judge):
    faults = [None] * 7 + [injected(kind, 60.0) for kind in KINDS]
    judged, _ = judge(our_config, *simulate(faults, 200.0, 7900, link=True))
    assert (judged.phase[:, :7] <= Phase.HEALTHY).all()
    assert [judged.ids(f)[-1] for f in range(7, 14)] == [kind.partition("/")[0] for kind in KINDS]


def test_without_attitude_the_gyro_detector_is_the_gps_detector(config, faulty, judge):
    values, age_s = lost(*faulty, slice(None), ATTITUDE)
    by_gyro, _ = judge(replace(config, detector="gyro"), values, age_s)
    by_gps, _ = judge(replace(config, detector="gps"), values, age_s)
    for name in ("phase", "fault", "confidence", "size", "onset_s", "residuals"):
        assert np.array_equal(getattr(by_gyro, name), getattr(by_gps, name), equal_nan=True), name
    assert by_gyro.ids(6)[-1] == "crossed_lines"


def test_when_attitude_stops_in_flight_gps_goes_on_judging(config, faulty, judge):
    values, age_s = lost(*faulty, slice(500, None), ATTITUDE)
    judged, _ = judge(replace(config, detector="gyro"), values, age_s)
    by_gps, _ = judge(replace(config, detector="gps"), *faulty)
    assert (judged.phase[100:600] == Phase.HEALTHY).all()
    for f in range(4, 7):
        assert judged.named_s(KINDS[f], f) == pytest.approx(by_gps.named_s(KINDS[f], f), abs=0.5)


@pytest.mark.parametrize("first", [300, 420, 475, 560])
@pytest.mark.parametrize("unheard", [0, 1, 3, 8])
def test_started_in_mid_flight_it_warms_up_and_accuses_nobody(our_config, healthy, judge, first, unheard):
    """Also where the first rows lack commands and encoders: nothing says that the toggles are released."""
    values, age_s = (each[first:1100] for each in healthy)
    for columns in (COMMANDS, ENCODERS):
        values, age_s = lost(values, age_s, slice(0, unheard), columns)
    judged, _ = judge(our_config, values, age_s)
    assert (judged.phase <= Phase.HEALTHY).all()
    assert (judged.phase[:80] == Phase.WARMING).all()
    assert (judged.phase[-1] == Phase.HEALTHY).all()


def test_a_held_encoder_reading_is_no_place_to_begin(our_config, healthy, judge):
    values, age_s = (each[475:700].copy() for each in healthy)
    values[0, :, ENCODERS], age_s[0, :, ENCODERS] = healthy[0][465, :, ENCODERS], 0.9
    judged, _ = judge(our_config, values, age_s)
    assert (judged.fault == NO_FAULT).all()


def test_a_fault_that_was_there_before_the_start_is_named(our_config, faulty, judge):
    judged, _ = judge(our_config, *(each[800:] for each in faulty))
    assert [judged.ids(f)[-1] for f in range(7)] == [kind.partition("/")[0] for kind in KINDS]


def test_without_a_forecast_it_waits_until_the_wind_is_found(our_config, simulate, judge):
    values, age_s = simulate([None] * 4 + [injected("crossed_lines", 60.0)], 200.0, 8000)
    values[..., AT["wind_speed_m_s"]] = math.nan
    judged, _ = judge(our_config, values, age_s)
    with_it, _ = judge(our_config, *simulate([None] * 4, 60.0, 8000))
    later = [judged.phases(f).index(Phase.HEALTHY) - with_it.phases(f).index(Phase.HEALTHY) for f in range(4)]
    assert min(later) >= 0
    assert max(later) > 50
    for f in range(4):
        settled = judged.phases(f).index(Phase.HEALTHY)
        assert settled < 600
        assert set(judged.phases(f)[settled:]) == {Phase.HEALTHY}
    assert judged.ids(4)[-1] == "crossed_lines"


def test_the_forecast_of_before_release_is_kept_when_the_vehicle_reports_its_estimate_later(
    our_config, fly, scenario, judge
):
    values, age_s = fly([scenario()], 0.5)
    values[1:, 0, AT["wind_speed_m_s"]] = 30.0
    _, monitor = judge(our_config, values, age_s)
    assert monitor.state["gps_mean"][0, turns.KNOWN, :2] == pytest.approx([-3.0, 0.0], abs=0.8)


def test_a_fix_is_used_once_with_the_time_since_the_one_before(our_config, fly, scenario, judge):
    values, age_s = fly([scenario()], 40.0)
    shifted_age_s = age_s.copy()
    shifted_age_s[..., GPS] += 0.06  # every fix 60 ms before the row that shows it first
    judged, monitor = judge(our_config, values, age_s)
    shifted, other = judge(our_config, values, shifted_age_s)
    assert other.state["gps_mean"] == pytest.approx(monitor.state["gps_mean"], abs=1e-9)
    assert other.state["marks"][0, FIX_AGO_S] == pytest.approx(monitor.state["marks"][0, FIX_AGO_S] + 0.06, abs=1e-9)
    assert shifted.residuals == pytest.approx(judged.residuals, abs=1e-7, nan_ok=True)


def test_nothing_is_judged_before_arming_and_everything_is_forgotten_on_touchdown(our_config, faulty, judge):
    judged, monitor = judge(our_config, *faulty)
    assert (judged.fault[-1] != NO_FAULT).all()
    ground, ground_age_s = (each[900:1000].copy() for each in faulty)
    ground[..., AT["armed"]] = 0.0
    on_ground, _ = judge(monitor, ground, ground_age_s)
    assert (on_ground.phase == Phase.WARMING).all()
    assert np.isnan(on_ground.residuals).all()
    _, fresh = judge(our_config, ground[-1:], ground_age_s[-1:])
    assert all(np.array_equal(array, fresh.state[name], equal_nan=True) for name, array in monitor.state.items())


# -- what it is told ------------------------------------------------------------------------------------------------------


def test_functions_as_they_were_change_nothing_and_one_alone_leaves_the_other(our_config, faulty, judge):
    _, monitor = judge(our_config, *faulty)
    before = monitor.state
    monitor.told(6, NORMAL)
    monitor.told(6, {"OTHER": 3.0})
    monitor.told(6, {"SERVO2_FUNCTION": 78.0})
    assert all(np.array_equal(array, before[name], equal_nan=True) for name, array in monitor.state.items())
    monitor.told(6, {"SERVO1_FUNCTION": 78})
    half, _ = judge(monitor, *(each[-1:] for each in faulty))
    assert half.phase[0, 6] == Phase.WARMING  # both are right toggles now
    monitor.told(6, {"SERVO2_FUNCTION": 77})
    whole, _ = judge(monitor, *(each[-1:] for each in faulty))
    assert whole.phase[0, 6] == Phase.HEALTHY
    assert half.fault[0, :6].tolist() == whole.fault[0, :6].tolist() == [IDS.index(k.partition("/")[0]) for k in KINDS[:6]]


@pytest.mark.parametrize("functions", [(77, 77), (0, 78), (math.nan, 78), (1, 2)])
def test_under_an_assignment_that_cannot_be_motors_are_judged_and_turns_are_not(
    our_config, faulty, machine, judge, functions
):
    monitor = parafoil.Monitor(our_config, len(KINDS), machine)
    for f in range(len(KINDS)):
        monitor.told(f, dict(zip(parafoil.PARAMETERS, functions, strict=True)))
    judged, _ = judge(monitor, *faulty)
    assert [judged.ids(f)[-1] for f in range(4)] == ["motor:left", "motor:right", "motor:left", "motor:right"]
    assert (judged.phase[:, 4:] == Phase.WARMING).all()
    for f in range(len(KINDS)):
        monitor.told(f, NORMAL)
    again, _ = judge(monitor, *(each[800:] for each in faulty))
    assert again.ids(6)[-1] == "crossed_lines"


def test_lines_go_by_function_and_motors_by_output(our_config, fly, scenario, machine, judge):
    cases = {"broken_line:left": "broken_line:left", "motor:left": "motor:right"}
    for flown, expected in cases.items():
        values, age_s = fly([scenario(flown, stuck_m=0.3, turn_m=1.15)], 90.0)
        for columns in (COMMANDS, ENCODERS):
            values[..., columns] = values[..., columns][..., ::-1].copy()
        monitor = parafoil.Monitor(our_config, 1, machine)
        monitor.told(0, SWAPPED)
        judged, _ = judge(monitor, values, age_s)
        assert judged.ids()[-1] == expected


def test_a_swap_begins_the_turns_in_the_turn_that_is_flown(our_config, faulty, judge):
    values, age_s = (each[:1000, 6:7] for each in faulty)
    _, monitor = judge(our_config, values, age_s)
    before = monitor.state
    figures = figures_of(our_config).turns
    monitor.told(0, SWAPPED)
    state = monitor.state
    mean, crossed = before["gps_mean"][0, turns.KNOWN], before["response"][0, turns.GPS, CROSSED]
    turn_rad_s = mean[turns.BIAS] + mean[turns.COLOURED]
    scale = math.sqrt(1.00649 / (1.225 * (1.0 - 2.25577e-5 * values[-1, 0, AT["altitude_m"]]) ** 4.2559))
    turn_rad_s += mean[turns.EFFECTIVENESS] * scale * (crossed @ figures.heading_output)
    assert abs(turn_rad_s) > 0.02
    begun_rad_s = scale * np.einsum("bhk,k->bh", state["response"][0], figures.heading_output)
    assert begun_rad_s == pytest.approx(np.full((turns.BANKS, HYPOTHESES), turn_rad_s), abs=2e-5)
    assert np.array_equal(state["gps_mean"][0, turns.KNOWN, :4], mean[:4])
    assert not state["sums"].any()
    assert state["clocks"][0, turns.MODE] == HEALTHY


def test_signals_come_from_gyro_and_target_and_else_from_the_toggles(our_config, healthy, judge):
    values, age_s = (each[500:501, :1].copy() for each in healthy)
    values[..., AT["turn_rate_command_rad_s"]] = 0.123
    values[..., AT["yaw_rate_rad_s"]], values[..., AT["pitch_rate_rad_s"]] = 0.2, 0.05
    values[..., AT["roll_rad"]], values[..., AT["pitch_rad"]] = 0.3, -0.1
    judged, monitor = judge(our_config, values, age_s)
    expected = [0.123, (0.05 * math.sin(0.3) + 0.2 * math.cos(0.3)) / math.cos(0.1)]
    assert judged.signals[0, 0] == pytest.approx(expected, abs=1e-12)
    values[..., AT["turn_rate_command_rad_s"]] = values[..., AT["roll_rad"]] = math.nan
    values[..., AT["output_1_us"]], values[..., AT["output_2_us"]] = 1000.0, 1400.0
    judged, _ = judge(monitor, values, age_s)
    assert judged.signals[0, 0, 0] == pytest.approx(0.6 * 0.364795, abs=1e-6)
    assert math.isnan(judged.signals[0, 0, 1])
    monitor.told(0, SWAPPED)
    judged, _ = judge(monitor, values, age_s)
    assert judged.signals[0, 0, 0] == pytest.approx(-0.6 * 0.364795, abs=1e-6)
    monitor.told(0, {"SERVO1_FUNCTION": 1})
    judged, _ = judge(monitor, values, age_s)
    assert math.isnan(judged.signals[0, 0, 0])


# -- sums, restarts and what is learnt ----------------------------------------------------------------------------------


@pytest.fixture
def begun(config):
    """The state of one flight's turn monitor that knows nothing, past its warm-up, and its figures."""
    figures = figures_of(config).turns
    banks, filters = turns.BANKS, turns.FILTERS
    state = turns.Turns(
        np.zeros((1, banks, HYPOTHESES, LINEAR_STATES)),
        np.zeros((1, filters, GPS_STATES)),
        np.zeros((1, filters, GPS_STATES, GPS_STATES)),
        np.zeros((1, filters, GYRO_STATES)),
        np.zeros((1, filters, GYRO_STATES, GYRO_STATES)),
        np.zeros((1, banks, turns.SUMS, HYPOTHESES)),
        np.zeros((1, banks, turns.NOTED + 1, turns.LEARNT)),
        np.zeros((1, HYPOTHESES + 1)),
        np.zeros((1, banks, 2)),
        np.zeros((1, turns.CLOCKS)),
    )
    turns.start_turns(state, 0, figures)
    return state, figures


def sum_up(state, figures, densities, bank=turns.GPS):
    turns._sum_up(state, 0, bank, figures, np.array([*densities, 0.0]))
    return state.sums[0, bank]


def test_a_step_of_the_sums_has_its_published_check_values(begun):
    sums = sum_up(*begun, (-1.0, -0.2, -1.5, 3.0))
    assert sums[turns.CLIPPED, 1:] == pytest.approx([0.78, -0.52, 1.48], abs=1e-12)
    assert sums[turns.WHOLE, 1:] == pytest.approx([0.8, -0.5, 4.0], abs=1e-12)
    assert sums[:, HEALTHY].tolist() == [0.0, 0.0, 0.0]


def test_sums_go_on_from_where_they_are_down_to_their_floor(begun):
    for _ in range(9):
        sums = sum_up(*begun, (0.0, 2.0, -1.0, -60.0))
    assert sums[turns.CLIPPED, 1:] == pytest.approx([9 * 1.48, -6.0, -6.0], abs=1e-12)
    assert sums[turns.WHOLE, 1:] == pytest.approx([18.0, -9.0, -450.0], abs=1e-12)


def test_where_no_sum_is_above_zero_all_begin_anew_with_the_response_of_the_believed_mode(begun):
    state, figures = begun
    state.response[0] = np.arange(turns.BANKS * HYPOTHESES * LINEAR_STATES).reshape(turns.BANKS, HYPOTHESES, LINEAR_STATES)
    other_bank = state.response[0, turns.GYRO].copy()
    state.gps_mean[0, turns.KNOWN, :4] = (1.0, 2.0, 19.0, 0.3)
    state.learnt[0, turns.GPS, turns.NOTED, turns.LEARNT_BIAS] = 0.02
    sum_up(state, figures, (0.0, 1.0, -1.0, -1.0))
    assert state.response[0, turns.GPS, BROKEN_LEFT, 0] == 4.0
    sums = sum_up(state, figures, (0.0, -1.5, -1.0, -1.0))
    assert not sums.any()
    assert np.array_equal(state.response[0, turns.GPS], np.tile(np.arange(4.0), (HYPOTHESES, 1)))
    assert np.array_equal(state.response[0, turns.GYRO], other_bank)
    assert np.array_equal(state.gps_mean[0, :HYPOTHESES], np.tile([1.0, 2.0, 19.0, 0.3, 0.02, 0.0, 1.0], (HYPOTHESES, 1)))


def test_during_the_warm_up_sums_stay_at_zero(begun):
    state, figures = begun
    state.clocks[0, turns.WARM_UP_GPS] = 5.0
    assert not sum_up(state, figures, (-1.0, -0.2, -1.5, 3.0)).any()
    assert sum_up(state, figures, (-1.0, -0.2, -1.5, 3.0), bank=turns.GYRO).any()


def test_an_alarm_waits_a_second_for_the_name_and_no_margin_is_no_name(begun):
    state, figures = begun
    sums = state.sums[0, turns.GPS]

    def decide(rows):
        for _ in range(rows):
            turns.decide_turns(state, 0, figures, turns.GPS)
        return int(state.clocks[0, turns.MODE]), state.clocks[0, turns.ALARM_ROWS] != turns.NO_ALARM

    sums[turns.CLIPPED, 1:] = (figures.gps_bank.threshold, 0.1, 0.1)
    assert decide(5) == (HEALTHY, False)  # at the threshold is not above it
    sums[turns.CLIPPED, 1:] = (7.0, 0.1, 6.9)
    sums[turns.WHOLE, 1:] = (9.0, -2.0, 4.0)
    assert decide(40) == (HEALTHY, True)  # leads by 5
    sums[turns.WHOLE, CROSSED] = 2.0
    assert decide(1) == (BROKEN_LEFT, False)
    assert state.clocks[0, turns.CONFIDENCE] == pytest.approx(
        1.0 / (1.0 + math.exp(-9.0) + math.exp(-11.0) + math.exp(-7.0))
    )
    assert not state.sums.any()


def test_the_hold_is_counted_from_the_alarm_and_an_alarm_without_evidence_ends(begun):
    state, figures = begun
    state.sums[0, turns.GPS, turns.CLIPPED, 1:] = (7.0, 0.1, 0.1)
    state.sums[0, turns.GPS, turns.WHOLE, 1:] = (30.0, 0.0, 0.0)
    rows = 0
    while state.clocks[0, turns.MODE] == HEALTHY and rows < 50:
        turns.decide_turns(state, 0, figures, turns.GPS)
        rows += 1
    assert rows == 1 + round(figures.hold_rows)
    state.clocks[0, turns.ALARM_ROWS] = 3.0
    turns.decide_turns(state, 0, figures, turns.GPS)  # the sums are at zero since the naming
    assert state.clocks[0, turns.ALARM_ROWS] == turns.NO_ALARM


def test_the_gyro_names_nothing_that_gps_prefers_another_fault_to(begun):
    state, figures = begun
    state.sums[0, turns.GYRO, turns.CLIPPED, 1:] = (0.1, 0.1, 30.0)
    state.sums[0, turns.GYRO, turns.WHOLE, 1:] = (0.0, 0.0, 60.0)
    state.sums[0, turns.GPS, turns.WHOLE, 1:] = (1.5, -1.0, 3.4)
    for _ in range(40):
        turns.decide_turns(state, 0, figures, turns.GYRO)
    assert state.clocks[0, turns.MODE] == HEALTHY
    state.sums[0, turns.GPS, turns.WHOLE, CROSSED] = 3.6
    turns.decide_turns(state, 0, figures, turns.GYRO)
    assert state.clocks[0, turns.MODE] == CROSSED


def test_the_reference_is_what_was_known_half_a_minute_ago_and_nothing_is_learnt_while_a_sum_is_high(begun):
    state, figures = begun
    state.gps_covariance[0, turns.KNOWN] = np.eye(GPS_STATES) * 1e-4
    state.gyro_covariance[0, turns.KNOWN] = np.eye(GYRO_STATES) * 1e-4
    reference = state.learnt[0, turns.GPS, turns.NOTED]

    def fly(rows, first):
        for k in range(first, first + rows):
            state.gps_mean[0, turns.KNOWN, turns.BIAS] = 1e-4 * k
            state.gps_mean[0, turns.KNOWN, turns.EFFECTIVENESS] = 2.0
            turns.note(state, 0, figures)

    fly(349, 0)
    assert reference[turns.LEARNT_BIAS] == 0.0
    assert reference[turns.DEVIATION_BIAS] == figures.bias_prior_rad_s
    fly(1, 349)
    assert reference[turns.LEARNT_BIAS] == pytest.approx(1e-4 * 49)  # after five seconds, half a minute ago
    assert reference[turns.DEVIATION_BIAS] == pytest.approx(0.01)
    assert reference[turns.LEARNT_SHARE] == 1.0 + figures.effectiveness_limit
    before = state.learnt.copy()
    state.sums[0, turns.GPS, turns.CLIPPED, CROSSED] = figures.calm * figures.gps_bank.threshold + 0.01
    fly(100, 350)
    assert np.array_equal(state.learnt, before)
    state.sums[0, turns.GPS, turns.CLIPPED, CROSSED] = 0.0
    fly(1, 2000)
    assert not np.array_equal(state.learnt, before)
    assert state.learnt[0, turns.GPS, turns.NOTED - 1, turns.LEARNT_BIAS] == figures.bias_limit_rad_s


@pytest.mark.parametrize(("squared", "low", "high"), [(1.0, 1.0, 1.0), (2.0, 3.9, 4.0), (100.0, 3.9, 4.0)])
def test_the_level_of_the_noise_follows_the_innovations_between_one_and_its_limit(config, squared, low, high):
    rule = figures_of(config).turns.level
    level = 1.0
    for _ in range(600):
        level = turns.follow_level(level, rule, squared, 0.1)
    assert low <= level <= high
    once = turns.follow_level(2.0, rule, 100.0, 0.1)
    assert once == pytest.approx(2.0 * (1.0 + 0.1 / rule.time_s * (rule.clip - rule.squared)))


# -- shapes, imports, configuration -------------------------------------------------------------------------------------


def test_wrong_shapes_raise_and_nothing_else_does(our_config):
    monitor = parafoil.Monitor(our_config, flights=2)
    good = np.zeros((2, len(parafoil.CHANNELS)))
    for values, age_s in ((good[:1], good), (good, good[:, 1:]), (good[0], good[0])):
        with pytest.raises(ValueError, match="shape"):
            monitor.step(values, age_s)
    with pytest.raises(ValueError, match="at least one flight"):
        parafoil.Monitor(our_config, flights=0)
    rng = np.random.default_rng(6)
    values = np.array([math.nan, math.inf, -math.inf, 0.0, 1.0, 1e308, -1e308, 5e-324, 0.3, 1500.0])
    ages_s = np.array([math.nan, math.inf, -math.inf, 0.0, 0.0, 0.0, 0.05, 0.1, 0.3, 1e308, -1e308, 5e-324, 1500.0, -0.05])
    for k in range(600):
        row, age = rng.choice(values, good.shape), rng.choice(ages_s, good.shape)
        if k < 300:
            row[:, AT["armed"]], age[:, AT["armed"]] = 1.0, 0.0
        monitor.step(row, age)
    state = monitor.state
    for name in ("response", "gps_mean", "gps_covariance", "gyro_mean", "gyro_covariance", "sums", "learnt", "clocks"):
        assert np.isfinite(state[name]).all(), name


def test_a_sample_from_the_future_or_of_no_age_is_none(our_config, healthy, judge):
    for age_s in (-0.05, -1e308, math.nan, math.inf, 1e308):
        ages_s = healthy[1][:300].copy()
        ages_s[..., ENCODERS] = age_s
        judged, _ = judge(our_config, healthy[0][:300], ages_s)
        assert (judged.phase == Phase.WARMING).all()
        assert np.isnan(judged.residuals[..., RESIDUAL["motor_1"]]).all()


@pytest.mark.parametrize(("detector", "kind"), [("gyro", "MultipleModel"), ("gps", "MultipleModel"), ("paper", "Parafoil")])
def test_the_monitor_is_that_of_the_detector(config, machine, detector, kind):
    for compiler in (None, machine):
        assert type(parafoil.Monitor(replace(config, detector=detector), 3, compiler)) is getattr(parafoil, kind)


def test_the_detectors_compare_their_residuals_with_their_own_thresholds(config):
    row = np.zeros((1, len(parafoil.CHANNELS)))
    for detector, table in (("gyro", config.turns.gyro), ("gps", config.turns.gps)):
        thresholds = parafoil.Monitor(replace(config, detector=detector), 1).step(row, row).thresholds
        expected = [table.threshold, 0.03, 0.03, table.threshold, table.threshold, table.threshold]
        assert thresholds.tolist() == expected


def test_the_step_path_imports_numpy_alone():
    """Built and stepped, from the packaged numbers, as a live vehicle's."""
    code = """
import sys, tomllib
import numpy as np
from importlib.resources import files
import fdi.parafoil as parafoil
from fdi.parafoil import config

def record(kind, table):
    nested = {"outputs": config.Outputs, "motor": config.Motor, "navigation": config.WindHeadingFilter,
              "lateral_model": config.LateralModel, "observer": config.Observer, "response": config.Response,
              "envelope": config.Envelope, "turns": config.TurnMonitor, "gps": config.GpsBank, "gyro": config.GyroBank,
              "design": config.ThresholdDesign}
    return kind(**{name: record(nested[name], value) if isinstance(value, dict) else value for name, value in table.items()})

table = tomllib.loads(files("configs").joinpath("parafoil.toml").read_text())["monitor"]
del table["paper"]
monitor = parafoil.Monitor(record(lambda **each: config.Config(paper=None, **each), table), flights=1)
row = np.ones((1, len(parafoil.CHANNELS)))
for _ in range(20):
    monitor.step(row, np.zeros_like(row))
print(type(monitor).__name__)
print([name for name in ("scipy", "numba", "filterpy", "msgspec", "pymavlink", "companion", "sitl") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.split("\n")[:2] == ["MultipleModel", "[]"]


def within(record, path, value):
    """The record with one value of a nested one replaced; path as "turns.gps.threshold"."""
    name, _, rest = path.partition(".")
    return replace(record, **{name: within(getattr(record, name), rest, value) if rest else value})


@pytest.mark.parametrize(
    ("path", "value", "sentence"),
    [
        ("detector", "sonar", "detector = 'sonar' is unknown; give one of paper, gps, gyro"),
        ("period_s", 0.0, "period_s = 0.0 must be a number above 0"),
        ("warm_up_s", math.inf, "warm_up_s = inf must be a number above 0"),
        ("response.transition", ((math.nan,) * 4,) * 4, "response.transition holds a value that is no finite number"),
        ("response.input", (0.0, 0.0, math.inf, 0.0), "response.input holds a value that is no finite number"),
        ("envelope.tolerance_m", 0.0, "envelope.tolerance_m = 0.0 must be a number above 0"),
        ("envelope.samples_outside", 0, "envelope.samples_outside = 0 must be a number above 0"),
        ("envelope.slowest_rate_factor", -0.6, "envelope.slowest_rate_factor = -0.6 must be a number above 0"),
        ("envelope.confidence", 1.2, "envelope.confidence = 1.2 is no share; give 0 to 1"),
        ("turns.slack_m", -0.1, "turns.slack_m = -0.1 must be >= 0 and turns.floor = -6.0 <= 0"),
        ("turns.floor", 1.0, "turns.slack_m = 0.0 must be >= 0 and turns.floor = 1.0 <= 0"),
        ("turns.hold_s", math.nan, "turns.hold_s = nan must be a number above 0"),
        ("turns.gps.threshold", 0.0, "turns.gps.threshold = 0.0 must be a number above 0"),
        ("turns.gyro.agreement", -2.0, "turns.gyro.agreement = -2.0 must be a number above 0"),
        (
            "turns.gyro.design.false_alarms_per_flight",
            7.0,
            "turns.design.false_alarms_per_flight = 7.0 is no share; give 0 to 1",
        ),
    ],
)
def test_a_configuration_that_makes_no_sense_is_refused_in_one_sentence(config, path, value, sentence):
    with pytest.raises(ValueError) as raised:
        within(config, path, value)
    assert str(raised.value) == sentence
