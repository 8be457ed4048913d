"""Moving averages over a fixed number of samples, many rows at once."""

import numpy as np
from numpy.typing import NDArray


class MovingAverage:
    """Mean of the last `samples` values of each row; places not yet filled count as zero.

    The sum never subtracts, so it cannot drift: a turn of the ring is kept as sums from each place to the end of the
    turn, and the new turn is added up beside it (the two stacks of van Herk and of Gil and Werman).  A missing value
    (NaN) holds its row.  Every row is worked alone, so a row in company has the bits of a row alone.
    """

    def __init__(self, rows: int, samples: int) -> None:
        if rows < 1 or samples < 1:
            raise ValueError(f"a moving average needs at least one row and one sample, not {rows} and {samples}")
        self.samples = samples
        # Places before the cursor: values of this turn.  From it on: sums of the turn before, to its end, then a zero.
        self.ring = np.zeros((rows, samples + 1))
        self.turn_sum = np.zeros(rows)
        self.cursor = np.zeros(rows, dtype=np.int64)
        self._flat = self.ring.reshape(-1)
        self._row_start = np.arange(rows) * (samples + 1)

    def push(self, values: NDArray[np.float64]) -> None:
        """Take one value for each row, (row,); NaN: that row keeps its mean.  Raises ValueError on another shape."""
        if values.shape != self.turn_sum.shape:
            raise ValueError(f"values have shape {values.shape}, the moving average has {self.turn_sum.shape}")
        missing = np.isnan(values)
        if missing.any():
            rows = np.flatnonzero(~missing)
            self._flat[self._row_start[rows] + self.cursor[rows]] = values[rows]
            self.turn_sum[rows] += values[rows]
            self.cursor[rows] += 1
        else:
            self._flat[self._row_start + self.cursor] = values
            self.turn_sum += values
            self.cursor += 1
        turned = self.cursor == self.samples
        if turned.any():
            rows = np.flatnonzero(turned)
            turn = self.ring[rows, : self.samples]
            self.ring[rows, : self.samples] = np.cumsum(turn[:, ::-1], axis=1)[:, ::-1]
            self.turn_sum[rows] = 0.0
            self.cursor[rows] = 0

    def mean(self) -> NDArray[np.float64]:
        """Mean over the full length, (row,), in the values' unit."""
        mean: NDArray[np.float64] = (self._flat[self._row_start + self.cursor] + self.turn_sum) / self.samples
        return mean

    def empty(self, rows: NDArray[np.int64]) -> None:
        """Forget everything in the rows named."""
        self.ring[rows] = 0.0
        self.turn_sum[rows] = 0.0
        self.cursor[rows] = 0
