import math

import numpy as np
import pytest
from numba.core.errors import NumbaError

from sitl.kernel import plant_kernel


def test_a_plant_kernel_that_makes_an_array_does_not_compile():
    @plant_kernel
    def first_of_new(x):
        return np.array([x, x])[0]

    with pytest.raises(NumbaError):
        first_of_new(1.0)
    assert first_of_new.py_func(1.0) == 1.0


def test_a_plant_kernel_that_copies_a_slice_does_not_compile():
    @plant_kernel
    def shift(row):
        row[1:] = row[:-1]

    with pytest.raises(NumbaError, match="NRT required"):
        shift(np.arange(3.0))


def test_a_plant_kernel_divides_by_zero_without_a_word():
    @plant_kernel
    def ratio(a, b):
        return a / b

    assert ratio(1.0, 0.0) == math.inf
    assert math.isnan(ratio(0.0, 0.0))


def test_rows_handed_from_kernel_to_kernel_stay_those_of_the_caller():
    @plant_kernel
    def double(row):
        for i in range(row.size):
            row[i] *= 2.0

    @plant_kernel
    def double_each(rows):
        for f in range(rows.shape[0]):
            row = rows[f]
            double(row)

    rows = np.arange(6.0).reshape(3, 2)
    whole = rows.copy()
    for _ in range(1000):
        double_each(whole[1:])
        whole[1:] /= 2.0
    double_each(whole)
    assert np.array_equal(whole, 2.0 * rows)
