"""Thresholds by written rules, from the largest values that a residual reached in many flights.

For design only: no monitor needs this in flight.  Arrays of maxima are (flight,), each the largest value that a residual
reached in one flight (healthy) or in a while after a fault, in the residual's own unit, the same for all arrays of a call;
a residual that was never known in a flight is NaN there, which is below every threshold: it could raise no alarm.
"Above" is greater than, as monitors compare.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SAME_MERIT = 1e-12  # two figures of merit closer than this differ by rounding alone


@dataclass(frozen=True, slots=True)
class Rates:
    """One threshold and what it costs."""

    threshold: float  # unit of the residual
    false_alarms: float  # share of healthy flights above it, 0..1
    missed: float  # share of flights with a fault not above it, 0..1

    def merit(self, weight: float) -> float:
        """Figure of merit at this weight of false alarms, 0..1; see `figure_of_merit`."""
        return float(figure_of_merit(np.array([self.false_alarms]), np.array([self.missed]), weight)[0])


@dataclass(frozen=True, slots=True)
class TradeOff:
    """The receiver operating characteristic: every threshold worth looking at, ascending, and what it costs."""

    thresholds: FloatArray  # (threshold,), unit of the residual
    false_alarms: FloatArray  # (threshold,), share of healthy flights above, 0..1
    missed: FloatArray  # (threshold,), share of flights with a fault not above, 0..1

    def best(self, weight: float) -> Rates:
        """The threshold of the largest figure of merit.

        weight: of false alarms against missed faults, c1 of c1 + c2 = 1, from 0 to 1.  Of several thresholds equally good
        the smallest, which detects earliest; at weight 0, where false alarms cost nothing, the largest.  Raises ValueError
        for a weight beyond 0 to 1.  Source: parafoil paper, section 4.2.
        """
        merit = figure_of_merit(self.false_alarms, self.missed, weight)
        best = np.flatnonzero(merit >= merit.max() - SAME_MERIT)
        at = best[-1] if weight == 0.0 else best[0]
        return Rates(float(self.thresholds[at]), float(self.false_alarms[at]), float(self.missed[at]))


@dataclass(frozen=True, slots=True)
class Tail:
    """A threshold from an exponential tail."""

    quantile: float  # where the tail begins, unit of the residual
    mean_excess: float  # of the maxima beyond it, same unit
    flights: int  # beyond it
    threshold: float  # unit of the residual


@dataclass(frozen=True, slots=True)
class Elimination:
    """A threshold above which a fault's own residual rules that fault out."""

    threshold: float  # unit of the residual
    own_crosses: float  # share of flights with the fault that would be ruled out wrongly
    others_stay: tuple[float, ...]  # for each other fault, share of flights in which this one would not be ruled out


def cumulative(maxima: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The empirical distribution function, as steps to draw: (values, shares), both (flight,), values ascending.

    shares[i] of the flights, 0 to 1, have a maximum of values[i] or less; flights whose maximum is NaN come first, as minus
    infinity.  Raises ValueError for no flights.  Source: parafoil paper, figures 6, 10, 12 and 13.
    """
    values = _sorted(maxima)
    return values, np.arange(1, values.size + 1) / values.size


def rates(threshold: float, healthy: FloatArray, faulty: FloatArray) -> Rates:
    """What this threshold costs; healthy, faulty: maxima, (flight,) each.  Raises ValueError for no flights of a sort."""
    sound = _count_within(threshold, healthy)
    return Rates(threshold, (healthy.size - sound) / healthy.size, _count_within(threshold, faulty) / faulty.size)


def figure_of_merit(false_alarms: FloatArray, missed: FloatArray, weight: float) -> FloatArray:
    """1 - (c1 P(FA) + c2 P(MD)) with c1 = weight, c2 = 1 - weight; shares 0..1, any shape, the same for both; -> that shape.

    Raises ValueError for a weight beyond 0 to 1.  Source: parafoil paper, Eq. 15.
    """
    if not 0.0 <= weight <= 1.0:
        raise ValueError(f"weight = {weight} is no share; give 0 to 1")
    return 1.0 - (weight * false_alarms + (1.0 - weight) * missed)


def trade_off(healthy: FloatArray, faulty: FloatArray) -> TradeOff:
    """What every value that occurs would cost as a threshold; healthy, faulty: maxima, (flight,) each.

    Between two values that occur nothing changes.  Raises ValueError for no flights of a sort, or none with a known value.
    """
    sound, broken = _sorted(healthy), _sorted(faulty)
    values = np.unique(np.concatenate((sound, broken)))
    values = values[np.isfinite(values)]
    if not values.size:
        raise ValueError("no flight has a known maximum")
    false_alarms = (sound.size - np.searchsorted(sound, values, side="right")) / sound.size
    return TradeOff(values, false_alarms, np.searchsorted(broken, values, side="right") / broken.size)


def tail_threshold(maxima: FloatArray, alpha: float, share: float = 0.05) -> Tail:
    """The threshold that a share alpha of healthy flights would exceed, if the tail of their maxima is exponential.

    maxima: healthy, (flight,); alpha: share of flights, above 0, not above `share`, which is that of the flights the tail
    is fitted to: h = q + mean excess over q * ln(share / alpha), q the quantile of 1 - share.  Raises ValueError for an
    alpha beyond that, for too few flights to have a tail, or where the maxima near it are unknown or all the same.
    Source: the mean excess is the maximum-likelihood scale of an exponential tail; a threshold of rare events lies beyond
    the largest of some hundred flights, where counting says nothing.
    """
    if not 0.0 < alpha <= share < 1.0:
        raise ValueError(f"alpha = {alpha} must be above 0 and not above the tail's share, {share}")
    values = _sorted(maxima)
    if values.size * share < 1.0:
        raise ValueError(f"{values.size} flights have no tail of {share}; fly at least {round(np.ceil(1.0 / share))}")
    # Linear between two order statistics; unknown ones must not meet in it, infinity less infinity is nothing.
    place = (1.0 - share) * (values.size - 1)
    low = int(place)
    if not np.isfinite(values[low]):
        raise ValueError("the maxima are unknown where the tail should begin")
    high = min(low + 1, values.size - 1)
    quantile = float(values[low] + (values[high] - values[low]) * (place - low))
    beyond = values[values > quantile]
    if not beyond.size:
        raise ValueError("the largest maxima are all the same; there is no tail")
    mean_excess = float(np.mean(beyond - quantile))
    return Tail(quantile, mean_excess, int(beyond.size), quantile + mean_excess * float(np.log(share / alpha)))


def elimination(own: FloatArray, others: Sequence[FloatArray]) -> Elimination:
    """The threshold that rules out a fault seldom wrongly and often rightly.

    own: maxima of the fault's own residual where the fault is there, (flight,); others: of the same residual under each of
    the other faults.  Least P(own above) + mean over the others of P(other not above), over all values that occur; of
    several the smallest, which decides earliest.  Raises ValueError for no flights of a sort, no others, or no known value.
    Source: parafoil paper, sections 5.2.1 and 5.2.2, which say what is weighed but not how.
    """
    if not others:
        raise ValueError("a fault is ruled out in favour of another one; give at least one")
    values = np.unique(np.concatenate([_sorted(own), *(_sorted(other) for other in others)]))
    values = values[np.isfinite(values)]
    if not values.size:
        raise ValueError("no flight has a known maximum")
    crosses = (own.size - np.searchsorted(_sorted(own), values, side="right")) / own.size
    stay = [np.searchsorted(_sorted(other), values, side="right") / other.size for other in others]
    cost = crosses + np.mean(stay, axis=0)
    at = int(np.flatnonzero(cost <= cost.min() + SAME_MERIT)[0])
    return Elimination(float(values[at]), float(crosses[at]), tuple(float(each[at]) for each in stay))


def _sorted(maxima: FloatArray) -> FloatArray:
    """Ascending, NaN as minus infinity."""
    if maxima.ndim != 1 or not maxima.size:
        raise ValueError(f"maxima have shape {maxima.shape}; give (flight,), at least one")
    return np.sort(np.where(np.isnan(maxima), -np.inf, maxima))


def _count_within(threshold: float, maxima: FloatArray) -> int:
    return int(np.searchsorted(_sorted(maxima), threshold, side="right"))
