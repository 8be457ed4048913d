import math
from dataclasses import replace

import numpy as np
import pytest

import fdi.parafoil as parafoil
from companion.compiler import compiler
from fdi import kernel
from fdi.parafoil.hypotheses import ColouredError, GpsFilter, GyroFilter, correct_gps, predict_gps, step_gyro
from fdi.verdict import NO_FAULT, Phase

AT = {name: index for index, name in enumerate(parafoil.CHANNELS)}
IDS = [fault.id for fault in parafoil.FAULTS]
SWAPPED = {"SERVO1_FUNCTION": 78, "SERVO2_FUNCTION": 77}


@pytest.fixture(params=["gyro", "gps"])
def ours(request, config):
    return replace(config, detector=request.param)


@pytest.fixture(scope="module")
def faulty(fly, scenario):
    """A minute and a half of every fault, with a healthy flight first; order as in FAULTS."""
    flights = [scenario(), *(scenario(fault_id, stuck_m=0.3, turn_m=1.15) for fault_id in IDS)]
    values, age_s = fly(flights, 90.0)
    return values, age_s


def judge(monitor, values, age_s):
    return [monitor.step(row, age) for row, age in zip(values, age_s, strict=True)]


def test_every_fault_is_named_with_a_confidence_and_a_healthy_flight_is_left_alone(ours, faulty):
    verdicts = judge(parafoil.Monitor(ours, flights=6), *faulty)
    last = verdicts[-1]
    assert list(last.fault) == [NO_FAULT, *range(5)]
    assert last.phase[0] == Phase.HEALTHY
    assert (last.phase[1:] == Phase.ISOLATED).all()
    assert ((last.confidence[1:] > 0.9) & (last.confidence[1:] < 1.0)).all()
    for f in range(6):
        loud = [v.phase[f] >= Phase.DETECTED for v in verdicts]
        assert not any(loud[:300])  # before the onset
    assert np.abs(last.size[1:3] - 0.3).max() < 0.02  # where the motors are stuck
    assert np.isnan(last.size[3:]).all()


def test_plain_python_and_machine_code_have_the_same_bits(config, faulty):
    values, age_s = (each[:600] for each in faulty)
    plain, machine = (parafoil.MultipleModel(config, 6, compiler=each) for each in (None, compiler()))
    for row, age in zip(values, age_s, strict=True):
        first, second = plain.step(row, age), machine.step(row, age)
        assert first.residuals.tobytes() == second.residuals.tobytes()
    other = machine.state
    assert all(array.tobytes() == other[name].tobytes() for name, array in plain.state.items())


def test_a_flight_alone_has_the_bits_of_the_flight_in_company_and_resumes(ours, faulty):
    values, age_s = (each[:500] for each in faulty)
    whole = parafoil.Monitor(ours, flights=6)
    judge(whole, values, age_s)
    alone = parafoil.Monitor(ours, flights=1)
    judge(alone, values[:250, 5:], age_s[:250, 5:])
    resumed = parafoil.Monitor(ours, flights=1)
    resumed.state = alone.state
    judge(resumed, values[250:, 5:], age_s[250:, 5:])
    for name, array in resumed.state.items():
        assert array.tobytes() == whole.state[name][5:].tobytes(), name


def test_a_needless_swap_is_called_crossed_lines_and_a_mending_one_stays_healthy(ours, fly, scenario):
    needless = scenario()
    mended = scenario("crossed_lines", onset_s=0.0, swapped_s=40.0)
    values, age_s = fly([needless, mended], 90.0)
    monitor = parafoil.Monitor(ours, flights=2)
    judge(monitor, values[:400], age_s[:400])
    monitor.told(0, SWAPPED)
    monitor.told(1, SWAPPED)
    verdicts = judge(monitor, values[400:], age_s[400:])
    named_s = next(k for k, verdict in enumerate(verdicts) if verdict.fault[0] != NO_FAULT) * 0.1
    assert IDS[verdicts[-1].fault[0]] == "crossed_lines"
    assert named_s < 20.0
    assert all(verdict.phase[1] <= Phase.HEALTHY for verdict in verdicts)


def test_a_fault_that_passes_is_taken_back(ours, fly, scenario):
    values, age_s = fly([scenario("crossed_lines", onset_s=30.0)], 60.0)
    monitor = parafoil.Monitor(ours, flights=1)
    assert IDS[judge(monitor, values, age_s)[-1].fault[0]] == "crossed_lines"
    healthy, ages = fly([scenario()], 120.0)
    assert judge(monitor, healthy[600:], ages[600:])[-1].phase[0] == Phase.HEALTHY


def test_half_a_minute_without_gps_is_not_judged_and_raises_nothing(ours, fly, scenario):
    values, age_s = fly([scenario()], 120.0)
    values[400:700, 0, AT["velocity_north_m_s"] : AT["altitude_m"] + 1] = math.nan
    phases = [verdict.phase[0] for verdict in judge(parafoil.Monitor(ours, flights=1), values, age_s)]
    assert set(phases[420:700]) == {Phase.WARMING}
    assert phases[-1] == Phase.HEALTHY
    assert max(phases) == Phase.HEALTHY


def test_without_attitude_the_gyro_detector_judges_by_gps(config, fly, scenario):
    values, age_s = fly([scenario("crossed_lines")], 60.0)
    values[:, 0, AT["yaw_rate_rad_s"] : AT["pitch_rad"] + 1] = math.nan
    with_gyro = judge(parafoil.Monitor(config, flights=1), values, age_s)
    with_gps = judge(parafoil.Monitor(replace(config, detector="gps"), flights=1), values, age_s)
    assert [v.phase[0] for v in with_gyro] == [v.phase[0] for v in with_gps]
    assert with_gyro[-1].fault[0] == IDS.index("crossed_lines")


def test_lost_and_late_commands_and_encoders_accuse_no_motor(config, fly, scenario):
    values, age_s = fly([scenario(turn_m=1.2)], 300.0)
    rng = np.random.default_rng(3)
    for columns in (
        slice(AT["output_1_us"], AT["output_2_us"] + 1),
        slice(AT["wheel_distance_1_m"], AT["wheel_distance_2_m"] + 1),
    ):
        for k in range(1, len(values)):
            if rng.random() < 0.1:  # lost: the value of the row before, one period older
                values[k, :, columns] = values[k - 1, :, columns]
                age_s[k, :, columns] = age_s[k - 1, :, columns] + 0.1
    verdicts = judge(parafoil.Monitor(config, flights=1), values, age_s)
    assert all(verdict.fault[0] == NO_FAULT for verdict in verdicts)


def test_gps_filter_has_its_check_values():
    figures = GpsFilter(60.0, 0.30, 0.25, 0.14, 0.0005, ColouredError(2.0, 0.04, 1.2))
    mean, cross = np.array([2.0, -1.0, 19.0, 0.5, 0.01, 0.0, 1.0]), np.zeros(8)
    covariance = np.diag([4.0, 4.0, 2.0, 0.05, 0.0009, 0.0016, 0.0144])
    densities = []
    for response, (north, east) in zip((0.1, 0.2, 0.3), ((18.5, 8.2), (18.3, 8.6), (18.0, 9.1)), strict=True):
        predict_gps(mean, covariance, figures, 0.2, 18.99, response, 0.1, 1.0)
        densities.append(-correct_gps(mean, covariance, cross, figures, north, east))
    assert densities == pytest.approx([2.451796035, -1.629977936, -1.568967755], abs=1e-8)
    expected = [1.995652545, -1.005202305, 18.921402468, 0.564215219, 0.005475996, -0.106519948, 0.980662335]
    assert mean == pytest.approx(expected, abs=1e-8)


def test_gyro_filter_has_its_check_values():
    figures = GyroFilter(0.004, 0.002, ColouredError(1.0, 0.020, 2.0))
    mean, covariance, cross = np.array([0.01, 0.0, 1.0]), np.diag([0.0009, 0.0004, 0.0144]), np.zeros(4)
    densities = [
        -step_gyro(mean, covariance, cross, figures, 0.1, measured, response, 0.1, 1.0)
        for response, measured in zip((0.1, 0.2, 0.3), (0.12, 0.15, 0.22), strict=True)
    ]
    assert densities == pytest.approx([-1.590302292, -1.546656123, -1.589956903], abs=1e-8)
    assert mean == pytest.approx([0.010007488, -0.088841913, 0.996161667], abs=1e-8)


def test_the_monitor_is_that_of_the_detector_and_compiles_only_kernels(config):
    assert isinstance(parafoil.Monitor(config, flights=1), parafoil.MultipleModel)
    assert isinstance(parafoil.Monitor(replace(config, detector="paper"), flights=1), parafoil.Parafoil)
    with pytest.raises(ValueError, match="is no kernel"):
        kernel.compiled(judge, lambda function: function)
    with pytest.raises(ValueError, match="at least one flight"):
        parafoil.MultipleModel(config, 0)
