import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi.reach import highest_reach, lag_share, lagged_step, lowest_reach

STEP_S = 0.1
RATE_M_S, LAG_S, TRAVEL_M = 0.7, 0.25, 1.4
SLOW = lag_share(STEP_S, 1.7 * LAG_S), 0.60 * RATE_M_S * STEP_S
FAST = lag_share(STEP_S, 0.45 * LAG_S), 1.4 * RATE_M_S * STEP_S
ROUNDING_M = 1e-12

metres = st.floats(0.0, TRAVEL_M)
shares = st.floats(SLOW[0], FAST[0])
largest = st.floats(SLOW[1], FAST[1])


def test_a_motor_asked_for_a_metre_runs_at_its_rate_and_then_lags():
    """Published: 0.07 m a step up to 0.77 m, 0.84 m at 1.2 s."""
    position_m, positions_m = 0.0, []
    for _ in range(13):
        position_m = lagged_step(position_m, 1.0, lag_share(STEP_S, LAG_S), RATE_M_S * STEP_S)
        positions_m.append(position_m)
    assert positions_m[:12] == pytest.approx([0.07 * (k + 1) for k in range(12)], abs=1e-12)
    assert positions_m[12] == pytest.approx(1.0 - 0.16 * math.exp(-0.4), abs=1e-12)


def test_a_lag_within_its_rate_is_the_exponential_of_its_time():
    position_m = 0.0
    for k in range(40):
        position_m = lagged_step(position_m, 0.1, lag_share(STEP_S, LAG_S), RATE_M_S * STEP_S)
        assert position_m == pytest.approx(0.1 * (1.0 - math.exp(-(k + 1) * STEP_S / LAG_S)), abs=1e-12)


@pytest.mark.parametrize(("step_s", "lag_s", "share"), [(0.1, 0.25, 0.329680), (0.25, 0.25, 0.632121), (0.0, 1.0, 0.0)])
def test_the_share_of_a_lag_is_what_an_exponential_leaves(step_s, lag_s, share):
    assert lag_share(step_s, lag_s) == pytest.approx(share, abs=5e-7)


@given(metres, metres, shares, largest)
def test_a_step_goes_towards_the_command_and_never_beyond_it_or_the_rate(position_m, command_m, share, largest_m):
    after_m = lagged_step(position_m, command_m, share, largest_m)
    assert min(position_m, command_m) - ROUNDING_M <= after_m <= max(position_m, command_m) + ROUNDING_M
    assert abs(after_m - position_m) <= largest_m + ROUNDING_M


@given(metres, metres, metres, metres, shares, largest)
def test_a_step_is_monotone_in_position_and_in_command(position_m, higher_m, command_m, more_m, share, largest_m):
    low, high = sorted((position_m, higher_m))
    less, more = sorted((command_m, more_m))
    assert lagged_step(low, less, share, largest_m) <= lagged_step(high, more, share, largest_m) + ROUNDING_M


@settings(max_examples=200)
@given(
    st.floats(0.60, 1.4),
    st.floats(0.45, 1.7),
    st.lists(st.tuples(metres, metres, st.floats(0.0, 1.0)), min_size=1, max_size=60),
    metres,
)
def test_the_tube_holds_every_actuator_between_its_extremes_under_every_command_between_theirs(
    rate_factor, lag_factor, commands, start_m
):
    share, largest_m = lag_share(STEP_S, lag_factor * LAG_S), rate_factor * RATE_M_S * STEP_S
    position_m = low_m = high_m = start_m
    for one_m, other_m, where in commands:
        lowest_m, highest_m = sorted((one_m, other_m))
        position_m = lagged_step(position_m, lowest_m + where * (highest_m - lowest_m), share, largest_m)
        low_m = lowest_reach(low_m, lowest_m, SLOW, FAST)
        high_m = highest_reach(high_m, highest_m, SLOW, FAST)
        assert low_m - ROUNDING_M <= position_m <= high_m + ROUNDING_M


@pytest.mark.parametrize("up", [True, False])
def test_the_tube_is_no_wider_than_its_extremes_which_reach_its_ends(up):
    start_m, command_m = (0.0, 1.2) if up else (1.2, 0.0)
    ends_m = np.array([start_m, start_m])
    low_m = high_m = start_m
    for _ in range(30):
        ends_m = np.array(
            [lagged_step(end_m, command_m, *extreme) for end_m, extreme in zip(ends_m, (SLOW, FAST), strict=True)]
        )
        low_m = lowest_reach(low_m, command_m, SLOW, FAST)
        high_m = highest_reach(high_m, command_m, SLOW, FAST)
        assert (low_m, high_m) == (ends_m.min(), ends_m.max())
    assert high_m - low_m < 0.06  # both arrive
