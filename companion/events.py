"""What happened, for people and programs: typed events, their one encoding as JSON lines, and their comparison.

Pure: who writes them to a disk or a terminal is elsewhere.  An event is never changed after it is made; `seq` has no gaps.
"""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from typing import Final

SCHEMA: Final = 1

# Fields that may differ between two recordings of the same happening: wall clock, where files lay, which run it was.
MAY_DIFFER: Final = frozenset({"utc", "path", "run_id", "source", "links"})

Json = None | bool | int | float | str | list["Json"] | dict[str, "Json"]


class Kind(StrEnum):
    """The subjects of events."""

    RUN = "run"  # the first line: version, airframe, configuration
    VEHICLE = "vehicle"  # seen, armed, disarmed, mode, reboot, clock
    LINK = "link"  # up, silent, lost
    FAULT = "fault"  # detected, isolated, changed, cleared, inconclusive
    RECOVERY = "recovery"  # considered, refused, requested, acknowledged, verified, rolled_back, failed, vetoed
    CHECK = "check"  # a health check's finding
    LOG = "log"  # opened, rotated, closed, removed, full
    SELF = "self"  # started, stopped, overload, config
    END = "end"  # the last line: why, counters; a missing one says killed


class Severity(StrEnum):
    """RFC 5424's names as MAVLink uses them; critical: act now, warning: look, notice and info: for the log."""

    EMERGENCY = "emergency"
    CRITICAL = "critical"
    ERROR = "error"
    WARNING = "warning"
    NOTICE = "notice"
    INFO = "info"


SEVERITY_MAVLINK: Final[Mapping[Severity, int]] = {
    Severity.EMERGENCY: 0,
    Severity.CRITICAL: 2,
    Severity.ERROR: 3,
    Severity.WARNING: 4,
    Severity.NOTICE: 5,
    Severity.INFO: 6,
}


@dataclass(frozen=True, slots=True)
class FaultFacts:
    """The fault an event speaks of."""

    id: str
    fault_class: str
    where: str | None
    confidence: float
    size: float | None
    unit: str | None
    onset_t: float | None  # vehicle clock, s

    def as_json(self) -> dict[str, Json]:
        return {
            "id": self.id,
            "class": self.fault_class,
            "where": self.where,
            "confidence": self.confidence,
            "size": self.size,
            "unit": self.unit,
            "onset_t": self.onset_t,
        }


@dataclass(frozen=True, slots=True)
class Event:
    """One thing that happened, without its place in a file (`seq`), which whoever writes it gives."""

    kind: Kind
    name: str
    severity: Severity
    text: str  # one line for a person
    t: float | None = None  # vehicle clock, s since boot; None before the vehicle's clock is known
    utc_us: int | None = None  # arrival stamp
    reason: str = ""
    fault: FaultFacts | None = None
    evidence: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # residual -> (value, threshold)
    details: Mapping[str, Json] = field(default_factory=dict)  # what only this kind of event has


def utc_text(utc_us: int) -> str:
    """Microseconds since 1970 as 2026-01-05T10:11:12.400Z."""
    return (
        datetime.fromtimestamp(utc_us // 1_000_000, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        + f".{utc_us % 1_000_000 // 1000:03d}Z"
    )


def as_json(event: Event, seq: int, sysid: int | None, airframe: str) -> dict[str, Json]:
    """The event as it stands in a file; keys in their fixed order."""
    out: dict[str, Json] = {"schema": SCHEMA, "seq": seq, "t": event.t}
    out["utc"] = utc_text(event.utc_us) if event.utc_us is not None else None
    out["vehicle"] = {"sysid": sysid, "airframe": airframe}
    out |= {"kind": event.kind.value, "name": event.name, "severity": event.severity.value}
    if event.fault is not None:
        out["fault"] = event.fault.as_json()
    out["text"] = event.text
    if event.evidence:
        out["evidence"] = {name: {"value": value, "threshold": limit} for name, (value, limit) in event.evidence.items()}
    if event.reason:
        out["reason"] = event.reason
    out |= event.details
    return out


def encode(value: Json) -> str:
    """The one encoding: shortest floats that read back the same, NaN and infinity as null, no spaces, no newline."""
    return json.dumps(_finite(value), separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def _finite(value: Json) -> Json:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_finite(inner) for inner in value]
    return value


def same_events(one: Iterable[Mapping[str, Json]], other: Iterable[Mapping[str, Json]]) -> str | None:
    """Compare two recordings of the same happening, whatever made them: live run, replay, run in one process.

    Takes decoded lines.  None if they are the same but for MAY_DIFFER and the framing lines (`run`, `end`) and what a run
    says of itself (`self`, `log`), else a sentence telling the first difference.
    """
    first, second = _comparable(one), _comparable(other)
    for place, (left, right) in enumerate(zip(first, second, strict=False)):
        for key in sorted(left.keys() | right.keys()):
            if left.get(key) != right.get(key):
                which = f"event {place} ({left.get('kind')}/{left.get('name')})"
                return f"{which}: {key} is {left.get(key)!r} and {right.get(key)!r}"
    if len(first) != len(second):
        extra = (first if len(first) > len(second) else second)[min(len(first), len(second))]
        return (
            f"{len(first)} and {len(second)} events, the first without a partner is {extra.get('kind')}/{extra.get('name')}"
        )
    return None


def _comparable(events: Iterable[Mapping[str, Json]]) -> list[dict[str, Json]]:
    framing = {Kind.RUN.value, Kind.END.value, Kind.SELF.value, Kind.LOG.value}
    kept = [event for event in events if event.get("kind") not in framing]
    return [{key: value for key, value in event.items() if key not in MAY_DIFFER and key != "seq"} for event in kept]
