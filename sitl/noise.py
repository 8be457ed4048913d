"""Random numbers for a batch of flights, each flight from its own seed.

A flight alone and the same flight among thousands see the same numbers to the bit, whatever company they are in and in
whatever order: nothing is ever drawn for the batch as a whole.
"""

from collections.abc import Sequence

import numpy as np
from numpy.random import PCG64, Generator
from numpy.typing import NDArray

BLOCK_STEPS = 100  # a refill costs one Python call a flight; 100 steps of 18 numbers are 14 kB a flight


def generators(seeds: Sequence[int]) -> tuple[Generator, ...]:
    """One generator for each seed (a whole number >= 0).  Raises ValueError for a negative seed."""
    return tuple(Generator(PCG64(seed)) for seed in seeds)


class StandardNormals:
    """Standard normal numbers, `width` for each flight and step, drawn in blocks.

    `values` is (flight, BLOCK_STEPS, width), float64; `next_row()` says which row belongs to the step about to be made.
    """

    def __init__(self, sources: Sequence[Generator], width: int) -> None:
        self._sources = tuple(sources)
        self._row = BLOCK_STEPS - 1
        self.values: NDArray[np.float64] = np.empty((len(self._sources), BLOCK_STEPS, width))

    def next_row(self) -> int:
        """Index of this step's row in `values`; draws the next block of every flight when the old one is used up."""
        self._row += 1
        if self._row == BLOCK_STEPS:
            self._row = 0
            for source, block in zip(self._sources, self.values, strict=True):
                source.standard_normal(out=block)
        return self._row
