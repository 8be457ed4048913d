import math

import numpy as np
import pytest

import fdi.parafoil as parafoil
from fdi.ekf import HEADING_RATE
from fdi.verdict import NO_FAULT, Phase

AT = {name: index for index, name in enumerate(parafoil.CHANNELS)}
RESIDUAL = {name: index for index, name in enumerate(parafoil.RESIDUALS)}
IDS = [fault.id for fault in parafoil.FAULTS]
NORMAL, SWAPPED = ({"SERVO1_FUNCTION": a, "SERVO2_FUNCTION": b} for a, b in ((77, 78), (78, 77)))


def judge(config, values, age_s, until=None, monitor=None):
    """Verdicts over the rows, the last one and the monitor: (all, monitor)."""
    monitor = monitor or parafoil.Parafoil(config, flights=values.shape[1])
    return [monitor.step(row, age) for row, age in zip(values[:until], age_s[:until], strict=True)], monitor


def named(verdict, flight=0):
    return IDS[verdict.fault[flight]] if verdict.fault[flight] != NO_FAULT else None


def phases(verdicts, flight=0):
    return [Phase(verdict.phase[flight]) for verdict in verdicts]


def of_fault(scenario, fault_id, **changes):
    """A line that is broken shows in wide turns only; in them crossed lines would eliminate every hypothesis."""
    return scenario(fault_id, turn_m=1.15 if fault_id.startswith("broken_line") else 0.55, **changes)


@pytest.fixture(scope="module")
def faulty(fly, scenario):
    """Two minutes of every fault, with a healthy flight first; order as in FAULTS."""
    return fly([scenario(), *(of_fault(scenario, fault_id) for fault_id in IDS)], 120.0)


def test_a_healthy_flight_stays_healthy_from_its_first_fix_on(config, fly, scenario):
    verdicts, _ = judge(config, *fly([scenario()], 300.0))
    assert phases(verdicts)[:2] == [Phase.WARMING, Phase.WARMING]
    assert set(phases(verdicts)[2:]) == {Phase.HEALTHY}
    assert max(verdict.residuals[0, RESIDUAL["heading_rate"]] for verdict in verdicts[2:]) < 0.01
    assert max(verdict.residuals[0, RESIDUAL["motor_1"]] for verdict in verdicts[2:]) < 0.01


def test_every_fault_is_detected_and_named(config, faulty):
    verdicts, _ = judge(config, *faulty)
    assert [named(verdicts[-1], f) for f in range(6)] == [None, *IDS]
    for f in range(1, 6):
        seen = phases(verdicts, f)
        assert Phase.DETECTED not in seen[:300]
        assert set(seen[2:300]) == {Phase.HEALTHY}
        assert seen[-1] == Phase.ISOLATED
        assert 0.0 < verdicts[-1].confidence[f] <= 1.0
    assert verdicts[-1].confidence[0] == 0.0
    assert math.isnan(verdicts[-1].onset_s[0])
    assert np.isnan(verdicts[-1].size).all()


def test_onset_is_told_as_time_since_detection_and_the_delay_of_the_design(config, faulty):
    values, age_s = faulty
    verdicts, _ = judge(config, values[:, 5:6], age_s[:, 5:6])
    detected = next(k for k, verdict in enumerate(verdicts) if verdict.phase[0] >= Phase.DETECTED)
    since_s = (len(verdicts) - 1 - detected) * 0.1
    assert verdicts[-1].onset_s[0] == pytest.approx(since_s + config.paper.delays.crossed_lines_s, abs=1e-9)


def test_a_flight_in_company_has_the_bits_of_a_flight_alone(config, faulty):
    values, age_s = (np.array(each) for each in faulty)
    rng = np.random.default_rng(8)
    values[rng.random(values.shape) < 0.03] = np.nan  # so that flights take different branches
    age_s[rng.random(values.shape) < 0.02] += 0.3
    values[400:430, 2] = np.nan
    together, everyone = judge(config, values, age_s)
    for f in (0, 2, 5):
        alone, one = judge(config, values[:, f : f + 1], age_s[:, f : f + 1])
        for here, there in zip(alone, together, strict=True):
            for name in ("phase", "fault", "confidence", "size", "onset_s", "residuals", "signals"):
                assert np.array_equal(getattr(here, name)[0], getattr(there, name)[f], equal_nan=True), name
        for name, array in one.state.items():
            assert np.array_equal(array[0], everyone.state[name][f], equal_nan=True), name


def test_a_monitor_resumes_from_its_state_to_the_bit(config, faulty):
    values, age_s = faulty
    whole, _ = judge(config, values, age_s)
    _, first = judge(config, values, age_s, until=640)
    second = parafoil.Parafoil(config, flights=6)
    second.state = first.state
    rest, _ = judge(config, values[640:], age_s[640:], monitor=second)
    for here, there in zip(rest, whole[640:], strict=True):
        assert np.array_equal(here.residuals, there.residuals, equal_nan=True)
        assert np.array_equal(here.phase, there.phase)
    with pytest.raises(ValueError, match="not one of this monitor"):
        second.state = {}


def test_verdicts_are_not_changed_by_later_steps(config, faulty):
    values, age_s = faulty
    monitor = parafoil.Parafoil(config, flights=6)
    kept = monitor.step(values[0], age_s[0])
    copies = [np.array(getattr(kept, name)) for name in ("phase", "fault", "confidence", "onset_s", "residuals", "signals")]
    judge(config, values[1:], age_s[1:], monitor=monitor)
    for name, copy in zip(("phase", "fault", "confidence", "onset_s", "residuals", "signals"), copies, strict=True):
        assert np.array_equal(getattr(kept, name), copy, equal_nan=True)


def test_mirroring_left_and_right_mirrors_the_verdict(config, fly, scenario):
    cases = [scenario(), *(of_fault(scenario, fault_id) for fault_id in IDS)]
    mirrored = [scenario(mirrored=True), *(of_fault(scenario, fault_id, mirrored=True) for fault_id in IDS)]
    verdicts, _ = judge(config, *fly(cases, 120.0))
    reflected, _ = judge(config, *fly(mirrored, 120.0))
    swap = [
        IDS.index(name) for name in ("motor:right", "motor:left", "broken_line:right", "broken_line:left", "crossed_lines")
    ]
    columns = [RESIDUAL[n] for n in ("heading_rate", "motor_2", "motor_1", "broken_right", "broken_left", "crossed")]
    for here, there in zip(verdicts, reflected, strict=True):
        assert np.array_equal(here.phase, there.phase)
        expected = [NO_FAULT if fault == NO_FAULT else swap[fault] for fault in here.fault]
        assert there.fault.tolist() == expected
        assert there.residuals == pytest.approx(here.residuals[:, columns], abs=1e-9, nan_ok=True)
        assert there.signals == pytest.approx(-here.signals, abs=1e-9, nan_ok=True)


def end_of(config, values, age_s):
    verdicts, _ = judge(config, values, age_s)
    return verdicts, {Phase(phase) for verdict in verdicts for phase in verdict.phase}


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30, -1e308])
@pytest.mark.parametrize("channel", parafoil.CHANNELS)
def test_a_channel_that_is_lost_in_flight_ends_unknown_or_held_and_never_in_a_fault(config, fly, scenario, channel, bad):
    values, age_s = fly([scenario(turn_m=0.8)], 80.0)
    values[300:, 0, AT[channel]] = bad
    verdicts, seen = end_of(config, values, age_s)
    assert seen <= {Phase.WARMING, Phase.HEALTHY}
    turn, motors = verdicts[-1].residuals[0, 0], verdicts[-1].residuals[0, 1:3]
    if channel in ("velocity_north_m_s", "velocity_east_m_s", "altitude_m", "output_1_us", "output_2_us", "armed"):
        assert phases(verdicts)[-1] == Phase.WARMING
        assert math.isnan(turn)
    else:
        assert phases(verdicts)[-1] == Phase.HEALTHY
        assert turn < 0.01
    assert math.isnan(motors[0]) == (channel in ("output_1_us", "wheel_distance_1_m"))
    assert math.isnan(motors[1]) == (channel in ("output_2_us", "wheel_distance_2_m"))


@pytest.mark.parametrize("channel", parafoil.CHANNELS)
def test_a_channel_that_never_came_ends_unknown_or_held_and_never_in_a_fault(config, fly, scenario, channel):
    values, age_s = fly([scenario(turn_m=0.8)], 60.0)
    values[..., AT[channel]] = math.nan
    verdicts, seen = end_of(config, values, age_s)
    assert seen <= {Phase.WARMING, Phase.HEALTHY}
    needed = ("velocity_north_m_s", "velocity_east_m_s", "altitude_m", "output_1_us", "output_2_us", "armed")
    assert (phases(verdicts)[-1] == Phase.WARMING) == (channel in needed)


@pytest.mark.parametrize("channel", parafoil.CHANNELS)
def test_a_fault_already_named_is_not_taken_back_because_a_channel_is_lost(config, faulty, channel):
    values, age_s = (np.array(each[:, 5:6]) for each in faulty)
    values[700:, 0, AT[channel]] = math.nan
    verdicts, _ = judge(config, values, age_s)
    assert named(verdicts[699]) == named(verdicts[-1]) == "crossed_lines"


def test_while_an_encoder_is_unknown_no_line_is_accused(config, faulty):
    values, age_s = (np.array(each[:, 1:2]) for each in faulty)
    assert IDS[0] == "motor:left"
    values[310:, 0, AT["wheel_distance_1_m"]] = math.nan
    verdicts, _ = judge(config, values, age_s)
    assert phases(verdicts)[-1] == Phase.DETECTED
    assert named(verdicts[-1]) is None


def test_a_gap_of_gps_restarts_the_filter_and_warms_up_for_eight_seconds(config, fly, scenario):
    values, age_s = fly([scenario()], 90.0)
    gps = [AT["velocity_north_m_s"], AT["velocity_east_m_s"], AT["altitude_m"]]
    values[300:600, 0, gps] = math.nan
    verdicts, monitor = judge(config, values, age_s)
    seen = phases(verdicts)
    assert seen[299] == Phase.HEALTHY
    assert set(seen[315:680]) == {Phase.WARMING}
    assert set(seen[681:]) == {Phase.HEALTHY}
    assert verdicts[307].residuals[0, 0] == pytest.approx(verdicts[299].residuals[0, 0], abs=0.005)  # held, not zero
    assert math.isnan(verdicts[320].residuals[0, 0])
    assert max(verdict.residuals[0, 0] for verdict in verdicts[681:]) < 0.01
    assert monitor.air[:2, 0] == pytest.approx([-3.0, 0.0], abs=1.5)


def test_after_a_gap_of_gps_the_filter_begins_with_the_wind_it_had_found(config, fly, scenario):
    values, age_s = fly([scenario()], 60.0)
    values[..., AT["wind_speed_m_s"]] = 0.0  # a forecast 3 m/s off
    gps = [AT["velocity_north_m_s"], AT["velocity_east_m_s"], AT["altitude_m"]]
    values[401:551, 0, gps] = math.nan
    _, monitor = judge(config, values, age_s, until=552)
    wind_m_s = monitor.air[:2, 0].copy()
    assert wind_m_s == pytest.approx([-3.0, 0.0], abs=1.5)
    before = monitor.heading_rate.mean()[0]
    monitor.step(values[552], age_s[552])
    assert np.array_equal(monitor.air[:2, 0], wind_m_s)
    assert np.diag(monitor.covariance[..., 0])[:2].tolist() == [config.navigation.start_wind_variance_m2_s2] * 2
    assert before > 0.0
    assert monitor.heading_rate.mean()[0] == 0.0


def test_a_short_gap_of_gps_changes_no_phase(config, fly, scenario):
    values, age_s = fly([scenario()], 60.0)
    gps = [AT["velocity_north_m_s"], AT["velocity_east_m_s"], AT["altitude_m"]]
    values[300:308, 0, gps] = math.nan
    verdicts, _ = judge(config, values, age_s)
    assert set(phases(verdicts)[2:]) == {Phase.HEALTHY}


def test_a_gap_in_the_commands_lets_the_motor_models_begin_at_the_encoders(config, fly, scenario):
    values, age_s = fly([scenario(turn_m=1.2)], 90.0)
    values[300:347, 0, AT["output_1_us"] : AT["output_2_us"] + 1] = math.nan
    verdicts, monitor = judge(config, values, age_s, until=347)
    assert monitor.heading_rate.mean()[0] > 0.0
    verdicts.append(monitor.step(values[347], age_s[347]))
    assert monitor.heading_rate.mean()[0] == 0.0
    rest, _ = judge(config, values[348:], age_s[348:], monitor=monitor)
    verdicts += rest
    assert set(phases(verdicts)[330:426]) == {Phase.WARMING}
    assert phases(verdicts)[430] == Phase.HEALTHY
    assert max(verdict.residuals[0, 1:3].max() for verdict in verdicts[347:]) < 0.01


def test_an_old_encoder_reading_is_no_evidence_against_a_motor(config, fly, scenario):
    values, age_s = fly([scenario(turn_m=1.2)], 60.0)
    encoder = AT["wheel_distance_1_m"]
    for k in range(300, values.shape[0]):  # the reading stands still, its age grows
        values[k, 0, encoder], age_s[k, 0, encoder] = values[299, 0, encoder], (k - 299) * 0.1
    verdicts, _ = judge(config, values, age_s)
    assert math.isnan(verdicts[-1].residuals[0, RESIDUAL["motor_1"]])
    assert verdicts[-1].residuals[0, RESIDUAL["motor_2"]] < 0.01
    assert set(phases(verdicts)[2:]) == {Phase.HEALTHY}


def test_a_fix_is_used_once_with_the_time_since_the_one_before(config, fly, scenario):
    values, age_s = fly([scenario()], 40.0)
    shifted, shifted_age_s = values.copy(), age_s.copy()
    gps = slice(AT["velocity_north_m_s"], AT["altitude_m"] + 1)
    shifted_age_s[..., gps] += 0.06  # every fix 60 ms before the row that shows it first
    verdicts, monitor = judge(config, values, age_s)
    again, other = judge(config, shifted, shifted_age_s)
    assert other.air[:, 0] == pytest.approx(monitor.air[:, 0], abs=1e-9)
    assert again[-1].residuals == pytest.approx(verdicts[-1].residuals, abs=1e-9)


def test_nothing_is_judged_before_arming_and_everything_is_forgotten_on_touchdown(config, faulty, fly, scenario):
    values, age_s = (np.array(each[:, 5:6]) for each in faulty)
    verdicts, monitor = judge(config, values, age_s)
    assert named(verdicts[-1]) == "crossed_lines"
    ground, ground_age_s = fly([scenario("crossed_lines", onset_s=0.0)], 60.0)
    ground[..., AT["armed"]] = 0.0
    on_ground, monitor = judge(config, ground, ground_age_s, monitor=monitor)
    assert set(phases(on_ground)) == {Phase.WARMING}
    assert all(np.isnan(verdict.residuals).all() for verdict in on_ground)
    fresh = parafoil.Parafoil(config, flights=1)
    fresh.step(ground[-1], ground_age_s[-1])
    assert all(np.array_equal(array, fresh.state[name], equal_nan=True) for name, array in monitor.state.items())


def test_started_in_mid_flight_it_warms_up_and_takes_the_motors_where_they_are(config, fly, scenario):
    values, age_s = fly([scenario(turn_m=1.2)], 120.0)
    verdicts, _ = judge(config, values[305:], age_s[305:])
    seen = phases(verdicts)
    assert set(seen[:80]) == {Phase.WARMING}
    assert set(seen[83:]) == {Phase.HEALTHY}
    assert max(np.nanmax(verdict.residuals[0, 1:3]) for verdict in verdicts) < 0.01


def test_without_a_forecast_it_waits_until_the_wind_is_found(config, fly, scenario):
    values, age_s = fly([scenario()], 200.0)
    values[..., AT["wind_speed_m_s"]] = math.nan
    verdicts, monitor = judge(config, values, age_s)
    seen = phases(verdicts)
    settled = seen.index(Phase.HEALTHY)
    assert settled >= 80
    assert set(seen[settled:]) == {Phase.HEALTHY}
    assert monitor.air[:2, 0] == pytest.approx([-3.0, 0.0], abs=1.5)
    assert (np.diag(monitor.covariance[..., 0])[:2] < config.settled_wind_variance_m2_s2).all()


def test_the_forecast_of_before_release_is_kept_when_the_vehicle_reports_its_estimate_later(config, fly, scenario):
    values, age_s = fly([scenario()], 0.5)
    values[1:, 0, AT["wind_speed_m_s"]] = 30.0
    _, monitor = judge(config, values, age_s)
    assert monitor.air[:2, 0] == pytest.approx([-3.0, 0.0], abs=0.8)


def test_functions_as_they_were_change_nothing_and_swapped_ones_start_the_turns_anew(config, faulty):
    values, age_s = (np.array(each[:, 5:6]) for each in faulty)
    _, monitor = judge(config, values, age_s)
    before = monitor.state
    monitor.told(0, NORMAL)
    assert all(np.array_equal(array, before[name], equal_nan=True) for name, array in monitor.state.items())
    monitor.told(0, SWAPPED)
    assert np.array_equal(monitor.air[:, 0], before["air"][0])
    seen_rad_s = np.einsum("k,khf->hf", np.array(config.lateral_model.output), monitor.observers)
    assert seen_rad_s == pytest.approx(np.full((4, 1), monitor.air[HEADING_RATE, 0]), abs=1e-12)
    assert not monitor.heading_rate.mean().any()
    verdict = monitor.step(values[-1], age_s[-1])
    assert verdict.phase[0] == Phase.WARMING
    assert named(verdict) is None


def test_crossed_lines_are_mended_by_the_swap_and_stay_judged(config, fly, scenario):
    swap_s = 70.0
    values, age_s = fly([scenario("crossed_lines", onset_s=10.0, swapped_s=swap_s)], 160.0)
    verdicts, monitor = judge(config, values, age_s, until=700)
    assert named(verdicts[-1]) == "crossed_lines"
    monitor.told(0, SWAPPED)
    rest, _ = judge(config, values[700:], age_s[700:], monitor=monitor)
    warming = round(config.warm_up_s / config.period_s)
    assert set(phases(rest[:warming])) == {Phase.WARMING}
    assert set(phases(rest[warming:])) == {Phase.HEALTHY}
    assert max(verdict.residuals[0, 0] for verdict in rest[300:]) < 0.01


def test_a_needless_swap_is_seen_as_crossed_lines(config, fly, scenario):
    values, age_s = fly([scenario(swapped_s=30.0)], 90.0)
    _, monitor = judge(config, values, age_s, until=300)
    monitor.told(0, SWAPPED)
    rest, _ = judge(config, values[300:], age_s[300:], monitor=monitor)
    assert named(rest[-1]) == "crossed_lines"


def test_after_the_mending_swap_the_left_function_pulls_the_left_edge(config, fly, scenario):
    """A motor stays by output, a broken line goes by function; the mended vehicle then loses its left edge's pull."""
    values, age_s = fly([of_fault(scenario, "broken_line:left")], 120.0)
    outputs, encoders = (slice(AT[n], AT[n] + 2) for n in ("output_1_us", "wheel_distance_1_m"))
    values[..., outputs] = values[..., outputs][..., ::-1].copy()
    values[..., encoders] = values[..., encoders][..., ::-1].copy()
    monitor = parafoil.Parafoil(config, flights=1)
    monitor.told(0, SWAPPED)
    verdicts, _ = judge(config, values, age_s, monitor=monitor)
    assert named(verdicts[-1]) == "broken_line:left"
    values, age_s = fly([of_fault(scenario, "motor:left")], 120.0)
    values[..., outputs] = values[..., outputs][..., ::-1].copy()
    values[..., encoders] = values[..., encoders][..., ::-1].copy()
    monitor = parafoil.Parafoil(config, flights=1)
    monitor.told(0, SWAPPED)
    verdicts, _ = judge(config, values, age_s, monitor=monitor)
    assert named(verdicts[-1]) == "motor:right"


@pytest.mark.parametrize("functions", [(77, 77), (0, 78), (math.nan, 78), (1, 2)])
def test_turns_are_not_judged_under_an_assignment_that_cannot_be(config, faulty, functions):
    values, age_s = (np.array(each[:, 5:6]) for each in faulty)
    monitor = parafoil.Parafoil(config, flights=1)
    monitor.told(0, dict(zip(parafoil.PARAMETERS, functions, strict=True)))
    verdicts, _ = judge(config, values, age_s, monitor=monitor)
    assert set(phases(verdicts)) == {Phase.WARMING}
    monitor.told(0, NORMAL)
    verdicts, _ = judge(config, values[700:], age_s[700:], monitor=monitor)
    assert named(verdicts[-1]) == "crossed_lines"


def test_one_parameter_alone_leaves_the_other_as_it_was(config):
    monitor = parafoil.Parafoil(config, flights=2)
    monitor.told(1, {"SERVO1_FUNCTION": 78})
    assert monitor.functions.T.tolist() == [[77.0, 78.0], [78.0, 78.0]]
    monitor.told(1, {"SERVO2_FUNCTION": 77, "OTHER": 3.0})
    assert monitor.functions.T.tolist() == [[77.0, 78.0], [78.0, 77.0]]


def test_signals_come_from_gyro_and_target_and_else_from_filter_and_toggles(config, fly, scenario):
    values, age_s = fly([scenario()], 30.0)
    row, age = values[-1].copy(), age_s[-1].copy()
    row[0, AT["turn_rate_command_rad_s"]] = 0.123
    row[0, AT["yaw_rate_rad_s"]], row[0, AT["pitch_rate_rad_s"]] = 0.2, 0.05
    row[0, AT["roll_rad"]], row[0, AT["pitch_rad"]] = 0.3, -0.1
    _, monitor = judge(config, values[:-1], age_s[:-1])
    state = monitor.state
    signals = monitor.step(row, age).signals[0]
    assert signals == pytest.approx([0.123, (0.05 * math.sin(0.3) + 0.2 * math.cos(0.3)) / math.cos(0.1)], abs=1e-12)
    monitor.state = state
    row[0, AT["turn_rate_command_rad_s"]] = row[0, AT["roll_rad"]] = math.nan
    row[0, AT["output_1_us"]], row[0, AT["output_2_us"]] = 1000.0, 1400.0
    signals = monitor.step(row, age).signals[0]
    assert signals[0] == pytest.approx(0.6 * 0.364795, abs=1e-6)
    assert signals[1] == monitor.air[4, 0]


def test_motor_model_follows_a_step_as_the_motor_does(config):
    monitor = parafoil.Parafoil(config, flights=1)
    row = np.full((1, len(parafoil.CHANNELS)), math.nan)
    row[0, AT["armed"]], row[0, AT["wheel_distance_1_m"]], row[0, AT["wheel_distance_2_m"]] = 1.0, 0.0, 0.0
    row[0, AT["output_1_us"]], row[0, AT["output_2_us"]] = 1000.0 + 1.0 / 0.0015, 1000.0
    positions_m = []
    for _ in range(12):
        monitor.step(row, np.zeros_like(row))
        positions_m.append(float(monitor.motor_m[0, 0]))
    assert positions_m[:11] == pytest.approx([0.07 * (k + 1) for k in range(11)], abs=1e-12)
    assert positions_m[11] == pytest.approx(0.84, abs=0.005)  # 0.84 to two digits: the lag begins at 0.788 m
    assert monitor.motor_m[1, 0] == 0.0


def test_wrong_shapes_raise_and_nothing_else_does(config):
    monitor = parafoil.Parafoil(config, flights=2)
    good = np.zeros((2, len(parafoil.CHANNELS)))
    for values, age_s in ((good[:1], good), (good, good[:, 1:]), (good[0], good[0])):
        with pytest.raises(ValueError, match="shape"):
            monitor.step(values, age_s)
    with pytest.raises(ValueError, match="at least one flight"):
        parafoil.Parafoil(config, flights=0)
    rng = np.random.default_rng(6)
    pool = np.array([math.nan, math.inf, -math.inf, 0.0, 1.0, 1e308, -1e308, 5e-324, 1500.0])
    for _ in range(300):
        monitor.step(rng.choice(pool, good.shape), rng.choice(pool, good.shape))
    assert all(np.isfinite(monitor.state[name]).all() for name in ("air", "covariance", "observers", "motor_m"))


def test_the_step_path_imports_numpy_alone():
    import subprocess
    import sys

    code = (
        "import sys, fdi.parafoil; "
        "print([name for name in ('scipy', 'numba', 'filterpy', 'msgspec', 'pymavlink') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "[]"
