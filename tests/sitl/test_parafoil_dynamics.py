import math

import numpy as np
import pytest

from sitl.parafoil import dynamics as d

STATE = np.array([0.0, 0.0, -2000.0, 19.0, 0.5, 4.5, 0.02, -0.01, 0.1, 0.15, -0.05, 0.3])
AIR = np.array([2.0, -1.0, 0.3, 0.01, -0.02])


def held_at(body, altitude_m):
    held = np.zeros(d.HELD)
    d.hold(held, body, d.density_kg_m3(altitude_m))
    return held


def flown(altitude_m, line_right_m, seconds=90.0, dt_s=0.02):
    """State and derivative after a flight in still air of one density."""
    body = d.nominal_body()
    held = held_at(body, altitude_m)
    state, work, rate, air = np.zeros(d.STATES), np.zeros((5, d.STATES)), np.zeros(d.STATES), np.zeros(d.AIR)
    state[d.U], state[d.W] = 17.5, 4.5
    for _ in range(round(seconds / dt_s)):
        d.runge_kutta(state, 0.0, line_right_m, air, body, held, dt_s, work)
    d.derivative(state, 0.0, line_right_m, air, body, held, rate)
    return state, rate


def test_density_is_that_of_the_standard_atmosphere():
    assert d.density_kg_m3(2000.0) == pytest.approx(1.0064891055, abs=1e-10)
    assert d.density_kg_m3(4500.0) == pytest.approx(0.7767724972, abs=1e-10)


def test_masses_and_arms_of_the_nominal_vehicle():
    body = d.nominal_body()
    assert body[d.CANOPY_ARM_M] == pytest.approx(9.625673619, abs=1e-9)
    assert body[d.PAYLOAD_ARM_M] == pytest.approx(0.374326381, abs=1e-9)
    assert body[[d.RIGID_XX_KG_M2, d.RIGID_YY_KG_M2, d.RIGID_ZZ_KG_M2]] == pytest.approx(
        [3921.845, 3370.239, 873.414], abs=1e-3
    )


def test_apparent_mass_follows_lissaman_and_brown():
    masses = [d.APPARENT_A_M3, d.APPARENT_B_M3, d.APPARENT_C_M3]
    inertias = [d.APPARENT_XX_M5, d.APPARENT_YY_M5, d.APPARENT_ZZ_M5]
    assert masses == pytest.approx([3.684660, 13.859048, 213.800692], abs=1e-6)
    assert inertias == pytest.approx([3404.463, 195.225528, 79.389355], rel=1e-7)
    volume = d.ENCLOSED_AIR_M3
    assert volume == pytest.approx(32.621, abs=1e-3)


def generalised_mass(body, held):
    """The full matrix, 6x6, as the equations have it."""
    arm = body[d.CANOPY_ARM_M]
    mass = body[d.MASS_KG]
    a, b, c = held[d.APPARENT_A], held[d.APPARENT_B], held[d.APPARENT_C]
    matrix = np.diag(
        [
            mass + a,
            mass + b,
            mass + c,
            held[d.TOTAL_XX] + b * arm**2,
            held[d.TOTAL_YY] + a * arm**2,
            held[d.TOTAL_ZZ],
        ]
    )
    matrix[0, 4] = matrix[4, 0] = -a * arm
    matrix[1, 3] = matrix[3, 1] = b * arm
    return matrix


def test_inverse_of_the_mass_matrix_has_its_published_values_and_is_an_inverse():
    body = d.nominal_body()
    held = held_at(body, 2000.0)
    diagonal = [held[i] for i in (d.INVERSE_UU, d.INVERSE_VV, d.INVERSE_WW, d.INVERSE_PP, d.INVERSE_QQ, d.INVERSE_RR)]
    assert diagonal == pytest.approx([1.153232e-3, 1.138255e-3, 9.12211e-4, 8.2701e-5, 1.45398e-4, 6.04646e-4], rel=1e-5)
    assert held[d.INVERSE_UQ] == pytest.approx(5.780293e-5, rel=1e-6)
    assert held[d.INVERSE_VP] == pytest.approx(-4.160961e-5, rel=1e-6)
    inverse = np.diag(diagonal)
    inverse[0, 4] = inverse[4, 0] = held[d.INVERSE_UQ]
    inverse[1, 3] = inverse[3, 1] = held[d.INVERSE_VP]
    assert inverse @ generalised_mass(body, held) == pytest.approx(np.eye(6), abs=1e-12)


def test_derivative_has_its_published_value():
    body = d.nominal_body()
    body[d.TURN_BIAS_M] = 0.05
    rate = np.zeros(d.STATES)
    d.derivative(STATE, 0.2, 0.7, AIR, body, held_at(body, 2000.0), rate)
    expected = [17.9653207, 5.37091306, 5.46813908, 0.04803363, -1.092858, 0.50850483]
    expected += [-0.68668952, 0.54282422, 0.19539209, 0.0151268, -0.02483152, 0.09750458]
    assert rate == pytest.approx(expected, abs=2e-8)


def derivative_by_matrices(state, line_left, line_right, air, body, held):
    """The same equations with vectors, cross products and a linear solver."""
    v, omega, (phi, theta, psi) = state[3:6], state[6:9], state[9:12]
    about_x = np.array([[1, 0, 0], [0, np.cos(phi), -np.sin(phi)], [0, np.sin(phi), np.cos(phi)]])
    about_y = np.array([[np.cos(theta), 0, np.sin(theta)], [0, 1, 0], [-np.sin(theta), 0, np.cos(theta)]])
    about_z = np.array([[np.cos(psi), -np.sin(psi), 0], [np.sin(psi), np.cos(psi), 0], [0, 0, 1]])
    to_ned = about_z @ about_y @ about_x
    v_air = v - to_ned.T @ air[:3]
    canopy, payload = np.array([0, 0, -body[d.CANOPY_ARM_M]]), np.array([0, 0, body[d.PAYLOAD_ARM_M]])
    vc, vp = v_air + np.cross(omega, canopy), v_air + np.cross(omega, payload)
    speed = np.linalg.norm(vc)
    alpha, beta = np.arctan2(vc[2], vc[0]) + np.radians(-9.0), np.arcsin(vc[1] / speed)
    pull = body[d.LINE_FACTOR_RIGHT] * (line_right - 0.18 * line_right**2)
    pull -= body[d.LINE_FACTOR_LEFT] * (line_left - 0.18 * line_left**2)
    both = (line_left + line_right) / 2
    lift = 0.30 + 2.2 * alpha + 0.15 * both - 3.0 * max(alpha - 0.30, 0.0)
    drag = 0.090 * body[d.DRAG_FACTOR] + 0.13 * lift**2 + 0.06 * both
    qs = held[d.DENSITY] * speed**2 * 83.6127 / 2
    p, r = (omega[0] - air[3]) * 15.24 / (2 * speed), (omega[2] - air[4]) * 15.24 / (2 * speed)
    coefficients = np.array(
        [
            15.24 * (-0.25 * p + 0.06 * r - 0.001 * pull),
            4.8768 * (-1.2 * omega[1] * 4.8768 / (2 * speed)),
            15.24 * (0.004 * beta - 0.02 * p - 0.070 * r + 0.01 * body[d.TURN_FACTOR] * (pull + body[d.TURN_BIAS_M])),
        ]
    )
    force = qs * (lift * np.array([vc[2], 0, -vc[0]]) - drag * vc) / speed + [0, -0.40 * beta * qs, 0]
    force -= np.cross(omega, np.array([held[d.APPARENT_A], held[d.APPARENT_B], held[d.APPARENT_C]]) * vc)
    payload_force = -held[d.DENSITY] / 2 * 1.6 * np.linalg.norm(vp) * vp
    mass, inertia = body[d.MASS_KG], np.array([held[d.TOTAL_XX], held[d.TOTAL_YY], held[d.TOTAL_ZZ]])
    total = force + payload_force + mass * 9.80665 * to_ned[2] - mass * np.cross(omega, v)
    moment = (
        np.cross(canopy, force) + qs * coefficients + np.cross(payload, payload_force) - np.cross(omega, inertia * omega)
    )
    accelerations = np.linalg.solve(generalised_mass(body, held), np.concatenate([total, moment]))
    euler = np.array(
        [
            [1, np.sin(phi) * np.tan(theta), np.cos(phi) * np.tan(theta)],
            [0, np.cos(phi), -np.sin(phi)],
            [0, np.sin(phi) / np.cos(theta), np.cos(phi) / np.cos(theta)],
        ]
    )
    return np.concatenate([to_ned @ v, accelerations, euler @ omega])


def random_case(rng):
    body = d.nominal_body()
    d.fill_body(body, rng.uniform(0.8, 1.2))
    body[d.DRAG_FACTOR : d.LINE_FACTOR_RIGHT + 1] *= rng.uniform(0.9, 1.1, 5)
    body[d.TURN_BIAS_M] = rng.uniform(-0.2, 0.2)
    state = STATE + rng.normal(0.0, 0.2, d.STATES) * [100, 100, 100, 10, 5, 5, 1, 1, 1, 2, 2, 5]
    air = rng.normal(0.0, 0.1, d.AIR) * [30, 30, 10, 1, 1]
    left, right = rng.uniform(0.0, 1.4, 2)
    return state, left, right, air, body, held_at(body, rng.uniform(0.0, 4900.0))


def test_derivative_agrees_with_vectors_and_a_linear_solver():
    rng = np.random.default_rng(6)
    rate = np.zeros(d.STATES)
    for _ in range(200):
        case = random_case(rng)
        d.derivative(*case, rate)
        assert rate == pytest.approx(derivative_by_matrices(*case), rel=1e-10, abs=1e-10)


def test_compiled_and_plain_python_give_the_same_bits():
    rng = np.random.default_rng(7)
    compiled, plain = np.zeros(d.STATES), np.zeros(d.STATES)
    for _ in range(100):
        case = random_case(rng)
        d.derivative(*case, compiled)
        d.derivative.py_func(*case, plain)
        assert np.array_equal(compiled, plain)


def test_a_mirrored_vehicle_flies_the_mirrored_way():
    mirror = np.array([1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1.0])
    rng = np.random.default_rng(8)
    rate, mirrored = np.zeros(d.STATES), np.zeros(d.STATES)
    for _ in range(50):
        state, left, right, air, body, held = random_case(rng)
        d.derivative(state, left, right, air, body, held, rate)
        other = body.copy()
        other[[d.LINE_FACTOR_LEFT, d.LINE_FACTOR_RIGHT]] = body[[d.LINE_FACTOR_RIGHT, d.LINE_FACTOR_LEFT]]
        other[d.TURN_BIAS_M] = -body[d.TURN_BIAS_M]
        d.derivative(state * mirror, right, left, air * [1, -1, 1, -1, -1], other, held, mirrored)
        assert mirrored == pytest.approx(rate * mirror, rel=1e-12, abs=1e-12)


def test_without_air_it_falls_and_keeps_its_spin():
    body = d.nominal_body()
    held = np.zeros(d.HELD)
    d.hold(held, body, 1e-30)
    inertia = body[[d.RIGID_XX_KG_M2, d.RIGID_YY_KG_M2, d.RIGID_ZZ_KG_M2]]
    state, work, air = STATE.copy(), np.zeros((5, d.STATES)), np.zeros(d.AIR)
    state[d.P : d.R + 1] = 0.3, -0.2, 0.4
    velocity, spin_energy = np.array(d.velocity_ned_m_s(state)), 0.5 * np.sum(inertia * state[d.P : d.R + 1] ** 2)
    for _ in range(200):
        d.runge_kutta(state, 0.0, 0.0, air, body, held, 0.01, work)
    assert np.array(d.velocity_ned_m_s(state)) - velocity == pytest.approx([0.0, 0.0, 2.0 * d.GRAVITY_M_S2], abs=1e-6)
    assert 0.5 * np.sum(inertia * state[d.P : d.R + 1] ** 2) == pytest.approx(spin_energy, rel=1e-9)


def test_vectors_turn_to_body_and_back():
    x, y, z = d.ned_to_body(STATE, 3.0, -2.0, 1.0)
    state = STATE.copy()
    state[d.U : d.W + 1] = x, y, z
    assert d.velocity_ned_m_s(state) == pytest.approx((3.0, -2.0, 1.0), abs=1e-14)


@pytest.mark.parametrize(
    ("altitude_m", "line_m", "speed", "sink", "yaw_rate", "bank_deg"),
    [
        (0.0, 0.0, 17.912, 4.950, 0.0, 0.0),
        (0.0, 0.5, 17.411, 5.136, 0.1476, 14.40),
        (0.0, 1.0, 17.912, 5.907, 0.2797, 25.78),
        (0.0, 1.4, 19.157, 7.257, 0.4017, 34.81),
        (2000.0, 0.0, 19.761, 5.461, 0.0, 0.0),
        (2000.0, 1.0, 21.564, 8.051, 0.3618, 35.44),
    ],
)
def test_trim_in_still_air(altitude_m, line_m, speed, sink, yaw_rate, bank_deg):
    state, rate = flown(altitude_m, line_m)
    assert np.linalg.norm(state[d.U : d.W + 1]) == pytest.approx(speed, abs=6e-4)
    assert rate[d.DOWN] == pytest.approx(sink, abs=6e-4)
    assert rate[d.PSI] == pytest.approx(yaw_rate, abs=6e-5)
    assert math.degrees(state[d.PHI]) == pytest.approx(bank_deg, abs=6e-3)


def test_a_full_toggle_high_up_ends_in_a_spiral_dive():
    state, rate = flown(2000.0, 1.4)
    assert np.linalg.norm(state[d.U : d.W + 1]) == pytest.approx(29.60, abs=0.006)
    assert rate[d.DOWN] == pytest.approx(21.1, abs=0.06)
    assert rate[d.PSI] == pytest.approx(0.891, abs=6e-4)
    assert math.degrees(state[d.PHI]) == pytest.approx(42.3, abs=0.06)


def test_trim_and_turn_at_two_thousand_metres_to_nine_digits():
    state, rate = flown(2000.0, 0.0)
    assert state[[d.U, d.W, d.THETA]] == pytest.approx([19.185512827, 4.733071625, -0.038134779], abs=5e-8)
    assert rate[d.DOWN] == pytest.approx(5.461088459, abs=5e-8)
    state, rate = flown(2000.0, 0.5)
    assert rate[[d.PSI, d.DOWN]] == pytest.approx([0.16676402, 5.854556768], abs=2e-8)
    assert state[[d.PHI, d.THETA]] == pytest.approx([0.310676307, -0.072657536], abs=2e-9)


def test_a_tenth_of_a_second_is_a_step_small_enough():
    coarse, _ = flown(2000.0, 0.5, seconds=30.0, dt_s=0.1)
    fine, _ = flown(2000.0, 0.5, seconds=30.0, dt_s=0.01)
    assert coarse[: d.W + 1] == pytest.approx(fine[: d.W + 1], abs=2e-3)
    assert coarse[d.P :] == pytest.approx(fine[d.P :], abs=1e-4)


def test_motor_runs_at_its_rate_and_closes_in():
    position, positions = 0.0, []
    for _ in range(12):
        position = d.motor_step(position, 1.0, d.MOTOR_LAG_S, d.MOTOR_RATE_M_S, 0.1)
        positions.append(position)
    assert np.diff(positions[:11]) == pytest.approx([0.07] * 10, abs=1e-12)
    assert positions[10] == pytest.approx(0.77, abs=1e-12)
    assert positions[11] == pytest.approx(0.84, abs=2e-3)
    assert d.motor_step(0.95, 1.0, 0.25, 0.7, 0.1) == pytest.approx(0.95 + 0.05 * (1 - math.exp(-0.4)))
