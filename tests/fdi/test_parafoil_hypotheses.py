"""Line inputs, responses and both Kalman filters, against published check values and a filter of plain matrices."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdi.parafoil.hypotheses import (
    BROKEN_LEFT,
    BROKEN_RIGHT,
    CROSSED,
    GPS_STATES,
    GYRO_STATES,
    HEALTHY,
    HYPOTHESES,
    ColouredError,
    GpsFilter,
    GyroFilter,
    correct_gps,
    line_effect,
    line_input,
    predict_gps,
    step_gyro,
    step_response,
    turn_output,
    wrapped,
)
from fdi.parafoil.multimodel import figures_of

GPS_FIGURES = GpsFilter(60.0, 0.30, 0.25, 0.14, 0.0005, ColouredError(2.0, 0.04, 1.2))
GYRO_FIGURES = GyroFilter(0.004, 0.002, ColouredError(1.0, 0.020, 2.0))
NOMINAL_M_S = 18.99
VELOCITIES_M_S = ((18.5, 8.2), (18.3, 8.6), (18.0, 9.1))
RESPONSES_RAD_S = (0.1, 0.2, 0.3)


def start_of_gps():
    return np.array([2.0, -1.0, 19.0, 0.5, 0.01, 0.0, 1.0]), np.diag([4.0, 4.0, 2.0, 0.05, 0.0009, 0.0016, 0.0144])


def start_of_gyro():
    return np.array([0.01, 0.0, 1.0]), np.diag([0.0009, 0.0004, 0.0144])


def run_gps(mean, covariance, fixes=VELOCITIES_M_S, responses=RESPONSES_RAD_S, level=1.0, cross=None):
    """Three fixes 0.2 s apart, the response moving by 0.1 rad/s before each; -> minus the log densities."""
    cross = np.zeros(GPS_STATES + 1) if cross is None else cross
    densities = []
    for response, (north, east) in zip(responses, fixes, strict=True):
        predict_gps(mean, covariance, GPS_FIGURES, 0.2, NOMINAL_M_S, response, 0.1, level)
        densities.append(-correct_gps(mean, covariance, cross, GPS_FIGURES, north, east))
    return densities


def test_gps_filter_has_its_published_check_values():
    mean, covariance = start_of_gps()
    assert run_gps(mean, covariance) == pytest.approx([2.451796035, -1.629977936, -1.568967755], abs=5e-9)
    expected = [1.995652545, -1.005202305, 18.921402468, 0.564215219, 0.005475996, -0.106519948, 0.980662335]
    assert mean == pytest.approx(expected, abs=5e-9)


def test_gyro_filter_has_its_published_check_values():
    mean, covariance = start_of_gyro()
    cross = np.zeros(GYRO_STATES + 1)
    densities = [
        -step_gyro(mean, covariance, cross, GYRO_FIGURES, 0.1, measured, response, 0.1, 1.0)
        for response, measured in zip(RESPONSES_RAD_S, (0.12, 0.15, 0.22), strict=True)
    ]
    assert densities == pytest.approx([-1.590302292, -1.546656123, -1.589956903], abs=5e-9)
    assert mean == pytest.approx([0.010007488, -0.088841913, 0.996161667], abs=5e-9)


def test_responses_have_their_published_check_values_after_twenty_steps(config):
    turns = figures_of(config).turns
    heading_rad_s, yaw_rad_s = [], []
    for hypothesis in range(HYPOTHESES):
        state = np.zeros(4)
        for _ in range(20):
            step_response(state, turns.transition, turns.held_input, line_input(hypothesis, 0.2, 0.7))
        heading_rad_s.append(turn_output(state, turns.heading_output))
        yaw_rad_s.append(turn_output(state, turns.yaw_output))
    assert heading_rad_s == pytest.approx([0.126559479, 0.177183271, -0.050623792, -0.126559479], abs=1e-7)
    assert yaw_rad_s == pytest.approx([0.133193911, 0.186471476, -0.053277564, -0.133193911], abs=1e-7)


def test_a_steady_turn_of_a_radian_a_second_stays_one_under_the_line_that_holds_it(config):
    figures = figures_of(config)
    turns = figures.turns
    state = np.array(turns.steady_turn)
    step_response(state, turns.transition, turns.held_input, 1.0 / figures.turn_gain)
    assert state == pytest.approx(turns.steady_turn, abs=1e-6)
    assert turn_output(state, turns.heading_output) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("pull_m", "slack_m", "effect"),
    [(0.0, 0.0, 0.0), (0.5, 0.0, 0.455), (1.4, 0.0, 1.0472), (0.5, 0.2, 0.2838), (0.2, 0.2, 0.0), (-0.1, 0.0, 0.0)],
)
def test_a_line_does_nothing_within_its_slack_and_less_than_its_length_beyond(pull_m, slack_m, effect):
    assert line_effect(pull_m, slack_m, 0.18) == pytest.approx(effect, abs=1e-12)


effects = st.floats(0.0, 1.1)
MIRRORED = {HEALTHY: HEALTHY, BROKEN_LEFT: BROKEN_RIGHT, BROKEN_RIGHT: BROKEN_LEFT, CROSSED: CROSSED}


@given(effects, effects)
def test_line_inputs_are_mirror_images(left, right):
    for hypothesis, mirrored in MIRRORED.items():
        assert line_input(hypothesis, left, right) == -line_input(mirrored, right, left)


@given(effects, effects)
def test_broken_lines_share_the_turn_of_the_healthy_vehicle_and_crossed_ones_reverse_it(left, right):
    healthy = line_input(HEALTHY, left, right)
    assert line_input(CROSSED, left, right) == -healthy
    assert line_input(BROKEN_LEFT, left, right) + line_input(BROKEN_RIGHT, left, right) == healthy


@given(st.floats(-30.0, 30.0))
def test_a_wrapped_angle_is_the_same_direction_in_the_half_open_turn(angle_rad):
    result_rad = wrapped(angle_rad)
    assert -math.pi - 1e-14 <= result_rad <= math.pi + 1e-14
    assert math.cos(result_rad - angle_rad) == pytest.approx(1.0, abs=1e-12)
    if -math.pi < angle_rad <= math.pi:
        assert result_rad == angle_rad


def random_covariance(rng, states, scale):
    root = rng.normal(0.0, 1.0, (states, states)) * scale[:, None]
    return root @ root.T + np.diag(scale * scale)


def gps_by_matrices(mean, covariance, elapsed_s, response, change, level, north, east):
    """F P F' + Q and two scalar updates, with matrices: the judge of predict_gps and correct_gps."""
    kept, decay = math.exp(-elapsed_s / 60.0), math.exp(-elapsed_s / 2.0)
    F = np.eye(GPS_STATES)
    F[2, 2], F[5, 5] = kept, decay
    F[3, 4], F[3, 5], F[3, 6] = elapsed_s, elapsed_s, elapsed_s * response
    after = F @ mean
    after[2] += NOMINAL_M_S * (1.0 - kept)
    coloured = level * 0.04**2 * (1.0 - decay**2) + (1.2 * change) ** 2
    wind = level * 0.30**2 * elapsed_s
    Q = np.diag([wind, wind, 0.25**2 * elapsed_s, 0.33 * elapsed_s**2 * coloured, 0.0005**2 * elapsed_s, coloured, 0.0])
    P = F @ covariance @ F.T + Q
    density = squares = 0.0
    for axis, measured in enumerate((north, east)):
        direction = np.array([math.cos(after[3]), math.sin(after[3])])
        across = np.array([-direction[1], direction[0]])
        H = np.zeros(GPS_STATES)
        H[axis], H[2], H[3] = 1.0, direction[axis], after[2] * across[axis]
        innovation = measured - after[axis] - after[2] * direction[axis]
        spread = H @ P @ H + 0.14**2
        gain = P @ H / spread
        after = after + gain * innovation
        P = P - np.outer(gain, H @ P)
        density -= 0.5 * (innovation**2 / spread + math.log(spread))
        squares += innovation**2 / spread
    after[3] = math.remainder(after[3], 2.0 * math.pi)
    return after, P, density, squares


@pytest.mark.parametrize("seed", range(5))
def test_gps_filter_is_the_one_of_plain_matrices(seed):
    rng = np.random.default_rng(seed)
    mean = np.array([*rng.normal(0.0, 3.0, 2), rng.normal(19.0, 1.0), rng.uniform(-3.1, 3.1), 0.02, -0.03, 1.1])
    covariance = random_covariance(rng, GPS_STATES, np.array([1.0, 1.0, 0.7, 0.1, 0.01, 0.02, 0.05]))
    response, change, level = rng.normal(0.0, 0.2), abs(rng.normal(0.0, 0.05)), rng.uniform(1.0, 4.0)
    north = mean[0] + mean[2] * math.cos(mean[3]) + rng.normal(0.0, 0.5)
    east = mean[1] + mean[2] * math.sin(mean[3]) + rng.normal(0.0, 0.5)
    expected = gps_by_matrices(mean, covariance, 0.4, response, change, level, north, east)
    cross = np.zeros(GPS_STATES + 1)
    predict_gps(mean, covariance, GPS_FIGURES, 0.4, NOMINAL_M_S, response, change, level)
    density = correct_gps(mean, covariance, cross, GPS_FIGURES, north, east)
    assert mean == pytest.approx(expected[0], abs=1e-10)
    assert covariance == pytest.approx(expected[1], abs=1e-10)
    assert (density, cross[GPS_STATES]) == pytest.approx(expected[2:], abs=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_gyro_filter_is_the_one_of_plain_matrices(seed):
    rng = np.random.default_rng(seed)
    mean = np.array([0.02, -0.01, 0.9])
    covariance = random_covariance(rng, GYRO_STATES, np.array([0.01, 0.02, 0.1]))
    response, change, level, measured = rng.normal(0.0, 0.2), 0.03, 2.5, rng.normal(0.0, 0.2)
    decay = math.exp(-0.3)
    F = np.diag([1.0, decay, 1.0])
    Q = np.diag([0.002**2 * 0.3, level * 0.020**2 * (1.0 - decay**2) + (2.0 * change) ** 2, 0.0])
    H = np.array([1.0, 1.0, response])
    P = F @ covariance @ F.T + Q
    innovation, spread = measured - H @ F @ mean, H @ P @ H + 0.004**2
    after = F @ mean + P @ H / spread * innovation
    cross = np.zeros(GYRO_STATES + 1)
    density = step_gyro(mean, covariance, cross, GYRO_FIGURES, 0.3, measured, response, change, level)
    assert mean == pytest.approx(after, abs=1e-12)
    assert covariance == pytest.approx(P - np.outer(P @ H, P @ H) / spread, abs=1e-12)
    assert density == pytest.approx(-0.5 * (innovation**2 / spread + math.log(spread)), abs=1e-9)
    assert cross[GYRO_STATES] == pytest.approx(innovation**2 / spread, abs=1e-9)


def test_filters_keep_a_symmetric_positive_covariance_over_an_hour(config):
    figures = figures_of(replace(config, detector="gyro")).turns
    mean, covariance = start_of_gps()
    gyro_mean, gyro_covariance = start_of_gyro()
    cross = np.zeros(GPS_STATES + 1)
    heading_rad = 0.5
    for k in range(18_000):
        response = 0.25 if k % 120 < 60 else -0.25
        heading_rad += 0.2 * response
        predict_gps(mean, covariance, figures.gps, 0.2, NOMINAL_M_S, response, 0.0 if k % 60 else 0.5, 1.0)
        north, east = 2.0 + 19.0 * math.cos(heading_rad), 19.0 * math.sin(heading_rad) - 1.0
        correct_gps(mean, covariance, cross, figures.gps, north, east)
        step_gyro(gyro_mean, gyro_covariance, cross, figures.gyro, 0.2, response + 0.01, response, 0.0, 1.0)
    for matrix in (covariance, gyro_covariance):
        assert np.array_equal(matrix, matrix.T)
        assert np.linalg.eigvalsh(matrix).min() > 0.0
    assert mean[:3] == pytest.approx([2.0, -1.0, 19.0], abs=0.05)
    assert gyro_mean == pytest.approx([0.01, 0.0, 1.0], abs=0.005)


def test_a_mirrored_flight_has_mirrored_filters():
    mean, covariance = start_of_gps()
    other, other_covariance = start_of_gps()
    sign = np.array([1.0, -1.0, 1.0, -1.0, -1.0, -1.0, 1.0])  # east, heading and turn rates change their sign
    other *= sign
    here = run_gps(mean, covariance)
    there = run_gps(
        other, other_covariance, [(north, -east) for north, east in VELOCITIES_M_S], [-each for each in RESPONSES_RAD_S]
    )
    assert here == pytest.approx(there, abs=1e-12)
    assert other == pytest.approx(mean * sign, abs=1e-12)
    assert other_covariance == pytest.approx(covariance * np.outer(sign, sign), abs=1e-12)


def test_more_noise_makes_a_surprise_less_surprising():
    densities = []
    for level in (1.0, 4.0):
        mean, covariance = start_of_gyro()
        covariance *= 0.01
        densities.append(step_gyro(mean, covariance, np.zeros(GYRO_STATES + 1), GYRO_FIGURES, 0.1, 0.15, 0.1, 0.0, level))
    assert densities[1] > densities[0] + 0.5
