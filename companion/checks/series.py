"""Samples kept for judgements that need the whole flight: joined at common times, fitted over windows.

Samples of different boots never meet: their stamps are not of one clock.
"""

import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from companion.checks.finding import Mean, Means

Array = NDArray[np.float64]


@dataclass(slots=True)
class Series:
    """Rows of (t_s, value ...), by boot; all of one length."""

    columns: int = 1
    _flat: dict[int, "array[float]"] = field(default_factory=dict)  # row behind row: tuples take four times the room

    def take(self, boot: int, row: tuple[float, ...]) -> None:
        flat = self._flat.get(boot)
        if flat is None:
            self.columns = len(row)
            flat = self._flat[boot] = array("d")
        flat.extend(row)

    def longest(self, values: slice = slice(0, 1)) -> int | None:
        """The boot with the most rows in which the first of these values is known; None if there are none."""
        known = {boot: int(np.count_nonzero(~np.isnan(self._rows(boot)[:, 1 + values.start]))) for boot in self._flat}
        return max(filter(known.__getitem__, known), key=known.__getitem__, default=None)

    def _rows(self, boot: int) -> Array:
        return np.array(self._flat[boot], dtype=np.float64).reshape(-1, self.columns)

    def table(self, boot: int, values: slice = slice(None)) -> Array:
        """(row, 1 + values) of one boot, all values or some: finite rows in the order of time, of equal times the first."""
        if boot not in self._flat:
            return np.empty((0, 1))
        rows = self._rows(boot)
        table = np.concatenate([rows[:, :1], rows[:, 1:][:, values]], axis=1)
        table = table[np.isfinite(table).all(axis=1)]
        _, first = np.unique(table[:, 0], return_index=True)
        chosen: Array = table[first]
        return chosen


def between(t_s: Array, table: Array, gap_s: float) -> Array:
    """The table's columns at times t_s, (time, values); NaN where its samples around are further apart than gap_s."""
    if len(table) < 2:
        return np.full((len(t_s), max(1, table.shape[1] - 1)), np.nan)
    times = table[:, 0]
    right = np.clip(np.searchsorted(times, t_s), 1, len(times) - 1)
    outside = (t_s < times[0]) | (t_s > times[-1]) | (times[right] - times[right - 1] > gap_s)
    out = np.stack([np.interp(t_s, times, table[:, c]) for c in range(1, table.shape[1])], axis=1)
    out[outside] = np.nan
    return out


def slope(table: Array, gap_s: float) -> Array:
    """(row, 1 + values): the columns' rates of change at the middle between samples no further apart than gap_s."""
    if len(table) < 2:
        return np.empty((0, table.shape[1]))
    step_s = np.diff(table[:, 0])
    rates = np.diff(table[:, 1:], axis=0) / step_s[:, None]
    middle = 0.5 * (table[1:, :1] + table[:-1, :1])
    return np.concatenate([middle, rates], axis=1)[step_s <= gap_s]


def body_to_ned(roll_rad: Array, pitch_rad: Array, yaw_rad: Array) -> Array:
    """Rotation matrices (time, 3, 3) that take body FRD into NED.  Source: MIL-F-8785C's Euler angles, yaw-pitch-roll."""
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    rows = [
        [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy],
        [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy],
        [-sp, sr * cp, cr * cp],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def unwrapped(table: Array, column: int) -> Array:
    """A copy in which an angle's column does not jump at +-pi, so that it can be interpolated."""
    out = table.copy()
    if len(out):
        out[:, column] = np.unwrap(out[:, column])
    return out


def windowed(t_s: Array, values: Array, width_s: float, least: int = 8) -> list[Mean]:
    """Means of (time, columns) over windows of width_s."""
    means = Means(width_s, least)
    for time_s, row in zip(t_s.tolist(), values.tolist(), strict=True):
        means.take(time_s, tuple(row))
    return means.windows


def overlapping(t_s: Array, values: Array, width_s: float, hop_s: float, least: int = 8) -> list[Mean]:
    """Means of (time, columns) over windows of width_s that begin each hop_s; rows with a NaN are left out."""
    usable = np.isfinite(values).all(axis=1)
    t_s, values = t_s[usable], values[usable]
    out: list[Mean] = []
    for end_s, rows in sliding(t_s, width_s, hop_s):
        inside = values[rows]
        if len(inside) >= least:
            error = inside.std(axis=0) / math.sqrt(len(inside))
            out.append(Mean(end_s - width_s, end_s, tuple(inside.mean(axis=0).tolist()), tuple(error.tolist())))
    return out


def sliding(t_s: Array, width_s: float, hop_s: float) -> Iterator[tuple[float, slice]]:
    """(end of window, its rows) for windows that overlap.  t_s: (time,), growing."""
    if not len(t_s):
        return
    for k in range(max(0, math.floor((t_s[-1] - t_s[0] - width_s) / hop_s) + 1)):
        start_s = t_s[0] + k * hop_s
        first, last = np.searchsorted(t_s, [start_s, start_s + width_s])
        yield float(start_s + width_s), slice(int(first), int(last))
