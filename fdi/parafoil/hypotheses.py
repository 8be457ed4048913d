"""What each hypothesis of the turn expects: its line input, its response to it, and its two Kalman filters.

Kernels (fdi/kernel.py) over one hypothesis of one flight.  A filter explains what is measured by the response of its
hypothesis, u, times an effectiveness k, plus a bias b, plus a coloured error n of the model, and tells how likely the
measurement was.  Source: docs/parafoil_method.md, "Ours"; the multiple-model approach is Willsky's (1976), the wind and
heading filter in it that of Ward, Costello and Slegers (2010).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.kernel import kernel

FloatArray = NDArray[np.float64]

HEALTHY, BROKEN_LEFT, BROKEN_RIGHT, CROSSED = range(4)
HYPOTHESES = 4
LINEAR_STATES = 4  # of the lateral model

# states of the filter of GPS velocity, (GPS_STATES,): m/s, m/s, m/s, rad, rad/s, rad/s, 1
WIND_NORTH, WIND_EAST, AIRSPEED, HEADING, BIAS, COLOURED, EFFECTIVENESS = range(7)
GPS_STATES = 7
# states of the filter of the gyro, (GYRO_STATES,)
GYRO_BIAS, GYRO_COLOURED, GYRO_EFFECTIVENESS = range(3)
GYRO_STATES = 3


class ColouredError(NamedTuple):
    """The part of a turn rate that no hypothesis explains: first order, and how it grows while the lines move."""

    time_s: float
    deviation_rad_s: float
    per_change: float  # added deviation per change of the response, 1


class GpsFilter(NamedTuple):
    """Figures of the filter of GPS velocity."""

    airspeed_relaxation_s: float
    wind_noise_m_s_sqrt_s: float
    airspeed_noise_m_s_sqrt_s: float
    velocity_noise_m_s: float  # standard deviation of a measured component
    bias_noise_rad_s_sqrt_s: float
    coloured: ColouredError


class GyroFilter(NamedTuple):
    """Figures of the filter of the turn rate from gyro and attitude."""

    rate_noise_rad_s: float  # standard deviation of a measurement
    bias_noise_rad_s_sqrt_s: float
    coloured: ColouredError


@kernel
def line_effect(pull_m: float, slack_m: float, curvature_per_m: float) -> float:
    """Turning effect of one line, in metres of a straight characteristic: none within its slack, less than linear above."""
    pull = max(pull_m - slack_m, 0.0)
    return pull - curvature_per_m * pull * pull


@kernel
def line_input(hypothesis: int, left: float, right: float) -> float:
    """The effective differential line of a hypothesis, positive to the right, from the effect of both lines."""
    if hypothesis == BROKEN_LEFT:
        return right
    if hypothesis == BROKEN_RIGHT:
        return -left
    if hypothesis == CROSSED:
        return left - right
    return right - left


@kernel
def step_response(state: FloatArray, transition: FloatArray, held_input: FloatArray, pull: float) -> None:
    """x[k+1] = Phi x[k] + G u[k] in place; state: (LINEAR_STATES,)."""
    a, b, c, d = state[0], state[1], state[2], state[3]
    for i in range(LINEAR_STATES):
        state[i] = (
            transition[i, 0] * a + transition[i, 1] * b + transition[i, 2] * c + transition[i, 3] * d + held_input[i] * pull
        )


@kernel
def turn_output(state: FloatArray, output: FloatArray) -> float:
    """Turn rate of a response, rad/s, by its output row, (LINEAR_STATES,)."""
    return float(output[0] * state[0] + output[1] * state[1] + output[2] * state[2] + output[3] * state[3])


@kernel
def wrapped(angle: float) -> float:
    """The same angle in (-pi, pi]; one already there keeps its bits."""
    return angle - 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))


@kernel
def _scale(covariance: FloatArray, state: int, states: int, factor: float) -> None:
    """One state times a factor."""
    for j in range(states):
        covariance[state, j] *= factor
    for j in range(states):
        covariance[j, state] *= factor


@kernel
def _add(covariance: FloatArray, to: int, states: int, state: int, factor: float) -> None:
    """One state grows by a factor times another."""
    for j in range(states):
        covariance[to, j] += factor * covariance[state, j]
    for j in range(states):
        covariance[j, to] += factor * covariance[j, state]


@kernel
def _correct(
    mean: FloatArray, covariance: FloatArray, cross: FloatArray, states: int, innovation: float, spread: float
) -> float:
    """A scalar measurement; cross: P h, (states,), and behind it the sum of squared normalised innovations.

    spread: h' P h + variance; -> log density less log sqrt(2 pi).
    """
    inverse = 1.0 / spread
    squared = innovation * innovation * inverse
    cross[states] += squared
    for i in range(states):
        gain = cross[i] * inverse
        mean[i] += gain * innovation
        for j in range(i + 1):
            value = covariance[i, j] - gain * cross[j]
            covariance[i, j] = value
            covariance[j, i] = value
    return -0.5 * (squared + math.log(spread))


@kernel
def predict_gps(
    mean: FloatArray,
    covariance: FloatArray,
    figures: GpsFilter,
    elapsed_s: float,
    nominal_airspeed_m_s: float,
    response_rad_s: float,
    change_rad_s: float,
    level: float,
) -> None:
    """Carry the filter of GPS velocity over elapsed_s, in place.

    response_rad_s: mean response of the hypothesis in that time; change_rad_s: how much the response changed.  The chi
    of the model moves by b + n + k u; its airspeed relaxes to the nominal one, without which wind along the track and
    airspeed could not be told apart in straight flight.
    """
    n = GPS_STATES
    turn = mean[BIAS] + mean[COLOURED] + mean[EFFECTIVENESS] * response_rad_s
    mean[HEADING] += elapsed_s * turn
    kept = math.exp(-elapsed_s / figures.airspeed_relaxation_s)
    mean[AIRSPEED] = nominal_airspeed_m_s + (mean[AIRSPEED] - nominal_airspeed_m_s) * kept
    coloured = figures.coloured
    decay = math.exp(-elapsed_s / coloured.time_s)
    mean[COLOURED] *= decay
    _add(covariance, HEADING, n, BIAS, elapsed_s)
    _add(covariance, HEADING, n, COLOURED, elapsed_s)
    _add(covariance, HEADING, n, EFFECTIVENESS, elapsed_s * response_rad_s)
    _scale(covariance, AIRSPEED, n, kept)
    _scale(covariance, COLOURED, n, decay)
    wind = level * figures.wind_noise_m_s_sqrt_s * figures.wind_noise_m_s_sqrt_s * elapsed_s
    covariance[WIND_NORTH, WIND_NORTH] += wind
    covariance[WIND_EAST, WIND_EAST] += wind
    covariance[AIRSPEED, AIRSPEED] += figures.airspeed_noise_m_s_sqrt_s * figures.airspeed_noise_m_s_sqrt_s * elapsed_s
    covariance[BIAS, BIAS] += figures.bias_noise_rad_s_sqrt_s * figures.bias_noise_rad_s_sqrt_s * elapsed_s
    added = coloured.per_change * change_rad_s
    own = level * coloured.deviation_rad_s * coloured.deviation_rad_s
    step = own * (1.0 - decay * decay) + added * added
    covariance[COLOURED, COLOURED] += step
    covariance[HEADING, HEADING] += 0.33 * elapsed_s * elapsed_s * step


@kernel
def correct_gps(
    mean: FloatArray, covariance: FloatArray, cross: FloatArray, figures: GpsFilter, north_m_s: float, east_m_s: float
) -> float:
    """Correct by the velocity over ground, north and then east about the result of north; -> log density of both.

    cross: (GPS_STATES,), scratch.  The density lacks the constant 1/(2 pi), which no difference sees.
    """
    variance = figures.velocity_noise_m_s * figures.velocity_noise_m_s
    density = 0.0
    for axis in range(2):
        cos, sin = math.cos(mean[HEADING]), math.sin(mean[HEADING])
        wind = WIND_NORTH + axis
        along = cos if axis == 0 else sin
        across = mean[AIRSPEED] * (-sin if axis == 0 else cos)
        for i in range(GPS_STATES):
            cross[i] = covariance[i, wind] + along * covariance[i, AIRSPEED] + across * covariance[i, HEADING]
        spread = cross[wind] + along * cross[AIRSPEED] + across * cross[HEADING] + variance
        measured = north_m_s if axis == 0 else east_m_s
        innovation = measured - (mean[wind] + mean[AIRSPEED] * along)
        density += _correct(mean, covariance, cross, GPS_STATES, innovation, spread)
    mean[HEADING] = wrapped(mean[HEADING])
    return density


@kernel
def step_gyro(
    mean: FloatArray,
    covariance: FloatArray,
    cross: FloatArray,
    figures: GyroFilter,
    elapsed_s: float,
    turn_rad_s: float,
    response_rad_s: float,
    change_rad_s: float,
    level: float,
) -> float:
    """Carry the filter of the gyro over elapsed_s and correct it by a turn rate; -> log density less its constant."""
    n = GYRO_STATES
    coloured = figures.coloured
    decay = math.exp(-elapsed_s / coloured.time_s)
    mean[GYRO_COLOURED] *= decay
    _scale(covariance, GYRO_COLOURED, n, decay)
    added = coloured.per_change * change_rad_s
    own = level * coloured.deviation_rad_s * coloured.deviation_rad_s
    step = own * (1.0 - decay * decay) + added * added
    covariance[GYRO_COLOURED, GYRO_COLOURED] += step
    covariance[GYRO_BIAS, GYRO_BIAS] += figures.bias_noise_rad_s_sqrt_s * figures.bias_noise_rad_s_sqrt_s * elapsed_s
    for i in range(n):
        of_rate = covariance[i, GYRO_BIAS] + covariance[i, GYRO_COLOURED]
        cross[i] = of_rate + response_rad_s * covariance[i, GYRO_EFFECTIVENESS]
    variance = figures.rate_noise_rad_s * figures.rate_noise_rad_s
    spread = cross[GYRO_BIAS] + cross[GYRO_COLOURED] + response_rad_s * cross[GYRO_EFFECTIVENESS] + variance
    innovation = turn_rad_s - (mean[GYRO_BIAS] + mean[GYRO_COLOURED] + mean[GYRO_EFFECTIVENESS] * response_rad_s)
    return _correct(mean, covariance, cross, n, innovation, spread)
