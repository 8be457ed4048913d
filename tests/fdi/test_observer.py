import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_are

from fdi.observer import observer_output, observer_step

A = np.array(
    [
        [-0.33780915, 0.17064889, 0.47879413, -0.96854065],
        [-6.45580223, -4.38948246, -0.34586406, 0.61536152],
        [0.0, 1.0, 0.0, 0.0],
        [0.60606391, -0.87331159, 0.0, -4.12018517],
    ]
)
B = np.array([0.00052726, -0.07847347, 0.0, 1.5151325])
C = np.array([-0.35149863, -0.07166128, 0.49819694, -0.00779011])
L = np.array([-2.673e-4, 5.717e-4, 2.6312e-3, 2.753e-4])


def held(a, inputs, period_s):
    """Exact zero-order hold by the augmented exponential: transition and one column for each input."""
    n = a.shape[0]
    augmented = np.zeros((n + inputs.shape[1], n + inputs.shape[1]))
    augmented[:n, :n], augmented[:n, n:] = a, inputs
    exponential = expm(augmented * period_s)
    return exponential[:n, :n], exponential[:n, n:]


def test_zero_order_hold_of_the_lateral_model_has_its_known_values():
    transition, inputs = held(A, B[:, None], 0.1)
    assert transition[0] == pytest.approx([0.958442762, 0.018709171, 0.046629427, -0.077226086], abs=1e-9)
    assert inputs[:, 0] == pytest.approx([-0.006336521, -0.001554084, -0.000181496, 0.124193312], abs=1e-9)


def test_observer_from_rest_reaches_its_known_state():
    transition, inputs = held(A - np.outer(L, C), np.column_stack((B, L)), 0.1)
    state = np.zeros((4, 1, 1))
    for _ in range(20):
        state = observer_step(state, transition, inputs[:, 0], inputs[:, 1], np.array([[0.5]]), np.array([0.05]))
    assert state[:, 0, 0] == pytest.approx([-0.108273129, 0.160992613, 0.202824734, 0.133201909], abs=4e-9)
    assert observer_output(state, C)[0, 0] == pytest.approx(0.126529925, abs=2e-9)


def test_packaged_model_and_hold_are_those_of_the_design(config):
    model, observer = config.lateral_model, config.observer
    a, b, c, gain = (np.array(each) for each in (model.dynamics, model.input, model.output, observer.gain))
    assert a == pytest.approx(A, abs=5e-7)
    assert b == pytest.approx(B, abs=1e-7)
    assert c == pytest.approx(C, abs=2e-8)
    covariance = solve_continuous_are(a.T, c[:, None], np.diag([1e-4, 0.0, 0.0, 0.06]), np.eye(1))
    assert gain == pytest.approx(covariance @ c, abs=5.1e-8)
    transition, inputs = held(a - np.outer(gain, c), np.column_stack((b, gain)), config.period_s)
    assert np.array(observer.transition) == pytest.approx(transition, abs=1e-13)
    assert np.array(observer.input) == pytest.approx(inputs[:, 0], abs=1e-13)
    assert np.array(observer.feedback) == pytest.approx(inputs[:, 1], abs=1e-13)


def test_model_is_stable_and_turns_by_its_steady_gain(config):
    a, b, c = (
        np.array(each) for each in (config.lateral_model.dynamics, config.lateral_model.input, config.lateral_model.output)
    )
    eigenvalues = np.linalg.eigvals(a)
    assert np.sort(eigenvalues.real) == pytest.approx([-4.924, -2.745, -0.589, -0.589], abs=5e-4)
    assert np.max(eigenvalues.imag) == pytest.approx(0.795, abs=5e-4)
    assert -c @ np.linalg.solve(a, b) == pytest.approx(0.364795, abs=1e-6)


def test_every_hypothesis_and_flight_steps_as_the_matrix_equation_says():
    rng = np.random.default_rng(2)
    transition, input_vector, feedback = rng.normal(size=(4, 4)), rng.normal(size=4), rng.normal(size=4)
    state, inputs, measured = rng.normal(size=(4, 3, 7)), rng.normal(size=(3, 7)), rng.normal(size=7)
    new = observer_step(state, transition, input_vector, feedback, inputs, measured)
    expected = (
        np.einsum("ij,jhf->ihf", transition, state)
        + input_vector[:, None, None] * inputs
        + feedback[:, None, None] * measured
    )
    assert new == pytest.approx(expected, abs=1e-13)
    alone = observer_step(state[..., 4:5], transition, input_vector, feedback, inputs[:, 4:5], measured[4:5])
    assert np.array_equal(alone[..., 0], new[..., 4])
