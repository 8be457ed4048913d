"""Wind and turbulence: the mean profile, MIL-F-8785C intensities, Dryden filters, rotary gusts.

Kernels over one flight; heights are above ground, vectors NED.  The gust filters keep their state in small arrays that
the caller owns and change it in place.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sitl.kernel import plant_kernel

FOOT_M = 0.3048
LOW_ALTITUDE_M = 305.0  # below: the low-altitude law; above twice this: constant length and intensity
HIGH_LENGTH_M = 533.4  # 1750 ft, MIL-F-8785C, medium and high altitude
SQRT3 = 1.7320508  # (1 + sqrt3 T s)/(1 + T s)^2 = sqrt3 x1 - (sqrt3 - 1) x2, with x1, x2 as in `transverse_step`

# columns of a gust state, (GUSTS,): first and second filter of each NED component, roll gust, low-passed lateral gust
FIRST_NORTH, FIRST_EAST, FIRST_DOWN, SECOND_NORTH, SECOND_EAST, SECOND_DOWN, ROLL_GUST, LOW_NORTH, LOW_EAST = range(9)
GUSTS = 9

# columns of a wind profile, (PROFILE,)
SPEED_10M, DIRECTION, VEER, SHEAR, SHEAR_LENGTH, SHEAR_PHASE, SIGMA = range(7)
PROFILE = 7


@plant_kernel
def profile_wind(profile: NDArray[np.float64], height_m: float) -> tuple[float, float]:
    """Wind without its shear wave, (north, east), m/s, at a height above ground, m.

    profile: (PROFILE,): speed at 10 m (m/s), direction the wind blows to near the ground (rad, clockwise from north),
    veer (rad/km), and the rest, not used here.  Speed grows as height to the power 0.15, from 10 m on.
    """
    speed = profile[SPEED_10M] * math.pow(max(height_m, 10.0) / 10.0, 0.15)
    direction = profile[DIRECTION] + profile[VEER] * height_m / 1000.0
    return speed * math.cos(direction), speed * math.sin(direction)


@plant_kernel
def mean_wind(profile: NDArray[np.float64], height_m: float) -> tuple[float, float]:
    """Wind without turbulence, (north, east), m/s: `profile_wind` and a wave across it.

    The wave is amplitude * sin(2 pi h / length + phase), positive 90 degrees clockwise of the wind's vector.
    """
    north, east = profile_wind(profile, height_m)
    direction = profile[DIRECTION] + profile[VEER] * height_m / 1000.0
    across = profile[SHEAR] * math.sin(2.0 * math.pi * height_m / profile[SHEAR_LENGTH] + profile[SHEAR_PHASE])
    return north - across * math.sin(direction), east + across * math.cos(direction)


@plant_kernel
def turbulence(height_m: float, wind_20ft_m_s: float, sigma_high_m_s: float) -> tuple[float, float, float]:
    """Length scale, m, horizontal and vertical intensity, m/s, of Dryden turbulence at a height above ground, m.

    Below 305 m MIL-F-8785C's low-altitude law, horizontal (h in feet, at least 10 m, at most 1000 ft): L = h/k^1.2,
    sigma = 0.1 W20/k^0.4, k = 0.177 + 0.000823 h; above 610 m 533.4 m and sigma_high_m_s; linear between.
    Vertical: the same, but below 305 m 0.1 W20 and at most sigma_high_m_s.
    """
    low_sigma = 0.1 * wind_20ft_m_s
    if height_m < LOW_ALTITUDE_M:
        height_ft = min(max(height_m, 10.0) / FOOT_M, 1000.0)
        k = 0.177 + 0.000823 * height_ft
        length = height_ft / math.pow(k, 1.2) * FOOT_M
        return length, low_sigma / math.pow(k, 0.4), min(low_sigma, sigma_high_m_s)
    weight = min((height_m - LOW_ALTITUDE_M) / LOW_ALTITUDE_M, 1.0)
    length = 1000.0 * FOOT_M + weight * (HIGH_LENGTH_M - 1000.0 * FOOT_M)
    sigma = low_sigma + weight * (sigma_high_m_s - low_sigma)
    return length, sigma, sigma


@plant_kernel
def transverse_gust(gust: NDArray[np.float64], axis: int, sigma_m_s: float) -> float:
    """Gust along one axis, m/s, from the two filters of that axis: sigma/sqrt2 (sqrt3 x1 - (sqrt3 - 1) x2)."""
    shape = SQRT3 * gust[FIRST_NORTH + axis] - (SQRT3 - 1.0) * gust[SECOND_NORTH + axis]
    return float(sigma_m_s / math.sqrt(2.0) * shape)


@plant_kernel
def transverse_step(
    gust: NDArray[np.float64], normal: NDArray[np.float64], length_m: float, airspeed_m_s: float, dt_s: float
) -> None:
    """Step the transverse Dryden filters of all three NED axes over dt_s, in place.

    gust: (GUSTS,); normal: at least (3,), N(0, 1).  White noise through 1/(1 + T s) is x1 (unit variance), x1 through
    the same is x2, T = L/V.  The same form on all axes and in NED: a frozen isotropic field; body axes would drag the
    gusts round with a turning canopy.  Source: MIL-F-8785C, 3.7.1.2, Dryden form, lateral.
    """
    decay = math.exp(-dt_s * airspeed_m_s / length_m)
    drive = math.sqrt(1.0 - decay * decay)
    for axis in range(3):
        first = gust[FIRST_NORTH + axis]
        gust[SECOND_NORTH + axis] = decay * gust[SECOND_NORTH + axis] + (1.0 - decay) * first
        gust[FIRST_NORTH + axis] = decay * first + drive * normal[axis]


@plant_kernel
def roll_gust_sigma(sigma_vertical_m_s: float, length_m: float, span_m: float) -> float:
    """Standard deviation of the roll gust, rad/s.  Source: MIL-F-8785C, 3.7.1.3, spectrum of p_g, integrated."""
    shape = math.pow(math.pi * length_m / (4.0 * span_m), 1.0 / 3.0)
    return sigma_vertical_m_s * math.sqrt(0.8 * shape * math.pi * math.pi / (8.0 * span_m * length_m))


@plant_kernel
def roll_gust_step(
    gust: NDArray[np.float64], sigma_rad_s: float, span_m: float, airspeed_m_s: float, dt_s: float, normal: float
) -> float:
    """Step the roll gust, rad/s, and return it: first order, time constant 4 b/(pi V).  Source: MIL-F-8785C, 3.7.1.3."""
    decay = math.exp(-dt_s * math.pi * airspeed_m_s / (4.0 * span_m))
    gust[ROLL_GUST] = decay * gust[ROLL_GUST] + sigma_rad_s * math.sqrt(1.0 - decay * decay) * normal
    return float(gust[ROLL_GUST])


@plant_kernel
def yaw_gust_step(
    gust: NDArray[np.float64],
    gust_north_m_s: float,
    gust_east_m_s: float,
    yaw_rad: float,
    span_m: float,
    airspeed_m_s: float,
    dt_s: float,
) -> float:
    """Yaw gust, rad/s, from the lateral gust: (g - g_low)/(V T), g_low first order with T = 3 b/(pi V).

    Low-passed in NED (Euler step), so that turning alone makes no gust.  Source: MIL-F-8785C, 3.7.1.3,
    r_g/v_g = (s/V)/(1 + 3 b s/(pi V)).
    """
    time_constant_s = 3.0 * span_m / (math.pi * airspeed_m_s)
    gust[LOW_NORTH] += dt_s / time_constant_s * (gust_north_m_s - gust[LOW_NORTH])
    gust[LOW_EAST] += dt_s / time_constant_s * (gust_east_m_s - gust[LOW_EAST])
    sin_yaw = math.sin(yaw_rad)
    cos_yaw = math.cos(yaw_rad)
    lateral = -gust_north_m_s * sin_yaw + gust_east_m_s * cos_yaw
    low = -gust[LOW_NORTH] * sin_yaw + gust[LOW_EAST] * cos_yaw
    return float((lateral - low) / (airspeed_m_s * time_constant_s))
