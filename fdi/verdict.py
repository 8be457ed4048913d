"""What every monitor says of its vehicles, and the tables by which its numbers are read.

A monitor (`fdi/<airframe>.py`) is batch first: all arrays here have a leading axis of flights, a live vehicle is a batch
of one.  Records only; no monitor shares code through this module.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

NO_FAULT = -1  # value of `Verdict.fault` while none is named


class Phase(IntEnum):
    """How far the judgement has come; the order is the order in which a fault passes through it."""

    WARMING = 0  # not judging: not armed, just started, or its outputs in an unknown order
    HEALTHY = 1
    DETECTED = 2  # something is wrong, not yet what
    ISOLATED = 3  # `Verdict.fault` says what
    INCONCLUSIVE = 4  # something is wrong and every hypothesis was ruled out


@dataclass(frozen=True, slots=True)
class Fault:
    """One row of an airframe's fault table."""

    id: str  # CLASS[:PLACE], unique in the airframe: "motor:left", "crossed_lines"
    fault_class: str
    where: str | None  # side or axis
    text: str  # for the operator; with the confidence behind it, it fits the 50 bytes of STATUSTEXT
    size_unit: str | None = None  # unit of `Verdict.size`, None where the fault has no size


@dataclass(frozen=True, slots=True)
class Signature:
    """Which residuals a fault trips: "+" trips, "0" stays quiet, "." says nothing; one mark for each residual's name."""

    fault_id: str
    marks: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Verdict:
    """One step's judgement of every flight of the batch."""

    phase: NDArray[np.int64]  # (flight,), values of `Phase`
    fault: NDArray[np.int64]  # (flight,), index into the airframe's FAULTS, or NO_FAULT
    confidence: NDArray[np.float64]  # (flight,), 0..1; what the number means is written at the airframe's monitor
    size: NDArray[np.float64]  # (flight,), in the fault's size_unit; NaN where unknown
    onset_s: NDArray[np.float64]  # (flight,), how long ago the fault is thought to have begun; NaN where unknown
    residuals: NDArray[np.float64]  # (flight, residual), smoothed, as compared with the thresholds; NaN where unknown
    thresholds: NDArray[np.float64]  # (residual,)
    signals: NDArray[np.float64]  # (flight, signal), what people and the verification of recoveries look at


class Monitor(Protocol):
    """What `fdi/<airframe>.py` offers under the name `Monitor`: built as `Monitor(config, flights=n, compiler=None)`.

    compiler: makes machine code of kernels (fdi/kernel.py); a monitor that has none takes no notice of it.
    """

    @property
    def state(self) -> dict[str, NDArray[np.float64]]:
        """Everything the next step depends on, (flight, ...) arrays: comparable; assigned back, it resumes there."""

    @state.setter
    def state(self, state: Mapping[str, NDArray[np.float64]]) -> None: ...

    def step(self, values: NDArray[np.float64], age_s: NDArray[np.float64]) -> Verdict:
        """Judge one row of the grid.

        values, age_s: (flight, channel) in the order of the airframe's CHANNELS; NaN where unknown; age is that of the
        sample when the row stands.  Raises ValueError on a wrong shape, on nothing else.
        """

    def told(self, flight: int, parameters: Mapping[str, float]) -> None:
        """Take note of the vehicle's parameters (the airframe's PARAMETERS), as the vehicle itself reports them."""
