"""Errors of sensors, as kernels use them: one number in, one number out."""

import math

from sitl.kernel import plant_kernel


@plant_kernel
def gauss_markov_step(error: float, sigma: float, time_constant_s: float, dt_s: float, normal: float) -> float:
    """Next value of a first-order Gauss-Markov error, exact over dt_s.

    error and sigma (its stationary standard deviation) in the same unit, which is that of the result; normal: N(0, 1).
    Source: Gelb, "Applied Optimal Estimation", section 3.6: e' = a e + sigma sqrt(1 - a^2) n, a = exp(-dt/T).
    """
    decay = math.exp(-dt_s / time_constant_s)
    return decay * error + sigma * math.sqrt(1.0 - decay * decay) * normal


@plant_kernel
def quantised(value: float, resolution: float) -> float:
    """The reading of a counting sensor: the nearest multiple of its resolution (same unit; 0: not quantised)."""
    return value if resolution <= 0.0 else math.floor(value / resolution + 0.5) * resolution


@plant_kernel
def standard_pressure_pa(altitude_m: float) -> float:
    """Static pressure, Pa, at an altitude above sea level, m, below 11 km.  Source: ICAO standard atmosphere, Doc 7488."""
    return 101325.0 * math.pow(1.0 - 2.25577e-5 * altitude_m, 5.25588)
