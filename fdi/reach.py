"""The reach tube of an actuator: every position that it can have, given every command that it may have heard.

Kernels (fdi/kernel.py) over one actuator: first-order lag behind a rate limit.
"""

import math

from fdi.kernel import kernel


@kernel
def lagged_step(position: float, command: float, share: float, largest: float) -> float:
    """Position after one step: the lag's share of the way to the command, at most `largest` far.

    share = 1 - exp(-step / lag), exact for a held command; largest = rate * step, in the unit of position.
    """
    way = (command - position) * share
    return position + min(max(way, -largest), largest)


@kernel
def lowest_reach(low: float, command: float, slow: tuple[float, float], fast: tuple[float, float]) -> float:
    """The lower end of the tube after one step with the lowest command; slow, fast: (share, largest) of both extremes.

    A step is monotone in position and in command, so that the tube's ends are the ends' steps.
    """
    return min(lagged_step(low, command, slow[0], slow[1]), lagged_step(low, command, fast[0], fast[1]))


@kernel
def highest_reach(high: float, command: float, slow: tuple[float, float], fast: tuple[float, float]) -> float:
    """The upper end after one step with the highest command."""
    return max(lagged_step(high, command, slow[0], slow[1]), lagged_step(high, command, fast[0], fast[1]))


def lag_share(step_s: float, lag_s: float) -> float:
    """The share of the way to a held command that a first-order lag goes in one step."""
    return 1.0 - math.exp(-step_s / lag_s)
