"""What the parafoil's design flights give: thresholds by the paper's rules and ours, and the records kept of them."""

import datetime
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

import fdi.parafoil as detector
from fdi.parafoil.config import GpsBank, GyroBank
from fdi.thresholds import Elimination, Rates, Tail, elimination, rates, tail_threshold, trade_off
from parafoil_flights import LINES, Flights, namings, outcome, together

PAPER = "paper"
WEIGHTS = (1.0, 0.8, 0.6, 0.5, 0.4, 0.2, 0.0)  # c1, of false alarms
EQUAL = WEIGHTS.index(0.5)
SUREST = 0.999  # largest confidence kept: a share of some hundreds is no certainty

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Sample:
    """Flights of one detector that belong together: found on, or judged by."""

    detector: str
    told: str  # which flights these are
    healthy: Flights
    faulty: Mapping[str, Flights]  # by the name of the kind

    @property
    def by_papers_rule(self) -> bool:
        return self.detector == PAPER

    @property
    def mixture(self) -> Flights:
        return together(list(self.faulty.values()))

    @property
    def even(self) -> Flights:
        """As many flights of every kind, healthy among them: the first ones, as many as there are of the rarest."""
        kinds = [self.healthy, *self.faulty.values()]
        count = min(flights.count for flights in kinds)
        return together([flights.where(np.arange(flights.count) < count) for flights in kinds])

    def groups(self) -> dict[str, Flights]:
        """The kinds, and the motor faults as the paper has them."""
        motors = together([self.faulty["stuck"], self.faulty["saturation"]])
        return {
            "stuck": self.faulty["stuck"],
            "saturation": self.faulty["saturation"],
            "both motor faults": motors,
            "left motor": motors.where(motors.truth == "motor:left"),
            "broken": self.faulty["broken"],
            "crossed": self.faulty["crossed"],
        }


@dataclass(frozen=True, slots=True)
class PaperDesign:
    """What the paper's rules find on design flights."""

    heading_rate: tuple[Rates, ...]  # by WEIGHTS
    motor: tuple[Rates, ...]  # by WEIGHTS; faults: the 5 s from detection
    motor_60: Rates  # at equal weights; faults: the 60 s from the onset
    broken: Elimination
    crossed: Elimination


def line_maxima(sample: Sample) -> tuple[tuple[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Maxima over 90 s of the broken-line residuals (line broken; the other one; crossed) and of crossed (crossed; broken).

    Both sides together: each residual where its own line is broken, and where the other one is.
    """
    broken, crossed = sample.faulty["broken"], sample.faulty["crossed"]
    left, right, cross = (broken.numbers(f"peak_90_{name}") for name in LINES)
    is_left = broken.truth == "broken_line:left"
    under_crossed = np.concatenate([crossed.numbers(f"peak_90_{name}") for name in LINES[:2]])
    own, other = np.where(is_left, left, right), np.where(is_left, right, left)
    return (own, other, under_crossed), (crossed.numbers("peak_90_crossed"), cross)


def motor_maxima(sample: Sample) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of the larger motor residual in healthy flights; of the faulty motor's in the 5 s from detection; in the 60 s."""
    motors = sample.groups()["both motor faults"]
    detected = outcome(motors, sample.by_papers_rule).detected
    return (
        sample.healthy.of_faulty_motor("peak"),
        motors.of_faulty_motor("peak_named")[detected],
        motors.of_faulty_motor("peak_60"),
    )


def design_of_paper(sample: Sample) -> PaperDesign:
    turns = trade_off(sample.healthy.numbers("peak_heading_rate"), sample.mixture.numbers("peak_60_heading_rate"))
    healthy, named, in_60 = motor_maxima(sample)
    motors = trade_off(healthy, named)
    (own, other, crossed), (own_crossed, broken) = line_maxima(sample)
    return PaperDesign(
        tuple(turns.best(weight) for weight in WEIGHTS),
        tuple(motors.best(weight) for weight in WEIGHTS),
        trade_off(healthy, in_60).best(0.5),
        elimination(own, (other, crossed)),
        elimination(own_crossed, (broken,)),
    )


def tail_of(sample: Sample, config: detector.Config) -> Tail:
    """The threshold of our turn monitor by the tail rule, at the false alarms that its design record asks for."""
    return tail_threshold(
        sample.healthy.numbers("peak_heading_rate"), bank_of(sample.detector, config).design.false_alarms_per_flight
    )


def bank_of(name: str, config: detector.Config) -> GpsBank | GyroBank:
    return config.turns.gyro if name == "gyro" else config.turns.gps


def judged_rates(found: Sequence[Rates], sample: Sample) -> list[Rates]:
    """The designed thresholds of the heading-rate residual on other flights."""
    healthy, mixture = sample.healthy.numbers("peak_heading_rate"), sample.mixture.numbers("peak_60_heading_rate")
    return [rates(each.threshold, healthy, mixture) for each in found]


def measures(sample: Sample) -> dict[str, float]:
    """What the bars are about, and what the sample says of it."""
    seen = {name: outcome(flights, sample.by_papers_rule) for name, flights in sample.groups().items()}
    values = {"P(FA)": float(sample.healthy.early.mean())}
    for name, each in seen.items():
        values[f"P(DET) {name}"] = ratio(each.detected.sum(), each.detected.size)
        values[f"P(ISO) {name}"] = ratio(each.right.sum(), each.detected.sum())
        values[f"P(FI) {name}"] = ratio(each.wrong.sum(), each.detected.sum())
        values[f"median s {name}"] = median(each.detected_s)
    everything = outcome(sample.mixture, sample.by_papers_rule)
    values["mixture P(MD)"] = float(1.0 - everything.detected.mean())
    values["FOM"] = Rates(math.nan, values["P(FA)"], values["mixture P(MD)"]).merit(0.5)
    values["median s all"] = median(everything.detected_s)
    return values


def ratio(count: float, of: float) -> float:
    """NaN where there was nothing to count."""
    return float(count / of) if of else math.nan


def median(times_s: FloatArray) -> float:
    return float(np.nanmedian(times_s)) if np.isfinite(times_s).any() else math.nan


def delays(sample: Sample) -> dict[str, float]:
    """Median time from onset to detection, by the keys of `[monitor.paper.delays]`."""
    groups = sample.groups()
    flights = {
        "any_s": sample.mixture,
        "motor_s": groups["both motor faults"],
        "broken_line_s": groups["broken"],
        "crossed_lines_s": groups["crossed"],
    }
    return {name: median(outcome(each, sample.by_papers_rule).detected_s) for name, each in flights.items()}


@dataclass(frozen=True, slots=True)
class Entry:
    """A value of the packaged configuration, as TOML, and what stands behind it if that changes too."""

    table: str
    key: str
    value: str
    comment: str | None = None


def edited(text: str, entries: Sequence[Entry]) -> str:
    """TOML text with other values; all else, comments and their columns too, stays.  Raises KeyError for an unknown key."""
    lines = text.split("\n")
    for entry in entries:
        at = _line_of(lines, entry)
        found = re.fullmatch(r"""([^=]+=\s*)("[^"]*"|[^#\s]+)(\s*)(#.*)?""", lines[at])
        if found is None:
            raise KeyError(f"{entry.table}.{entry.key} is no plain value")
        head, old, gap, comment = found.groups()
        line = head + entry.value
        comment = comment if entry.comment is None else f"# {entry.comment}"
        if comment:
            column = len(head) + len(old) + len(gap)
            line = f"{line:{column}}" if len(line) < column else f"{line} "
        lines[at] = line + (comment or "")
    return "\n".join(lines)


def _line_of(lines: Sequence[str], entry: Entry) -> int:
    inside = False
    for at, line in enumerate(lines):
        if line.startswith("["):
            inside = line.startswith(f"[{entry.table}]")
        elif inside and re.match(rf"{re.escape(entry.key)}\s*=", line):
            return at
    raise KeyError(f"{entry.table}.{entry.key}")


def entries_of_paper(
    sample: Sample, design: PaperDesign, config: detector.Config, command: str, first_seed: int, *, thresholds: bool
) -> list[Entry]:
    """The record of what was measured with the configured thresholds, or of what was found: those, and what they cost.

    Confidence and delays are measured only with thresholds that were flown.
    """
    limits = config.paper.thresholds
    best = design.heading_rate[EQUAL]
    at = best.threshold if thresholds else limits.heading_rate_rad2_s2
    cost = judged_rates([replace(best, threshold=at)], sample)[0]
    record = "monitor.paper.design"
    entries = [
        *_origin(record, command, first_seed, sample.healthy.count),
        Entry(record, "fault_flights", str(sample.mixture.count)),
        Entry(record, "false_alarms_per_flight", f"{cost.false_alarms:.4f}"),
        Entry(record, "missed_share", f"{cost.missed:.4f}"),
    ]
    if thresholds:
        found = {
            "heading_rate_rad2_s2": at,
            "motor_m": design.motor[EQUAL].threshold,
            "broken_rad2_s2": design.broken.threshold,
            "crossed_rad2_s2": design.crossed.threshold,
        }
        return [*entries, *(Entry("monitor.paper.thresholds", key, f"{value:.4f}") for key, value in found.items())]
    for named in namings(sample.even):
        key = "motor" if named.way == "motor" else f"{named.fault_class}_by_{named.way}"
        if named.count:  # of what was never named so nothing was learnt
            value = min(named.right / named.count, SUREST)
            entries.append(Entry("monitor.paper.confidence", key, f"{value:.3f}", str(named.count)))
    return [*entries, *(Entry("monitor.paper.delays", key, f"{value:.1f}") for key, value in delays(sample).items())]


def entries_of_ours(sample: Sample, tail: Tail, command: str, first_seed: int, *, thresholds: bool) -> list[Entry]:
    bank = f"monitor.turns.{sample.detector}"
    entries = _origin(f"{bank}.design", command, first_seed, sample.healthy.count)
    return [*entries, Entry(bank, "threshold", f"{tail.threshold:.2f}")] if thresholds else entries


def _origin(record: str, command: str, first_seed: int, healthy: int) -> list[Entry]:
    return [
        Entry(record, "date", f'"{datetime.date.today().isoformat()}"'),
        Entry(record, "command", f'"{command}"'),
        Entry(record, "first_seed", str(first_seed)),
        Entry(record, "healthy_flights", str(healthy)),
    ]
