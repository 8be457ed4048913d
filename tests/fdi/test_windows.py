import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi.windows import MovingAverage


def mean_by_the_book(history, samples):
    """The slow judge: the last `samples` values that were known, zeros before the first."""
    known = [value for value in history if not np.isnan(value)]
    padded = np.concatenate((np.zeros(samples), known))
    return np.mean(padded[-samples:])


@settings(max_examples=60, deadline=None)
@given(
    samples=st.integers(1, 12),
    values=st.lists(
        st.lists(st.one_of(st.just(float("nan")), st.floats(0.0, 10.0)), min_size=3, max_size=3), min_size=1, max_size=60
    ),
)
def test_mean_is_that_of_the_last_known_samples_with_zeros_before_them(samples, values):
    average = MovingAverage(3, samples)
    history = np.array(values)
    for k, row in enumerate(history):
        average.push(row)
        for lane in range(3):
            assert average.mean()[lane] == pytest.approx(mean_by_the_book(history[: k + 1, lane], samples), abs=1e-12)


def test_mean_has_not_drifted_after_an_hour_at_ten_hertz():
    rng = np.random.default_rng(3)
    values = rng.exponential(0.02, size=36000)
    values[rng.integers(0, 36000, 40)] = 50.0  # what a running sum with subtraction would not get over
    average = MovingAverage(1, 250)
    worst = 0.0
    for k, value in enumerate(values):
        average.push(np.array([value]))
        if k >= 35000:
            worst = max(worst, abs(average.mean()[0] - np.mean(values[k - 249 : k + 1])))
    assert worst < 1e-12


def test_a_large_value_leaves_nothing_behind():
    average = MovingAverage(1, 50)
    for value in [1e12, *([0.25] * 50)]:
        average.push(np.array([value]))
    assert average.mean()[0] == 0.25


def test_a_row_in_company_has_the_bits_of_a_row_alone():
    rng = np.random.default_rng(5)
    values = rng.exponential(1.0, size=(700, 40))
    values[rng.random((700, 40)) < 0.1] = np.nan
    together = MovingAverage(40, 100)
    alone = [MovingAverage(1, 100) for _ in range(40)]
    for row in values:
        together.push(row)
        for lane in (0, 7, 39):
            alone[lane].push(row[lane : lane + 1])
            assert alone[lane].mean()[0] == together.mean()[lane]


def test_emptied_rows_start_anew_and_the_others_go_on():
    average = MovingAverage(2, 4)
    for _ in range(6):
        average.push(np.array([1.0, 3.0]))
    average.empty(np.array([0]))
    assert average.mean().tolist() == [0.0, 3.0]
    average.push(np.array([2.0, 3.0]))
    assert average.mean().tolist() == [0.5, 3.0]


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="at least one row"):
        MovingAverage(0, 5)
    with pytest.raises(ValueError, match="shape"):
        MovingAverage(2, 5).push(np.zeros(3))
