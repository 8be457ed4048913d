"""What a check is, what it may say, and how long a condition must stand before it is said.

Records and small pure machines; the checks themselves are in the files beside this one, their limits in `table.py`.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final, Protocol

from companion.dialect import Fields, Value
from companion.events import Json
from companion.frames import Frame

EVERY_FRAME: Final = "*"  # in `Check.needs`: every frame of every system, undecoded
EVERY_BEAT: Final = "HEARTBEAT of every system"
HOLD_S: Final = 5.0  # what stands for less is forgiven, where a check says nothing else
BACK_S: Final = 2.0  # a clock further back than this has restarted; less is the order of messages
SOURCE_OURS: Final = "docs/checks.md, margins"  # limits set by what healthy flights show


class Status(StrEnum):
    """The outcome of one check over one log."""

    OK = "ok"
    WARNING = "warning"
    FAULT = "fault"
    NOT_AVAILABLE = "not_available"


class Severity(StrEnum):
    """The worst that a check may say: a fault only where a sensor, an actuator or the power is shown to have failed."""

    INFO = "info"  # it tells, and is always ok
    WARNING = "warning"
    FAULT = "fault"


@dataclass(frozen=True, slots=True)
class Check:
    """One row of the table.

    needs: message names without which nothing can be said, "A|B" where either will do.  limit, unit: what is exceeded, and
    in what it is measured (SI; mG for magnetic fields, because MAVLink's are).  source: where the limit comes from.
    """

    id: str
    needs: tuple[str, ...]
    limit: float
    unit: str
    source: str
    severity: Severity
    text: str
    also: tuple[str, ...] = ()  # messages that are looked at where they come


Span = tuple[float, float]  # (start, end), vehicle clock, s


@dataclass(frozen=True, slots=True)
class Result:
    """What one check's unit found.  t: when, on the vehicle's clock; spans: while it stood, for a timeline."""

    status: Status
    text: str
    t: float | None = None
    spans: tuple[Span, ...] = ()


@dataclass(frozen=True, slots=True)
class Finding:
    """A result under its check's id.  t and spans: s since boot; None where the vehicle's clock is not known."""

    id: str
    status: Status
    text: str
    t: float | None = None
    spans: tuple[Span, ...] = ()

    def as_json(self) -> dict[str, Json]:
        """As it stands in the field `checks` of an analysis."""
        out: dict[str, Json] = {"id": self.id, "status": self.status.value, "text": self.text, "t": self.t}
        if self.spans:
            out["spans"] = [[start, end] for start, end in self.spans]
        return out


class Unit(Protocol):
    """One check at work on one log: built as `Unit(check, flight)`, fed in order, asked once at the end."""

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        """One message that `needs` or `also` names, of the vehicle's autopilot; t_s: vehicle clock, s."""

    def finish(self) -> Result: ...


def number(fields: Mapping[str, Value], name: str) -> float:
    """A scalar field of a message."""
    value = fields[name]
    if type(value) is float:  # most are, and this is asked more often than anything else
        return value
    assert isinstance(value, int)  # the caller names scalar number fields only
    return float(value)


def known(value: float, unknown: float) -> float:
    """NaN where the wire says that the value is not known."""
    return math.nan if value == unknown else value


def absent(why: str) -> Result:
    """Nothing can be said, and why."""
    return Result(Status.NOT_AVAILABLE, f"not available: {why}")


def fine(text: str) -> Result:
    return Result(Status.OK, text)


def worst(check: Check) -> Status:
    """The status of a check whose limit is passed."""
    return Status.FAULT if check.severity is Severity.FAULT else Status.WARNING


def found(check: Check, detail: str, spans: tuple[Span, ...], status: Status | None = None) -> Result:
    """The limit was passed: the check's own words and what exactly."""
    return Result(status or worst(check), f"{check.text}: {detail}", spans[0][0] if spans else None, spans)


def total_s(spans: tuple[Span, ...]) -> float:
    """How long all of them lasted together."""
    return math.fsum(end - start for start, end in spans)


@dataclass(slots=True)
class Held:
    """A condition that counts only if it stands for hold_s; samples further apart than gap_s do not continue it.

    `worst` is the largest size given while it stood.  Unknown input (neither true nor false) is simply not given.
    """

    hold_s: float
    gap_s: float = 5.0
    worst: float = 0.0
    samples: int = 0  # of all, whether true or false
    _start_s: float | None = None
    _last_s: float = 0.0
    _worst: float = 0.0
    _spans: list[Span] = field(default_factory=list)

    def take(self, t_s: float, stands: bool, size: float = 0.0) -> None:
        """One sample."""
        self.samples += 1
        if self._start_s is not None and not -BACK_S < t_s - self._last_s <= self.gap_s:
            self._close(self._last_s)
        if stands:
            if self._start_s is None:
                self._start_s, self._worst = t_s, size
            elif size > self._worst:
                self._worst = size
        elif self._start_s is not None:
            self._close(t_s)
        self._last_s = t_s

    def stop(self) -> None:
        """It cannot be judged any further (disarmed, landed): what stood so far ends here."""
        if self._start_s is not None:
            self._close(self._last_s)

    def _close(self, end_s: float) -> None:
        assert self._start_s is not None
        if end_s - self._start_s >= self.hold_s:
            self._spans.append((self._start_s, end_s))
            self.worst = max(self.worst, self._worst)
        self._start_s = None

    def spans(self) -> tuple[Span, ...]:
        """All that lasted long enough, the one still standing included."""
        self.stop()
        return tuple(self._spans)


@dataclass(slots=True)
class Excess:
    """A value against its limit: the spans in which it stood beyond it for hold_s, and how far it went.

    below: the small values are the wrong ones.  farthest: of all samples; worst: of those within the spans.
    """

    limit: float
    hold_s: float = HOLD_S
    below: bool = False
    farthest: float = field(init=False)
    _held: Held = field(init=False)

    def __post_init__(self) -> None:
        self.farthest = math.inf if self.below else -math.inf
        self._held = Held(self.hold_s)

    @property
    def samples(self) -> int:
        return self._held.samples

    @property
    def worst(self) -> float:
        return self.limit - self._held.worst if self.below else self.limit + self._held.worst

    def take(self, t_s: float, value: float) -> None:
        """One sample; NaN: it cannot be judged, and what stood so far ends here."""
        if math.isnan(value):
            self._held.stop()
            return
        over = self.limit - value if self.below else value - self.limit
        self.farthest = min(self.farthest, value) if self.below else max(self.farthest, value)
        self._held.take(t_s, over > 0.0, over)

    def spans(self) -> tuple[Span, ...]:
        return self._held.spans()

    def result(self, check: Check, nothing: str, beyond: str, within: str) -> Result:
        """The three outcomes in these words: no sample, too far, never.

        beyond and within may name {farthest}; beyond may name {worst} and {lasted_s}, of all spans together, too.
        """
        if not self.samples:
            return absent(nothing)
        spans = self.spans()
        if not spans:
            return fine(within.format(farthest=self.farthest))
        return found(check, beyond.format(farthest=self.farthest, worst=self.worst, lasted_s=total_s(spans)), spans)


@dataclass(slots=True)
class Joined:
    """Spans, one after the other; what begins less than gap_s behind the end of the one before continues it."""

    gap_s: float
    spans: list[Span] = field(default_factory=list)

    def add(self, start_s: float, end_s: float) -> None:
        if self.spans and start_s - self.spans[-1][1] < self.gap_s:
            before_s, last_s = self.spans[-1]
            self.spans[-1] = (before_s, max(end_s, last_s))
        else:
            self.spans.append((start_s, end_s))


def runs(beyond: Iterable[bool], least: int) -> Iterator[tuple[int, int]]:
    """(first, last) place of each run of true values that is at least so long."""
    length = 0
    for place, stands in enumerate([*beyond, False]):
        if stands:
            length += 1
            continue
        if length >= least:
            yield place - length, place - 1
        length = 0


@dataclass(frozen=True, slots=True)
class Mean:
    """The mean of a window: (column,) values and their standard errors."""

    start_s: float
    end_s: float
    mean: tuple[float, ...]
    error: tuple[float, ...]


@dataclass(slots=True)
class Means:
    """Means over windows of width_s, one after the other; windows with fewer than `least` samples are dropped."""

    width_s: float
    least: int = 8
    windows: list[Mean] = field(default_factory=list)
    _start_s: float | None = None
    _samples: list[tuple[float, ...]] = field(default_factory=list)

    def take(self, t_s: float, values: tuple[float, ...]) -> None:
        """One sample, (column,); a NaN in it drops the sample."""
        if not math.isfinite(sum(values)):
            return
        if self._start_s is None or not -BACK_S < t_s - self._start_s < 1.5 * self.width_s:
            self._start_s, self._samples = t_s, []
        elif t_s - self._start_s >= self.width_s:
            self._close(self._start_s, t_s)
            self._start_s, self._samples = t_s, []
        self._samples.append(values)

    def _close(self, start_s: float, end_s: float) -> None:
        n = len(self._samples)
        if n < self.least:
            return
        columns = list(zip(*self._samples, strict=True))
        mean = tuple(sum(column) / n for column in columns)
        square = [sum([value * value for value in column]) / n for column in columns]
        error = tuple(math.sqrt(max(0.0, s - m * m) / n) for s, m in zip(square, mean, strict=True))
        self.windows.append(Mean(start_s, end_s, mean, error))


def median(values: list[float]) -> float:
    """The middle one, the lower of two.  values: not empty."""
    return sorted(values)[(len(values) - 1) // 2]


@dataclass(frozen=True, slots=True)
class Change:
    """The largest change against the reference, and while it was beyond the limit."""

    size: float
    column: int
    spans: tuple[Span, ...]


def change(windows: list[Mean], limit: float, references: int = 3, errors: float = 5.0, run: int = 2) -> Change | None:
    """How far the windows' means go from the median of the first ones.

    limit: in the columns' unit; a mean counts only beyond `errors` of its standard errors as well, so that vibration and a
    thin stream do not pass for a change.  run: how many windows must follow each other.  None if there are too few.
    """
    if len(windows) < references + run:
        return None
    columns = range(len(windows[0].mean))
    reference = [median([window.mean[c] for window in windows[:references]]) for c in columns]
    judged = windows[references:]
    largest, where = 0.0, 0
    beyond: list[bool] = []
    for window in judged:
        beyond.append(False)
        for c in columns:
            away = abs(window.mean[c] - reference[c])
            if away > max(limit, errors * window.error[c]):
                beyond[-1] = True
                if away > largest:
                    largest, where = away, c
    spans = Joined(1e-9)  # windows may overlap, or touch
    for first, last in runs(beyond, run):
        spans.add(judged[first].start_s, judged[last].end_s)
    return Change(largest, where, tuple(spans.spans))
