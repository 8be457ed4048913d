"""Shares with their Wilson 95 % intervals, as every campaign prints them."""

import math


def wilson(count: int, of: int) -> tuple[float, float]:
    """95 % interval of a share."""
    if of == 0:
        return math.nan, math.nan
    z = 1.959963984540054
    share, spread = count / of, z * z / of
    middle = (share + spread / 2.0) / (1.0 + spread)
    half = z / (1.0 + spread) * math.sqrt(share * (1.0 - share) / of + spread / (4.0 * of))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def share(count: int, of: int) -> str:
    low, high = wilson(count, of)
    return f"{count / of if of else math.nan:.3f} [{low:.3f}, {high:.3f}]"
