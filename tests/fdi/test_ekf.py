import dataclasses
import math

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from hypothesis import given
from hypothesis import strategies as st

from fdi.atmosphere import density_kg_m3
from fdi.ekf import scalar_update, wrap_rad

STATE = np.array([2.0, -1.0, 19.0, 0.5, 0.1])
VARIANCES = np.array([4.0, 4.0, 2.0, 0.05, 0.01])


def one(values):
    """A batch of one flight."""
    return np.array(values, dtype=np.float64)[..., None]


def at_reference(config):
    """The packaged filter with exactly the nominal airspeed at 2000 m."""
    return dataclasses.replace(config.navigation, reference_density_kg_m3=float(density_kg_m3(np.array([2000.0]))[0]))


def test_three_fixes_lead_to_the_known_states(config):
    navigation = at_reference(config)
    state, covariance = one(STATE), one(np.diag(VARIANCES))
    states = []
    for velocity_m_s in ((18.5, 8.2), (18.3, 8.6), (18.0, 9.1)):
        navigation.predict(state, covariance, np.array([0.2]), np.array([2000.0]))
        navigation.update(state, covariance, one(velocity_m_s))
        states.append(state[:, 0].copy())
    assert states[0] == pytest.approx([1.956579029, -1.069178927, 18.964010033, 0.51077768, 0.099488731], abs=1e-9)
    assert states[2] == pytest.approx([1.953046571, -1.064306336, 18.985020058, 0.562958182, 0.137500079], abs=1e-9)


def oracle_step(oracle, navigation, elapsed_s, altitude_m, velocity_m_s):
    """The same step by filterpy: prediction, then two updates, each linearised about the newest state."""
    kept = math.exp(-elapsed_s / navigation.airspeed_relaxation_s)
    nominal_m_s = navigation.airspeed_m_s * math.sqrt(
        navigation.reference_density_kg_m3 / float(density_kg_m3(np.array([altitude_m]))[0])
    )
    rate_noise = navigation.heading_rate_noise_rad_s_sqrt_s**2
    oracle.F = np.eye(5)
    oracle.F[2, 2], oracle.F[3, 4] = kept, elapsed_s
    oracle.Q = np.zeros((5, 5))
    oracle.Q[0, 0] = oracle.Q[1, 1] = navigation.wind_noise_m_s_sqrt_s**2 * elapsed_s
    oracle.Q[2, 2] = navigation.airspeed_noise_m_s_sqrt_s**2 * elapsed_s
    oracle.Q[3, 3] = rate_noise * elapsed_s**3 / 3.0
    oracle.Q[3, 4] = oracle.Q[4, 3] = rate_noise * elapsed_s**2 / 2.0
    oracle.Q[4, 4] = rate_noise * elapsed_s
    oracle.predict()
    oracle.x[2] += nominal_m_s * (1.0 - kept)
    for axis, (function, slope) in enumerate(((np.cos, lambda x: -np.sin(x)), (np.sin, np.cos))):

        def expected(x, axis=axis, function=function):
            return np.array([x[axis] + x[2] * function(x[3])])

        def jacobian(x, axis=axis, function=function, slope=slope):
            row = np.zeros((1, 5))
            row[0, axis], row[0, 2], row[0, 3] = 1.0, function(x[3]), x[2] * slope(x[3])
            return row

        oracle.update(np.array([velocity_m_s[axis]]), jacobian, expected, R=np.array([[navigation.velocity_noise_m_s**2]]))
    oracle.x[3] = math.remainder(oracle.x[3], 2.0 * math.pi)


def test_filter_equals_filterpy_over_five_minutes_of_turns_and_uneven_fixes(config):
    navigation, rng = config.navigation, np.random.default_rng(11)
    state, covariance = navigation.start(one([1.0, 2.0]), np.array([4.0]), one([-15.0, 6.0]), np.array([4000.0]))
    oracle = ExtendedKalmanFilter(dim_x=5, dim_z=1)
    oracle.x, oracle.P = state[:, 0].copy(), covariance[..., 0].copy()
    heading_rad, altitude_m = 2.8, 4000.0
    for k in range(1500):
        elapsed_s = float(rng.choice([0.2, 0.2, 0.2, 0.4, 0.9]))
        heading_rad += elapsed_s * 0.3 * math.sin(k / 40.0)
        altitude_m -= 1.1
        velocity_m_s = 20.0 * np.array([math.cos(heading_rad), math.sin(heading_rad)]) + [3.0, -2.0] + rng.normal(0, 0.1, 2)
        navigation.predict(state, covariance, np.array([elapsed_s]), np.array([altitude_m]))
        navigation.update(state, covariance, one(velocity_m_s))
        oracle_step(oracle, navigation, elapsed_s, altitude_m, velocity_m_s)
    assert state[:, 0] == pytest.approx(oracle.x, abs=1e-9)
    assert covariance[..., 0] == pytest.approx(oracle.P, abs=1e-9)
    assert state[:2, 0] == pytest.approx([3.0, -2.0], abs=1.0)


def test_covariance_stays_symmetric_to_the_bit(config):
    state, covariance = one(STATE), one(np.diag(VARIANCES))
    for k in range(300):
        config.navigation.predict(state, covariance, np.array([0.2]), np.array([2000.0]))
        config.navigation.update(state, covariance, one([18.0 + math.sin(k), 5.0]))
    assert np.array_equal(covariance, covariance.transpose(1, 0, 2))
    assert np.min(np.linalg.eigvalsh(covariance[..., 0])) > 0.0


def test_a_flight_in_company_has_the_bits_of_a_flight_alone(config):
    rng = np.random.default_rng(4)
    states = rng.normal(0.0, 1.0, (5, 37)) + STATE[:, None]
    covariances = np.repeat(np.diag(VARIANCES)[:, :, None], 37, axis=2)
    alone_state, alone_covariance = states[:, 5:6].copy(), covariances[..., 5:6].copy()
    for _ in range(50):
        elapsed_s, altitude_m = rng.uniform(0.1, 0.9, 37), rng.uniform(0.0, 5000.0, 37)
        velocity_m_s = rng.normal(10.0, 5.0, (2, 37))
        config.navigation.predict(states, covariances, elapsed_s, altitude_m)
        config.navigation.update(states, covariances, velocity_m_s)
        config.navigation.predict(alone_state, alone_covariance, elapsed_s[5:6].copy(), altitude_m[5:6].copy())
        config.navigation.update(alone_state, alone_covariance, velocity_m_s[:, 5:6].copy())
    assert np.array_equal(alone_state[:, 0], states[:, 5])
    assert np.array_equal(alone_covariance[..., 0], covariances[..., 5])


def test_scalar_update_is_the_text_books():
    rng = np.random.default_rng(9)
    root = rng.normal(size=(3, 3))
    prior, row = root @ root.T, np.array([0.5, 0.0, -2.0])
    state, covariance = one([1.0, 2.0, 3.0]), one(prior)
    scalar_update(state, covariance, np.array([0.7]), ((0, 0.5), (2, np.array([-2.0]))), 0.04)
    gain = prior @ row / (row @ prior @ row + 0.04)
    assert state[:, 0] == pytest.approx([1.0, 2.0, 3.0] + gain * 0.7, abs=1e-12)
    assert covariance[..., 0] == pytest.approx((np.eye(3) - np.outer(gain, row)) @ prior, abs=1e-12)


@given(st.floats(-50.0, 50.0))
def test_wrapping_keeps_the_direction_and_lands_within_half_a_turn(angle_rad):
    wrapped = wrap_rad(np.array([angle_rad]))[0]
    assert -math.pi - 1e-12 < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle_rad), abs=1e-12)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle_rad), abs=1e-12)
    if -math.pi < angle_rad <= math.pi:
        assert wrapped == angle_rad


def test_a_noise_of_nothing_is_refused(config):
    with pytest.raises(ValueError, match="velocity_noise_m_s"):
        dataclasses.replace(config.navigation, velocity_noise_m_s=0.0)
