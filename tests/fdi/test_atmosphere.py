import math

import numpy as np
import pytest

from fdi.atmosphere import density_kg_m3


def test_density_has_its_published_values():
    densities = density_kg_m3(np.array([0.0, 2000.0, 4500.0]))
    assert densities == pytest.approx([1.225, 1.0064891055, 0.7767724972], abs=5e-11)
    # ISO 2533, table of the standard atmosphere at geopotential altitudes
    assert density_kg_m3(np.array([11000.0])) == pytest.approx([0.363918], abs=2e-5)


def test_density_of_an_unknown_altitude_is_unknown():
    assert math.isnan(density_kg_m3(np.array([math.nan]))[0])
