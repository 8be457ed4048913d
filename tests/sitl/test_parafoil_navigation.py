import math

import numpy as np
import pytest

from sitl.parafoil import navigation as nav

FIXES = [(18.5, 8.2), (18.3, 8.6), (18.0, 9.1)]


def start():
    return np.array([2.0, -1.0, 19.0, 0.5, 0.1]), np.diag([4.0, 4.0, 2.0, 0.05, 0.01])


def fly(fixes):
    estimate, covariance = start()
    for fix in fixes:
        nav.predict_estimate(estimate, covariance, 18.99, 0.2)
        nav.update_estimate(estimate, covariance, *fix, np.zeros(nav.ESTIMATE))
    return estimate, covariance


@pytest.mark.parametrize(
    ("fixes", "expected"),
    [
        (1, [1.956579029, -1.069178927, 18.964010033, 0.51077768, 0.099488731]),
        (3, [1.953046571, -1.064306336, 18.985020058, 0.562958182, 0.137500079]),
    ],
)
def test_filter_reaches_its_published_values(fixes, expected):
    assert fly(FIXES[:fixes])[0] == pytest.approx(expected, abs=2e-9)


def by_matrices(fixes):
    """The filter of the textbook, written with matrices."""
    x, P = start()
    for fix in fixes:
        dt, decay = 0.2, math.exp(-0.2 / 60.0)
        F = np.eye(5)
        F[2, 2], F[3, 4] = decay, dt
        x = np.array([x[0], x[1], 18.99 + (x[2] - 18.99) * decay, x[3] + dt * x[4], x[4]])
        Q = np.diag([0.15**2 * dt, 0.15**2 * dt, 0.25**2 * dt, 0.0, 0.0])
        Q[3:, 3:] = 0.20**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        P = F @ P @ F.T + Q
        for axis in range(2):
            direction = np.array([math.cos(x[3]), math.sin(x[3])])[axis]
            slope = x[2] * np.array([-math.sin(x[3]), math.cos(x[3])])[axis]
            H = np.array([axis == 0, axis == 1, direction, slope, 0.0], dtype=float)
            K = P @ H / (H @ P @ H + 0.30**2)
            x = x + K * (fix[axis] - x[axis] - x[2] * direction)
            P = (np.eye(5) - np.outer(K, H)) @ P
    return x, P


def test_filter_agrees_with_the_textbook_form():
    rng = np.random.default_rng(9)
    fixes = [(18.5 - 0.1 * k + rng.normal(0, 0.1), 8.0 + 0.15 * k + rng.normal(0, 0.1)) for k in range(60)]
    estimate, covariance = fly(fixes)
    x, P = by_matrices(fixes)
    assert estimate == pytest.approx(x, rel=1e-9)
    assert covariance == pytest.approx(P, rel=1e-7, abs=1e-10)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_filter_finds_the_wind_while_turning():
    estimate, covariance = np.zeros(nav.ESTIMATE), np.zeros((nav.ESTIMATE, nav.ESTIMATE))
    wind, airspeed = np.array([4.0, -3.0]), 19.5
    rng = np.random.default_rng(10)
    for k in range(500):
        heading = 0.15 * 0.2 * k
        north, east = wind + airspeed * np.array([math.cos(heading), math.sin(heading)]) + rng.normal(0, 0.1, 2)
        if k == 0:
            nav.start_estimate(estimate, covariance, 0.0, 0.0, 18.99, north, east)
            continue
        nav.predict_estimate(estimate, covariance, 18.99, 0.2)
        nav.update_estimate(estimate, covariance, north, east, np.zeros(nav.ESTIMATE))
    assert estimate[:2] == pytest.approx(wind, abs=0.3)
    assert estimate[nav.AIRSPEED] == pytest.approx(airspeed, abs=0.3)
    assert estimate[nav.HEADING_RATE] == pytest.approx(0.15, abs=0.05)
    assert -math.pi < estimate[nav.HEADING] <= math.pi


def test_polar_is_faster_in_thin_air():
    assert nav.polar_airspeed_m_s(2000.0) == pytest.approx(18.99, abs=1e-3)
    assert nav.polar_airspeed_m_s(4500.0) == pytest.approx(18.99 * math.sqrt(1.00649 / 0.7767724972), rel=1e-9)
