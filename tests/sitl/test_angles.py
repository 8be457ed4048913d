import math

import pytest

from sitl.angles import wrap_pi, wrap_turn


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(0.0, 0.0), (math.pi, math.pi), (-math.pi, math.pi), (3.5, 3.5 - 2 * math.pi), (-10.0, -10.0 + 4 * math.pi)],
)
def test_angles_end_above_minus_pi_and_at_most_at_pi(angle, wrapped):
    assert wrap_pi(angle) == pytest.approx(wrapped, abs=1e-14)


@pytest.mark.parametrize(
    ("angle", "wrapped"), [(0.0, 0.0), (-0.5, 2 * math.pi - 0.5), (7.0, 7.0 - 2 * math.pi), (-1e-20, 0.0)]
)
def test_headings_end_from_zero_to_below_a_turn(angle, wrapped):
    assert wrap_turn(angle) == pytest.approx(wrapped, abs=1e-14)
    assert 0.0 <= wrap_turn(angle) < 2 * math.pi
