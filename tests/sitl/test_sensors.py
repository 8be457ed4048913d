import math

import numpy as np
import pytest

from sitl.sensors import gauss_markov_step, quantised, standard_pressure_pa


def test_gauss_markov_error_has_its_variance_and_its_memory():
    normal = np.random.default_rng(1).standard_normal(200_000)
    error, errors = 0.0, []
    for n in normal:
        error = gauss_markov_step(error, 1.2, 6.0, 0.2, n)
        errors.append(error)
    x = np.array(errors[1000:])
    assert x.std() == pytest.approx(1.2, rel=0.03)
    assert np.mean(x[30:] * x[:-30]) / x.var() == pytest.approx(math.exp(-1.0), abs=0.03)  # 30 steps are one time constant


def test_a_counter_reads_the_nearest_count():
    assert quantised(0.12345, 0.001) == pytest.approx(0.123, abs=1e-15)
    assert quantised(-0.0007, 0.001) == pytest.approx(-0.001, abs=1e-15)
    assert quantised(0.12345, 0.0) == 0.12345


@pytest.mark.parametrize(("altitude_m", "pressure_pa"), [(0.0, 101325.0), (1000.0, 89874.6), (5000.0, 54019.9)])
def test_pressure_is_that_of_the_standard_atmosphere(altitude_m, pressure_pa):
    assert standard_pressure_pa(altitude_m) == pytest.approx(pressure_pa, rel=2e-5)  # US Standard Atmosphere 1976, table I
