"""One row a flight: what the verdicts on it, what was injected and the truth at its end leave in the table."""

import contextlib
import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from companion.airframe import Detector
from fdi.verdict import Phase, Verdict
from sitl.ensemble import HEALTHY
from sitl.vehicle import Injected

DETECTION_S: Final = 60.0  # after the onset, over which `peak_60_*` looks
MISS: Final = "miss_m"
NUMBERS: Final = ("first_alarm_s", "detected_s", "isolated_s", "confidence", "size")

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Column = NDArray[np.float64] | NDArray[np.int64] | NDArray[np.bool_] | list[str | None]
Columns = dict[str, Column]  # a table: name -> (flight,), NaN or None where it did not happen


def injected(fleet: object, faults: Sequence[Injected | None]) -> Columns:
    """The columns that say what was injected: with everything drawn, if the fleet tells, else as it was asked for."""
    told = getattr(fleet, "injected", None)
    whole = [fault if fault is None or told is None else told(f)[0] for f, fault in enumerate(faults)]
    return {
        "fault_id": [HEALTHY if fault is None else fault.id for fault in whole],
        "onset_s": np.array([math.nan if fault is None else fault.onset_s for fault in whole]),
        "value": np.array([math.nan if fault is None or fault.value is None else fault.value for fault in whole]),
    }


def truth_names(fleet: object) -> tuple[str, ...]:
    """What a fleet, or its class, offers as truth beside the miss distance: its `truths`, names for its `truth`."""
    return tuple(getattr(fleet, "truths", ()))


def truths(fleet: object, down: BoolArray) -> Columns:
    """What no sensor says, at the end: `miss_m` of flights that are down, and `end_NAME` of all."""
    truth = getattr(fleet, "truth", None)
    miss_m = np.full(down.size, math.nan)
    if truth is not None:
        with contextlib.suppress(KeyError):  # an airframe without a target
            miss_m = np.where(down, truth(MISS), math.nan)
    columns: Columns = {MISS: miss_m}
    if truth is not None:
        columns |= {f"end_{name}": truth(name) for name in truth_names(fleet) if name != MISS}
    return columns


class Score:
    """Follows the verdicts on a batch of flights and keeps what a row of the table needs.

    Every time is in s since release; an alarm is a verdict `detected`, `isolated` or `inconclusive`.  What stands at the
    onset of the fault counts from the onset: whoever reads can leave those flights out by `false_alarm`.
    """

    def __init__(self, detector: Detector, onset_s: FloatArray) -> None:
        """onset_s: (flight,), infinite in healthy flights."""
        n = onset_s.size
        self._detector = detector
        self._onset_s = onset_s
        self._healthy = np.isinf(onset_s)
        self._numbers = {name: np.full(n, math.nan) for name in NUMBERS}
        self._named: list[str | None] = [None] * n
        self._false_alarm = np.zeros(n, dtype=np.bool_)
        self._phase = np.full(n, int(Phase.WARMING), dtype=np.int64)
        shape = (n, len(detector.residuals))
        self._before, self._after = np.full(shape, math.nan), np.full(shape, math.nan)

    def note(self, t_us: int, flying: BoolArray, verdict: Verdict) -> None:
        """One row's verdict, at this time since release; flights that do not fly, (flight,), are passed over."""
        if not flying.any():
            return
        t_s = t_us / 1e6
        begun = t_s >= self._onset_s
        np.copyto(self._phase, verdict.phase, where=flying)
        before, after = flying & ~begun, flying & begun & (t_s <= self._onset_s + DETECTION_S)
        np.fmax(self._before, verdict.residuals, out=self._before, where=before[:, None])
        if after.any():
            np.fmax(self._after, verdict.residuals, out=self._after, where=after[:, None])
        loud = flying & (verdict.phase >= Phase.DETECTED)
        if loud.any():
            self._alarm(t_s, loud, begun, verdict)

    def _alarm(self, t_s: float, loud: BoolArray, begun: BoolArray, verdict: Verdict) -> None:
        numbers = self._numbers
        self._false_alarm |= loud & ~begun
        for name, now in (("first_alarm_s", loud), ("detected_s", loud & begun)):
            numbers[name][now & np.isnan(numbers[name])] = t_s
        named = loud & (begun | self._healthy) & (verdict.phase == Phase.ISOLATED) & np.isnan(numbers["isolated_s"])
        for f in np.flatnonzero(named):
            numbers["isolated_s"][f] = t_s
            numbers["confidence"][f] = verdict.confidence[f]
            numbers["size"][f] = verdict.size[f]
            self._named[f] = self._detector.faults[int(verdict.fault[f])].id

    def columns(self) -> Columns:
        """What was kept, by the names of the flight row."""
        numbers = self._numbers
        columns: Columns = {name: numbers[name] for name in ("first_alarm_s", "detected_s", "isolated_s")}
        columns |= {"named_id": self._named, "confidence": numbers["confidence"], "size": numbers["size"]}
        columns |= {
            "false_alarm": self._false_alarm,
            "phase_at_end": [Phase(int(phase)).name.lower() for phase in self._phase],
            "recovery": [None] * len(self._named),  # a batch flies without a companion that would mend anything
        }
        peaks: Columns = {}
        for r, name in enumerate(self._detector.residuals):
            peaks |= {f"peak_{name}": self._before[:, r], f"peak_60_{name}": self._after[:, r]}
        return columns | peaks


def column_names(detector: Detector, fleet: object) -> tuple[str, ...]:
    """The names of a row's columns, in their order.  fleet: one, or its class."""
    return (
        *("seed", "flight_s", "fault_id", "onset_s", "value", "first_alarm_s", "detected_s", "isolated_s"),
        *("named_id", "confidence", "size", "false_alarm", "phase_at_end", "recovery", MISS),
        *(f"{peak}_{name}" for name in detector.residuals for peak in ("peak", "peak_60")),
        *(f"end_{name}" for name in truth_names(fleet) if name != MISS),
    )


def table(columns: Columns) -> Any:
    """A pyarrow table of them; NaN becomes null."""
    import pyarrow

    arrays = {}
    for name, column in columns.items():
        kind = pyarrow.string() if isinstance(column, list) else pyarrow.from_numpy_dtype(column.dtype)
        arrays[name] = pyarrow.array(column, type=kind, from_pandas=True)
    return pyarrow.table(arrays)
