import numpy as np
import pytest

from sitl.noise import BLOCK_STEPS, StandardNormals, generators


def test_each_flight_has_its_own_numbers_whatever_its_company():
    alone = StandardNormals(generators([7]), 3)
    crowd = StandardNormals(generators([1, 7, 2]), 3)
    for _ in range(2 * BLOCK_STEPS + 5):
        row = alone.next_row()
        assert crowd.next_row() == row
        assert np.array_equal(alone.values[0, row], crowd.values[1, row])


def test_no_number_comes_twice():
    normals = StandardNormals(generators([3, 4]), 2)
    seen = np.concatenate([normals.values[:, normals.next_row()].ravel() for _ in range(3 * BLOCK_STEPS)])
    assert np.unique(seen).size == seen.size
    assert abs(seen.mean()) < 0.1
    assert abs(seen.std() - 1.0) < 0.1


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError):
        generators([-1])
