"""Density of the standard atmosphere below the tropopause."""

import numpy as np
from numpy.typing import NDArray

SEA_LEVEL_DENSITY_KG_M3 = 1.225  # ISO 2533
LAPSE_PER_M = 2.25577e-5  # 0.0065 K/m over 288.15 K
EXPONENT = 4.2559  # g / (R * 0.0065 K/m) - 1


def density_kg_m3(altitude_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Air density at a geopotential altitude above sea level, any shape; NaN where the altitude is NaN.

    Valid from below the sea to 11 000 m; above 44 330 m the formula has no value (NaN).  Source: ISO 2533.
    """
    density: NDArray[np.float64] = SEA_LEVEL_DENSITY_KG_M3 * (1.0 - LAPSE_PER_M * altitude_m) ** EXPONENT
    return density
