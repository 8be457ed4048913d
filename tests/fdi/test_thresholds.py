"""Thresholds by rule: against counting one by one, scipy, and the properties that the rules promise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import ecdf, expon

from fdi.thresholds import Rates, cumulative, elimination, figure_of_merit, rates, tail_threshold, trade_off

few_values = arrays(np.float64, st.integers(1, 30), elements=st.sampled_from([0.1, 0.2, 0.3, 0.5, 0.8, 1.3, np.nan]))
known_values = arrays(np.float64, st.integers(1, 30), elements=st.floats(0.0, 1.0))
WEIGHTS = (0.0, 0.2, 0.5, 0.8, 1.0)


def counted(threshold, healthy, faulty):
    """By looking at each flight."""
    alarms = sum(1 for value in healthy if value > threshold)
    missed = sum(1 for value in faulty if not value > threshold)
    return alarms / len(healthy), missed / len(faulty)


def test_figure_of_merit_is_the_papers():
    # Table 1 of the paper: weight of false alarms, P(FA), P(MD), FOM
    for weight, false_alarms, missed, published in (
        (1.0, 0.000, 0.733, 1.000),
        (0.8, 0.012, 0.172, 0.956),
        (0.5, 0.038, 0.119, 0.921),
        (0.4, 0.038, 0.119, 0.913),
        (0.2, 0.038, 0.119, 0.897),
        (0.0, 0.999, 0.017, 0.983),
    ):
        assert Rates(0.0574, false_alarms, missed).merit(weight) == pytest.approx(published, abs=1.1e-3)
    assert figure_of_merit(np.array([0.2, 0.4]), np.array([0.1, 0.1]), 0.5) == pytest.approx([0.85, 0.75])


@pytest.mark.parametrize("weight", [-0.1, 1.1, np.nan])
def test_a_weight_that_is_no_share_is_refused(weight):
    with pytest.raises(ValueError, match="weight"):
        figure_of_merit(np.zeros(1), np.zeros(1), weight)


@given(known_values)
def test_distribution_function_is_scipys(maxima):
    values, shares = cumulative(maxima)
    judge = ecdf(maxima).cdf
    assert np.all(np.diff(values) >= 0.0)
    assert shares[-1] == 1.0
    for value in judge.quantiles:
        assert shares[np.flatnonzero(values == value)[-1]] == pytest.approx(judge.evaluate(value))


@given(few_values, few_values)
def test_rates_and_trade_off_are_what_counting_gives(healthy, faulty):
    if np.isnan(healthy).all() and np.isnan(faulty).all():
        return
    trade = trade_off(healthy, faulty)
    for threshold, false_alarms, missed in zip(trade.thresholds, trade.false_alarms, trade.missed, strict=True):
        assert (false_alarms, missed) == pytest.approx(counted(threshold, healthy, faulty))
        assert rates(float(threshold), healthy, faulty).false_alarms == pytest.approx(false_alarms)
        assert rates(float(threshold), healthy, faulty).missed == pytest.approx(missed)
    assert np.all(np.diff(trade.thresholds) > 0.0)
    assert np.all(np.diff(trade.false_alarms) <= 0.0)
    assert np.all(np.diff(trade.missed) >= 0.0)


@given(few_values, few_values, st.sampled_from(WEIGHTS))
@settings(max_examples=200)
def test_no_threshold_has_a_larger_merit_than_the_best(healthy, faulty, weight):
    if np.isnan(healthy).all() and np.isnan(faulty).all():
        return
    best = trade_off(healthy, faulty).best(weight)
    assert (best.false_alarms, best.missed) == pytest.approx(counted(best.threshold, healthy, faulty))
    candidates = np.unique([*healthy, *faulty])
    merits = {}
    for threshold in candidates[np.isfinite(candidates)]:
        false_alarms, missed = counted(threshold, healthy, faulty)
        merits[threshold] = 1.0 - weight * false_alarms - (1.0 - weight) * missed
    equally_good = [threshold for threshold, merit in merits.items() if merit >= max(merits.values()) - 1e-12]
    assert best.merit(weight) == pytest.approx(max(merits.values()))
    assert best.threshold == (max(equally_good) if weight == 0.0 else min(equally_good))


def test_extreme_weights_take_the_ends():
    healthy, faulty = np.array([1.0, 2.0, 3.0]), np.array([1.5, 2.5, 4.0])
    trade = trade_off(healthy, faulty)
    assert trade.best(1.0) == Rates(3.0, 0.0, pytest.approx(2.0 / 3.0))  # the largest healthy value, none larger needed
    assert trade.best(0.0) == Rates(1.0, pytest.approx(2.0 / 3.0), 0.0)  # the largest one that misses nothing


def test_a_residual_that_was_never_known_raises_no_alarm_and_detects_nothing():
    assert rates(-5.0, np.array([np.nan, 1.0]), np.array([np.nan, np.nan, 1.0])) == Rates(
        -5.0, 0.5, pytest.approx(2.0 / 3.0)
    )
    values, shares = cumulative(np.array([2.0, np.nan]))
    assert values.tolist() == [-np.inf, 2.0]
    assert shares.tolist() == [0.5, 1.0]


def test_tail_threshold_follows_its_formula():
    maxima = np.arange(1.0, 101.0)
    tail = tail_threshold(maxima, 0.001)
    assert tail.quantile == pytest.approx(np.quantile(maxima, 0.95))
    assert tail.flights == 5
    assert tail.mean_excess == pytest.approx(np.mean([96, 97, 98, 99, 100]) - np.quantile(maxima, 0.95))
    assert tail.threshold == pytest.approx(tail.quantile + tail.mean_excess * np.log(50.0))
    assert tail_threshold(maxima, 0.05).threshold == pytest.approx(tail.quantile)


def test_tail_threshold_finds_the_quantile_of_an_exponential_tail():
    rng = np.random.default_rng(7)
    alphas = [expon.sf(tail_threshold(rng.exponential(1.0, 2000), 0.001).threshold) for _ in range(200)]
    assert np.median(alphas) == pytest.approx(0.001, rel=0.15)
    assert np.quantile(alphas, [0.05, 0.95]) == pytest.approx([0.0004, 0.0023], rel=0.25)  # how far the rule scatters


def test_unknown_maxima_do_not_move_the_tail():
    maxima = np.random.default_rng(3).exponential(1.0, 400)
    lowest = np.sort(maxima)[:50]
    some = np.where(np.isin(maxima, lowest), np.nan, maxima)
    assert tail_threshold(some, 0.001) == tail_threshold(maxima, 0.001)


@pytest.mark.parametrize(
    ("maxima", "alpha", "because"),
    [
        (np.arange(100.0), 0.0, "alpha"),
        (np.arange(100.0), 0.06, "alpha"),
        (np.arange(19.0), 0.001, "at least 20"),
        (np.ones(100), 0.001, "no tail"),
        (np.where(np.arange(100) < 97, np.nan, 1.0), 0.001, "unknown"),
        (np.zeros((2, 50)), 0.001, "shape"),
    ],
)
def test_a_tail_that_cannot_be_fitted_is_refused(maxima, alpha, because):
    with pytest.raises(ValueError, match=because):
        tail_threshold(maxima, alpha)


@given(known_values, known_values, known_values)
def test_no_threshold_rules_out_at_less_cost(own, one, other):
    found = elimination(own, (one, other))

    def cost(threshold):
        return np.mean(own > threshold) + (np.mean(one <= threshold) + np.mean(other <= threshold)) / 2.0

    assert found.own_crosses == pytest.approx(np.mean(own > found.threshold))
    assert found.others_stay == pytest.approx((np.mean(one <= found.threshold), np.mean(other <= found.threshold)))
    assert all(cost(found.threshold) <= cost(threshold) + 1e-9 for threshold in (*own, *one, *other))


def test_faults_that_separate_are_ruled_out_at_the_largest_own_value():
    found = elimination(np.array([0.01, 0.03, 0.02]), (np.array([0.2, 0.3]), np.array([0.5])))
    assert found.threshold == 0.03
    assert found.own_crosses == 0.0
    assert found.others_stay == (0.0, 0.0)


def test_nothing_to_weigh_is_refused():
    with pytest.raises(ValueError, match="at least one"):
        elimination(np.ones(3), ())
    with pytest.raises(ValueError, match="shape"):
        trade_off(np.zeros(0), np.ones(3))
    with pytest.raises(ValueError, match="known"):
        trade_off(np.full(2, np.nan), np.full(2, np.nan))
    with pytest.raises(ValueError, match="known"):
        elimination(np.full(2, np.nan), (np.full(2, np.nan),))
