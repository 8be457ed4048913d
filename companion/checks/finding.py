"""What a check is, what it may say, and how long a condition must stand before it is said.

Records and small pure machines; the checks themselves are in the files beside this one, their limits in `table.py`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final, Protocol

from companion.dialect import Fields, Value
from companion.events import Json
from companion.frames import Frame

EVERY_FRAME: Final = "*"  # in `Check.needs`: every frame of every system, undecoded
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
            self._worst = max(self._worst, size)
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
    _last_s: float = 0.0
    _count: int = 0
    _sums: list[float] = field(default_factory=list)
    _squares: list[float] = field(default_factory=list)

    def take(self, t_s: float, values: tuple[float, ...]) -> None:
        """One sample, (column,); a NaN in it drops the sample."""
        if not all(map(math.isfinite, values)):
            return
        if self._start_s is None or not -BACK_S < t_s - self._start_s < 1.5 * self.width_s:
            self._begin(t_s, len(values))
        elif t_s - self._start_s >= self.width_s:
            self._close(t_s)
            self._begin(t_s, len(values))
        self._count += 1
        self._last_s = t_s
        for column, value in enumerate(values):
            self._sums[column] += value
            self._squares[column] += value * value

    def _begin(self, t_s: float, columns: int) -> None:
        self._start_s, self._count = t_s, 0
        self._sums, self._squares = [0.0] * columns, [0.0] * columns

    def _close(self, end_s: float) -> None:
        if self._start_s is None or self._count < self.least:
            return
        n = self._count
        mean = tuple(total / n for total in self._sums)
        error = tuple(
            math.sqrt(max(0.0, square / n - value * value) / n) for square, value in zip(self._squares, mean, strict=True)
        )
        self.windows.append(Mean(self._start_s, end_s, mean, error))

    def restart(self) -> None:
        """Drop the window under way, for the samples in it belong no longer together."""
        self._start_s = None


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
    largest, where = 0.0, 0
    spans: list[Span] = []
    standing: list[Mean] = []
    for window in [*windows[references:], None]:
        beyond = False
        if window is not None:
            for c in columns:
                away = abs(window.mean[c] - reference[c])
                if away > max(limit, errors * window.error[c]):
                    beyond = True
                    if away > largest:
                        largest, where = away, c
        if beyond and window is not None:
            standing.append(window)
            continue
        if len(standing) >= run:
            start_s, end_s = standing[0].start_s, standing[-1].end_s
            if spans and start_s <= spans[-1][1]:  # overlapping windows
                start_s = spans.pop()[0]
            spans.append((start_s, end_s))
        standing.clear()
    return Change(largest, where, tuple(spans))
