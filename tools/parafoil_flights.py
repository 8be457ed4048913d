"""The flights behind the parafoil's tables: flown through `companion.campaign`, and read as the parafoil paper counts.

A row of `mavfdi montecarlo` says when the live monitor alarmed and what it named.  The paper counts otherwise: a fault is
judged afresh from its onset, whatever stood before; it has 60 s to be detected and 90 s to be named, and what is only
detected by then is named by size.  So the paper's monitor is watched besides, and its rows have more columns.
"""

import contextlib
import math
import multiprocessing
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import fdi.parafoil as detector
from companion import campaign
from companion.airframe import Airframe
from companion.campaign.rows import Columns, injected
from companion.cli.montecarlo import Progress, check_faults
from companion.compiler import compiler
from fdi.verdict import Phase

FLIGHT_S = 600.0
DETECTION_S = 60.0  # paper, 4.2
ISOLATION_S = 90.0  # paper, 5.2
MOTOR_PHASE_S = 5.0  # paper, 5.1
CLASS_STRIDE = 10_000_000  # between the first seeds of two kinds of flights
TOLERANCE_S = 1e-6
WAYS = ("motor", "elimination", "size")  # by which the paper's monitor names a fault
LINES = ("broken_left", "broken_right", "crossed")  # residuals of the line faults
FIRST_LINE = next(index for index, fault in enumerate(detector.FAULTS) if fault.fault_class != "motor")

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
TextArray = NDArray[np.object_]  # of str, None where there is none


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of flights, by what `--faults` of `mavfdi montecarlo` calls its fault."""

    name: str
    choice: str


HEALTHY = Kind("healthy", "none")
FAULTY = (
    Kind("stuck", "motor/stuck"),
    Kind("saturation", "motor/saturation"),
    Kind("broken", "broken_line"),
    Kind("crossed", "crossed_lines"),
)
KINDS = (HEALTHY, *FAULTY)


class Watch:
    """Follows the paper's monitor over one batch, and keeps what its rows do not tell."""

    def __init__(self, monitor: detector.Parafoil, onset_s: FloatArray) -> None:
        """onset_s: (flight,), infinite in healthy flights."""
        n = onset_s.size
        self.monitor, self.onset_s = monitor, onset_s
        limits = monitor.config.paper.thresholds
        self.line_thresholds = np.array([limits.broken_rad2_s2, limits.broken_rad2_s2, limits.crossed_rad2_s2])
        self.flying, self.begun, self.closed = (np.zeros(n, dtype=np.bool_) for _ in range(3))
        self.phase = np.full(n, int(Phase.WARMING), dtype=np.int64)
        self.detected_s, self.inconclusive_s, self.limit_s = (np.full(n, math.nan) for _ in range(3))
        self.limit_id: list[str | None] = [None] * n
        self.motors = np.full((2, n), math.nan)
        self.lines = np.full((3, n), math.nan)
        self.ids: tuple[list[str | None], list[str | None]] = [None] * n, [None] * n  # named before and since the onset
        self.ways: tuple[list[str | None], list[str | None]] = [None] * n, [None] * n

    def begin(self, t_s: float, flying: BoolArray) -> None:
        """Before the monitor's step: touchdown ends a flight, and from its onset on a fault is judged afresh."""
        down = np.flatnonzero(self.flying & ~flying)
        if down.size:
            self._end(down, t_s)
        self.flying = flying.copy()
        fresh = flying & (t_s >= self.onset_s) & ~self.begun
        if fresh.any():
            self.begun |= fresh
            standing = np.flatnonzero(fresh & (self.monitor.isolation.phase != Phase.HEALTHY))
            if standing.size:
                self.monitor.isolation.clear(standing)
                self.phase[standing] = Phase.HEALTHY

    def note(self, t_s: float, residuals: FloatArray) -> None:
        """After the monitor's step; residuals: (flight, residual)."""
        since_s = t_s - self.onset_s
        judged = self.flying & self.begun
        phase = self.monitor.isolation.phase
        named = self.flying & (phase == Phase.ISOLATED) & (self.phase != Phase.ISOLATED)
        for f in np.flatnonzero(named):
            self._note_naming(int(f))
        self.phase = phase.copy()
        if not judged.any():
            return
        for times_s, state in ((self.detected_s, Phase.DETECTED), (self.inconclusive_s, Phase.INCONCLUSIVE)):
            times_s[judged & (phase >= state) & np.isnan(times_s)] = t_s
        in_phase = judged & (t_s - self.detected_s <= MOTOR_PHASE_S + TOLERANCE_S)
        np.fmax(self.motors, residuals[:, 1:3].T, out=self.motors, where=in_phase)
        np.fmax(self.lines, residuals[:, 3:].T, out=self.lines, where=judged & (since_s <= ISOLATION_S + TOLERANCE_S))
        late = judged & ~self.closed & (since_s >= ISOLATION_S - TOLERANCE_S)
        if late.any():
            self._end(np.flatnonzero(late), t_s)

    def _note_naming(self, f: int) -> None:
        """The monitor's first naming before the onset, or in a healthy flight, and the first one since."""
        epoch = int(self.begun[f])
        if self.ids[epoch][f] is not None:
            return
        isolation = self.monitor.isolation
        fault = int(isolation.fault[f])
        eliminated = int(np.count_nonzero(isolation.maxima[:, f] > self.line_thresholds))
        self.ids[epoch][f] = detector.FAULTS[fault].id
        self.ways[epoch][f] = WAYS[0 if fault < FIRST_LINE else 1 if eliminated == 2 else 2]

    def _end(self, flights: IntArray, t_s: float) -> None:
        """The time is up, or the flight is over: what is only detected is named by size."""
        isolation = self.monitor.isolation
        smallest = detector.smallest_left(isolation.maxima[:, flights], self.line_thresholds)
        for f, line in zip(flights, smallest, strict=True):
            if self.begun[f] and not self.closed[f] and isolation.phase[f] == Phase.DETECTED:
                self.limit_id[f] = detector.FAULTS[FIRST_LINE + int(line)].id
                self.limit_s[f] = t_s
        self.closed[flights] = True

    def columns(self) -> Columns:
        """Beside those of the flight row; times in s since release, None and NaN where it did not happen."""
        columns: Columns = {
            "inconclusive_s": self.inconclusive_s,  # the first such verdict since the onset
            "limit_s": self.limit_s,  # when a fault that was only detected was named by size
            "limit_id": self.limit_id,
            "before_id": self.ids[0],  # the first name before the onset, or in a healthy flight
            "before_way": self.ways[0],
            "since_id": self.ids[1],  # the first name since
            "since_way": self.ways[1],
        }
        columns |= {f"peak_named_motor_{1 + o}": self.motors[o] for o in range(2)}  # in the 5 s from detection
        return columns | {f"peak_90_{name}": self.lines[i] for i, name in enumerate(LINES)}  # in the 90 s from the onset


def fly(batch: campaign.Batch) -> Columns:
    """The rows of a batch, in the order of its seeds; with the columns of `Watch` where the paper's monitor judges."""
    prepared = campaign.prepare(batch)
    onset_s = np.array([math.inf if fault is None else fault.onset_s for fault in prepared.faults])
    monitor = batch.airframe.monitor(flights=batch.flights, compiler=compiler())
    watch = Watch(monitor, onset_s) if isinstance(monitor, detector.Parafoil) else None
    for row in prepared.ensemble.rows(batch.duration_s):
        t_s = row.t_us / 1e6
        if watch is not None:
            watch.begin(t_s, row.flying)
        verdict = monitor.step(row.values, row.age_s)
        prepared.score.note(row.t_us, row.flying, verdict)
        if watch is not None:
            watch.note(t_s, verdict.residuals)
    touchdown_us = prepared.ensemble.touchdown_us
    columns: Columns = {
        "seed": np.array(batch.seeds, dtype=np.int64),
        "flight_s": np.where(touchdown_us >= 0, touchdown_us / 1e6, batch.duration_s),
    }
    columns |= injected(prepared.fleet, prepared.faults) | prepared.score.columns()
    return columns if watch is None else columns | watch.columns()


def flown(work: Sequence[campaign.Batch], jobs: int) -> Iterator[Columns]:
    """The rows of each batch, from so many processes."""
    if min(jobs, len(work)) <= 1:
        yield from map(fly, work)
        return
    with ProcessPoolExecutor(min(jobs, len(work)), multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(fly, work)


@dataclass(frozen=True, slots=True)
class Campaign:
    """Where flights are kept, and how they are flown."""

    folder: Path
    jobs: int
    link: bool  # behind a line that rounds, loses and delays
    duration_s: float = FLIGHT_S

    def gather(self, airframe: Airframe, kind: Kind, first_seed: int, flights: int) -> "Flights":
        """The flights of a kind; what is missing is flown.  Raises UserError if they cannot be kept."""
        first = first_seed + KINDS.index(kind) * CLASS_STRIDE
        wanted = campaign.settings(airframe, first, flights, (kind.choice,), self.duration_s, link=self.link)
        name = f"{wanted.detector}-{kind.name}-{first}-{flights}{'-link' if self.link else ''}"
        store = campaign.Store(self.folder / "flights" / wanted.config_sha256[:8] / name, wanted)
        with contextlib.closing(store):
            missing = store.missing
            if missing:
                check_faults(airframe, wanted)
            progress = Progress(flights, flights - sum(len(run) for run in missing))
            for columns in flown(campaign.batches(airframe, wanted, missing, self.jobs), self.jobs):
                store.keep(columns)
                progress.flown += len(columns["seed"])
                progress.show()
            progress.clear()
            return read(store.join())


@dataclass(frozen=True, slots=True)
class Flights:
    """Flights of one kind, or several, in which the fault did happen before touchdown."""

    columns: Mapping[str, NDArray[np.generic]]  # (flight,) each, by name

    @property
    def count(self) -> int:
        return int(self.columns["seed"].size)

    def numbers(self, name: str) -> FloatArray:
        return self.columns[name].astype(np.float64)

    def texts(self, name: str) -> TextArray:
        return self.columns[name].astype(np.object_)

    @property
    def truth(self) -> TextArray:
        """CLASS[:PLACE] of the fault, "none" in healthy flights."""
        return np.array([str(fault_id).partition("/")[0] for fault_id in self.texts("fault_id")], dtype=np.object_)

    @property
    def early(self) -> BoolArray:
        """An alarm before the onset; healthy: any."""
        return self.columns["false_alarm"].astype(np.bool_)

    def where(self, chosen: BoolArray) -> "Flights":
        return Flights({name: column[chosen] for name, column in self.columns.items()})

    def of_faulty_motor(self, prefix: str) -> FloatArray:
        """The column PREFIX_motor_N of the motor that has the fault; without one, the larger of both."""
        one, other = self.numbers(f"{prefix}_motor_1"), self.numbers(f"{prefix}_motor_2")
        truth = self.truth
        return np.where(truth == "motor:left", one, np.where(truth == "motor:right", other, np.fmax(one, other)))


def read(path: Path) -> Flights:
    """Rows as kept."""
    from pyarrow import parquet

    table = parquet.read_table(path)
    columns = {name: table.column(name).to_numpy() for name in table.column_names}
    onset_s = columns["onset_s"].astype(np.float64)
    return Flights(columns).where(~(onset_s > columns["flight_s"].astype(np.float64)))


def together(parts: Sequence[Flights]) -> Flights:
    """Flights of several kinds in a row."""
    return Flights({name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns})


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of flights with a fault; all (flight,), times in s after the onset, NaN where it did not happen."""

    detected_s: FloatArray  # within 60 s
    isolated_s: FloatArray  # within 90 s, rightly or wrongly, of what was detected
    right: BoolArray
    wrong: BoolArray
    inconclusive: BoolArray  # detected, but in 90 s not named

    @property
    def detected(self) -> BoolArray:
        return np.isfinite(self.detected_s)


def outcome(flights: Flights, by_papers_rule: bool) -> Outcome:
    """Judge flights with a fault by the paper's rules, or by ours.

    The paper lets an alarm that stands at the onset count as detected, and names by size what is only detected after 90 s.
    Ours counts a flight with an alarm before the onset as missed, and what is not named by then as inconclusive.
    """
    onset_s = flights.numbers("onset_s")
    detected_s = flights.numbers("detected_s") - onset_s
    detected_s[~(detected_s <= DETECTION_S + TOLERANCE_S)] = math.nan
    isolated_s, named = flights.numbers("isolated_s") - onset_s, flights.texts("named_id")
    in_time = isolated_s <= ISOLATION_S + TOLERANCE_S
    if by_papers_rule:
        ruled_out_s = flights.numbers("inconclusive_s") - onset_s
        ended = (ruled_out_s <= ISOLATION_S + TOLERANCE_S) & ~(isolated_s < ruled_out_s)
        by_size = ~in_time & ~ended & (flights.texts("limit_id") != None)  # noqa: E711  # elementwise
        isolated_s = np.where(by_size, flights.numbers("limit_s") - onset_s, isolated_s)
        named = np.where(by_size, flights.texts("limit_id"), named)
        in_time = (in_time & ~ended) | by_size
    else:
        detected_s[flights.early] = math.nan
    in_time &= np.isfinite(detected_s)
    right = in_time & (named == flights.truth)
    return Outcome(
        detected_s,
        np.where(in_time, isolated_s, math.nan),
        right,
        in_time & ~right,
        np.isfinite(detected_s) & ~in_time,
    )


@dataclass(frozen=True, slots=True)
class Named:
    """How often a way of naming a class was right in the live monitor."""

    way: str
    fault_class: str
    right: int
    count: int


def namings(flights: Flights) -> list[Named]:
    """First namings by the paper's live monitor, before and since the onset: what stands as confidence in its verdicts.

    flights: of all kinds, as many each.  What it names in a healthy flight, or before the onset, is wrong.
    """
    classes = {fault.id: fault.fault_class for fault in detector.FAULTS}
    truth = flights.truth
    counts: dict[tuple[str, str], list[int]] = {
        (way, name): [0, 0]
        for way in WAYS
        for name in dict.fromkeys(classes.values())
        if (way == "motor") == (name == "motor")
    }
    for epoch in ("before", "since"):
        ids, ways = flights.texts(f"{epoch}_id"), flights.texts(f"{epoch}_way")
        for f in np.flatnonzero(ids != None):  # noqa: E711  # elementwise
            count = counts[ways[f], classes[ids[f]]]
            count[0] += int(epoch == "since" and ids[f] == truth[f])
            count[1] += 1
    return [Named(way, name, right, count) for (way, name), (right, count) in counts.items()]
