"""Judge the parafoil monitor on thousands of simulated flights, beside the figures of the parafoil paper.

Flies --flights healthy flights and as many of each class of fault (stuck motor, saturated motor, broken line, crossed
lines; sides in turn; onset a whole second in 0..500 s), 600 s each, plant and monitor in one process, and prints false
alarms, detection within 60 s, isolation within 90 s, and latencies, with Wilson 95 % intervals.  As in the paper, a fault
counts as detected when the smoothed residual is above its threshold at any sample of the 60 s after the onset, and what
is not isolated 90 s after the onset is named by size.  It also prints what the configuration keeps as design record.

    python tools/montecarlo_parafoil.py --flights 1000 --seed 1000000

Design seeds are below 100 000 000; judging seeds, from 900 000 000 on, are for one look after all choices are made.
"""

import argparse
import math
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

import fdi.parafoil as detector
import sitl.parafoil as simulator
from fdi.verdict import NO_FAULT, Phase
from intervals import share
from sitl.vehicle import Injected
from sitl.wire import quantiser

CONFIG = Path(__file__).parent.parent / "configs" / "parafoil.toml"
PERIOD_S = 0.1
FLIGHT_S = 600.0
LAST_ONSET_S = 500
DETECTION_S = 60.0  # paper, 4.2
ISOLATION_S = 90.0  # paper, 5.2
CLASS_STRIDE = 10_000_000  # between the seeds of two classes
BATCH = 500
WAYS = ("motor", "elimination", "size")

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Kind:
    """One class of flights, the ids it is injected by, and what the paper reports of it (NaN: nothing)."""

    name: str
    ids: tuple[str, ...]  # injected in turn
    paper_detected: float = math.nan
    paper_isolated: float = math.nan


KINDS = (
    Kind("healthy", ()),
    Kind("stuck", ("motor:left/stuck", "motor:right/stuck")),
    Kind("saturation", ("motor:left/saturation", "motor:right/saturation")),
    Kind("broken", ("broken_line:left", "broken_line:right"), 0.989, 0.990),
    Kind("crossed", ("crossed_lines",), 0.997, 0.953),
)
MOTORS = Kind("motor", (), 0.732, 0.969)  # both kinds of motor fault in one, as the paper has them


@dataclass(frozen=True, slots=True)
class Naming:
    """One naming of a fault by the live monitor."""

    way: int  # index into WAYS
    named: int  # index into FAULTS
    right: bool


@dataclass(frozen=True, slots=True)
class Outcomes:
    """What became of the flights of one kind; all (flight,), times in s after the onset, NaN where it did not happen."""

    maximum: FloatArray  # of the smoothed heading-rate residual: healthy, of the flight; else of the 60 s after the onset
    motor_maximum: FloatArray  # likewise of the larger, or the faulty, motor's residual
    early_alarm: NDArray[np.bool_]  # an alarm before the onset; healthy: any
    detected_s: FloatArray
    isolated_s: FloatArray
    named: IntArray  # within 90 s: index into FAULTS, NO_FAULT
    inconclusive: NDArray[np.bool_]
    right: NDArray[np.bool_]
    namings: tuple[Naming, ...]


def quantiles(values: FloatArray) -> str:
    known = values[np.isfinite(values)]
    return "   -/-  " if known.size == 0 else f"{np.median(known):5.1f}/{np.quantile(known, 0.9):5.1f}"


def rows(fleet: simulator.Fleet, quantised: bool) -> Iterator[tuple[float, FloatArray, FloatArray]]:
    """(time since release, values, age_s) as the monitor takes them, first a row before release; ends after 600 s."""
    columns = [fleet.channels.index(name) for name in detector.CHANNELS if name != "armed"]
    as_on_the_wire = quantiser(simulator.VEHICLE.streams, fleet.channels)
    for k in range(round(FLIGHT_S / PERIOD_S) + 1):
        sensed, sensed_age_s = fleet.step(PERIOD_S) if k else fleet.observe()
        if quantised:
            sensed = as_on_the_wire(sensed)
        values = np.empty((sensed.shape[0], len(detector.CHANNELS)))
        age_s = np.zeros_like(values)
        values[:, 0] = ~fleet.landed if k else 0.0  # it disarms on touchdown
        values[:, 1:] = sensed[:, columns]
        age_s[:, 1:] = sensed_age_s[:, columns]
        yield k * PERIOD_S, values, age_s


class Scorer:
    """Follows one batch of flights and keeps what the tables need."""

    def __init__(self, monitor: detector.Parafoil, onset_s: FloatArray, truth: IntArray) -> None:
        """onset_s, truth: (flight,), inf and NO_FAULT in healthy flights."""
        n = onset_s.size
        self.monitor, self.onset_s, self.truth = monitor, onset_s, truth
        limits = monitor.config.paper.thresholds
        self.line_thresholds = np.array([limits.broken_rad2_s2, limits.broken_rad2_s2, limits.crossed_rad2_s2])
        self.healthy = truth == NO_FAULT
        self.maximum, self.motor_maximum = np.zeros(n), np.zeros(n)
        self.early_alarm = np.zeros(n, dtype=np.bool_)
        self.detected_s, self.isolated_s = np.full(n, math.nan), np.full(n, math.nan)
        self.named = np.full(n, NO_FAULT, dtype=np.int64)
        self.inconclusive = np.zeros(n, dtype=np.bool_)
        self.closed = np.zeros(n, dtype=np.bool_)  # isolation has ended
        self.flying = np.ones(n, dtype=np.bool_)
        self.restarted = np.zeros(n, dtype=np.bool_)
        self.phase = np.full(n, int(Phase.WARMING), dtype=np.int64)
        self.live_named = np.zeros((2, n), dtype=np.bool_)  # before and since the onset
        self.namings: list[Naming] = []

    def begin(self, time_s: float, armed: NDArray[np.bool_]) -> None:
        """Before the monitor's step: touchdown ends a flight, and at its onset a fault is judged afresh."""
        down = np.flatnonzero(self.flying & ~armed)
        if down.size:
            self.end(down, time_s)
            self.flying[down] = False
        fresh = (time_s > self.onset_s) & ~self.restarted & self.flying
        if fresh.any():
            self.restarted |= fresh
            flights = np.flatnonzero(fresh & (self.monitor.isolation.phase != Phase.HEALTHY))
            if flights.size:
                self.monitor.isolation.clear(flights)
                self.phase[flights] = Phase.HEALTHY

    def end(self, flights: IntArray, time_s: float) -> None:
        """Isolation ends, by its limit or by touchdown: what is only detected is named by size."""
        detected = np.isfinite(self.detected_s[flights]) & (self.monitor.isolation.phase[flights] == Phase.DETECTED)
        open_ = flights[detected & ~self.closed[flights]]
        if open_.size:
            self.named[open_] = 2 + detector.smallest_left(self.monitor.isolation.maxima[:, open_], self.line_thresholds)
            self.isolated_s[open_] = time_s - self.onset_s[open_]
        self.closed[flights] = True

    def score(self, time_s: float, residuals: FloatArray, thresholds: FloatArray) -> None:
        """After the monitor's step."""
        since_s = time_s - self.onset_s
        turn, motors = residuals[:, 0], residuals[:, 1:3]
        above = turn > thresholds[0]
        in_time = self.healthy | ((since_s > 0.0) & (since_s <= DETECTION_S + 1e-6))
        np.fmax(self.maximum, turn, out=self.maximum, where=in_time)
        own = np.clip(self.truth, 0, 1)
        motor = np.where(self.healthy, np.fmax(motors[:, 0], motors[:, 1]), motors[np.arange(own.size), own])
        np.fmax(self.motor_maximum, motor, out=self.motor_maximum, where=in_time)
        self.early_alarm |= above & (self.healthy | (since_s <= 0.0))
        first = above & in_time & ~self.healthy & np.isnan(self.detected_s)
        self.detected_s[first] = since_s[first]
        phase = self.monitor.isolation.phase
        isolated = (phase == Phase.ISOLATED) & (self.phase != Phase.ISOLATED)
        if isolated.any():
            self._note_namings(np.flatnonzero(isolated), since_s)
        judged = ~self.closed & (since_s > 0.0) & np.isfinite(self.detected_s)
        done = judged & (phase == Phase.ISOLATED)
        self.named[done] = self.monitor.isolation.fault[done]
        none_left = judged & (phase == Phase.INCONCLUSIVE)
        self.inconclusive |= none_left
        self.closed |= done | none_left
        self.isolated_s[done] = since_s[done]
        late = np.flatnonzero(~self.closed & (since_s >= ISOLATION_S - 1e-6))
        if late.size:
            self.end(late, time_s)
        self.phase = phase.copy()

    def _note_namings(self, flights: IntArray, since_s: FloatArray) -> None:
        """The monitor's own namings, the first before and the first since the onset."""
        for f in flights:
            epoch = int(since_s[f] > 0.0)
            if self.live_named[epoch, f]:
                continue
            self.live_named[epoch, f] = True
            named = int(self.monitor.isolation.fault[f])
            eliminated = int(np.count_nonzero(self.monitor.isolation.maxima[:, f] > self.line_thresholds))
            way = 0 if named < 2 else 1 if eliminated == 2 else 2
            self.namings.append(Naming(way, named, epoch == 1 and named == int(self.truth[f])))


def fly(kind: Kind, seeds: IntArray, configuration: dict[str, object], quantised: bool) -> Outcomes:
    """Fly and judge one batch of a kind."""
    ids = [fault.id for fault in detector.FAULTS]
    faults: list[Injected | None] = [None] * seeds.size
    onset_s, truth = np.full(seeds.size, math.inf), np.full(seeds.size, NO_FAULT, dtype=np.int64)
    if kind.ids:
        for i, seed in enumerate(seeds):
            fault_id = kind.ids[int(seed) % len(kind.ids)]
            onset_s[i] = float(np.random.default_rng([int(seed), 1]).integers(0, LAST_ONSET_S + 1))
            faults[i] = Injected(fault_id, float(onset_s[i]))
            truth[i] = ids.index(fault_id.partition("/")[0])
    fleet = simulator.Fleet(msgspec.convert(configuration["sitl"], simulator.Config), [int(seed) for seed in seeds], faults)
    monitor = detector.Parafoil(msgspec.convert(configuration["monitor"], detector.Config), flights=seeds.size)
    scorer = Scorer(monitor, onset_s, truth)
    for time_s, values, age_s in rows(fleet, quantised):
        if time_s > 0.0:
            scorer.begin(time_s, values[:, 0] > 0.5)
        verdict = monitor.step(values, age_s)
        scorer.score(time_s, verdict.residuals, verdict.thresholds)
    judged = scorer.healthy | scorer.restarted  # a fault after touchdown is none
    return Outcomes(
        scorer.maximum[judged],
        scorer.motor_maximum[judged],
        scorer.early_alarm[judged],
        scorer.detected_s[judged],
        scorer.isolated_s[judged],
        scorer.named[judged],
        scorer.inconclusive[judged],
        (scorer.named == truth)[judged],
        tuple(scorer.namings),
    )


def gather(parts: list[Outcomes]) -> Outcomes:
    """Batches of one kind in a row."""

    def joined(name: str) -> NDArray[np.generic]:
        return np.concatenate([getattr(part, name) for part in parts])

    names = [name for name in Outcomes.__slots__ if name != "namings"]
    return Outcomes(*(joined(name) for name in names), tuple(naming for part in parts for naming in part.namings))


def best_threshold(healthy: FloatArray, faulty: FloatArray) -> tuple[float, float, float, float]:
    """Threshold of the largest figure of merit at equal weights (Eq. 15); -> it, P(FA), P(MD), FOM."""
    values = np.sort(np.concatenate((healthy, faulty)))
    false_alarms = 1.0 - np.searchsorted(np.sort(healthy), values, side="right") / healthy.size
    missed = np.searchsorted(np.sort(faulty), values, side="right") / faulty.size
    merit = 1.0 - 0.5 * (false_alarms + missed)
    at = int(np.argmax(merit))
    return float(values[at]), float(false_alarms[at]), float(missed[at]), float(merit[at])


def report(outcomes: dict[str, Outcomes], thresholds: tuple[float, float]) -> None:
    """Print all tables."""
    healthy = outcomes["healthy"]
    alarms = int(np.count_nonzero(healthy.early_alarm))
    print(f"heading-rate threshold {thresholds[0]} rad2/s2, motor threshold {thresholds[1]} m")
    print(f"P(FA) a flight {share(alarms, healthy.early_alarm.size)} (paper 0.038, judged 0.058)")
    print(f"{'fault':11}{'P(DET)':>23}{'paper':>7}{'P(ISO)':>23}{'paper':>7}{'P(INC)':>8}{'P(FI)':>8}", end="")
    print(f"{'early':>7}{'detected s':>13}{'isolated s':>13}")
    faulty = {name: each for name, each in outcomes.items() if name != "healthy"}
    for name, each in {**faulty, MOTORS.name: gather([faulty["stuck"], faulty["saturation"]])}.items():
        detected = np.isfinite(each.detected_s)
        n, m = detected.size, int(np.count_nonzero(detected))
        right = int(np.count_nonzero(detected & each.right))
        inconclusive = int(np.count_nonzero(detected & each.inconclusive))
        wrong = int(np.count_nonzero(detected & (each.named != NO_FAULT) & ~each.right))
        kind = next(kind for kind in (*KINDS, MOTORS) if kind.name == name)
        print(f"{name:11}{share(m, n):>23}{kind.paper_detected:7.3f}{share(right, m):>23}{kind.paper_isolated:7.3f}", end="")
        print(f"{inconclusive / max(m, 1):8.3f}{wrong / max(m, 1):8.3f}{np.mean(each.early_alarm):7.3f}", end="")
        print(f"{quantiles(each.detected_s):>13}{quantiles(np.where(detected, each.isolated_s, math.nan)):>13}")
    missed = sum(int(np.count_nonzero(np.isnan(each.detected_s))) for each in faulty.values())
    total = sum(each.detected_s.size for each in faulty.values())
    merit = 1.0 - 0.5 * (alarms / healthy.early_alarm.size + missed / total)
    print(f"mixture P(MD) {share(missed, total)} (paper 0.119 designed, 0.149 judged); FOM {merit:.4f} (paper 0.921)")
    print("best thresholds at equal weights in these flights:")
    mixture = np.concatenate([each.maximum for each in faulty.values()])
    motors = np.concatenate([faulty[name].motor_maximum for name in ("stuck", "saturation")])
    for name, table in (
        ("heading rate", best_threshold(healthy.maximum, mixture)),
        ("motor", best_threshold(healthy.motor_maximum, motors)),
    ):
        print(f"  {name}: {table[0]:.4f}, P(FA) {table[1]:.3f}, P(MD) {table[2]:.3f}, FOM {table[3]:.4f}")
    print("namings by the live monitor that were right, a fifth of the flights healthy:")
    namings = [naming for each in outcomes.values() for naming in each.namings]
    for way, way_name in enumerate(WAYS):
        for fault_class in dict.fromkeys(fault.fault_class for fault in detector.FAULTS):
            some = [n for n in namings if n.way == way and detector.FAULTS[n.named].fault_class == fault_class]
            if some:
                print(f"  {way_name:12}{fault_class:14}{share(sum(n.right for n in some), len(some))} of {len(some)}")
    delays = np.concatenate([each.detected_s for each in faulty.values()])
    print(f"median delay of detection, all faults: {np.nanmedian(delays):.1f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=1000, help="healthy flights, and of each class of fault")
    parser.add_argument("--seed", type=int, default=1_000_000, help="of the first flight")
    parser.add_argument("--quantised", action="store_true", help="round the channels as MAVLink does")
    arguments = parser.parse_args()
    configuration = tomllib.loads(CONFIG.read_text())
    began_s, cpu_began_s = time.monotonic(), time.process_time()
    outcomes: dict[str, Outcomes] = {}
    flown, total = 0, arguments.flights * len(KINDS)
    for c, kind in enumerate(KINDS):
        first = arguments.seed + c * CLASS_STRIDE
        seeds = np.arange(first, first + arguments.flights)
        parts = []
        for begin in range(0, seeds.size, BATCH):
            batch = seeds[begin : begin + BATCH]
            parts.append(fly(kind, batch, configuration, arguments.quantised))
            flown += batch.size
            rate = flown / (time.monotonic() - began_s)
            left_s = (total - flown) / rate
            print(f"{flown}/{total} flights, {rate:.0f}/s, {left_s:.0f} s left", file=sys.stderr)
        outcomes[kind.name] = gather(parts)
    limits = configuration["monitor"]["paper"]["thresholds"]
    wire = ", channels rounded as on the wire" if arguments.quantised else ""
    print(f"{arguments.flights} flights a class, seeds from {arguments.seed}{wire}")
    report(outcomes, (limits["heading_rate_rad2_s2"], limits["motor_m"]))
    print(f"CPU {time.process_time() - cpu_began_s:.0f} s")


if __name__ == "__main__":
    main()
