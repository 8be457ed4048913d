"""The link itself: frames lost, silence, floods by strangers, and two speaking under one id."""

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from companion.checks.finding import Check, Result, Span, absent, fine, found
from companion.checks.flight import Flight
from companion.dialect import Fields
from companion.frames import Frame

LATE: Final = 128  # a gap of more sequence numbers than this is a frame that came late or twice
LEAST_FRAMES: Final = 100
RATE_WINDOW_S: Final = 1.0
FLOOD_S: Final = 3.0  # a burst is shorter
FLOOD_BEATS_HZ: Final = 50.0  # a heartbeat comes once a second; some ground stations send ten, nobody fifty

Source = tuple[int, int]


def named(source: Source) -> str:
    return f"{source[0]}/{source[1]}"


@dataclass(slots=True)
class Loss:
    """Check `link_loss`: gaps in the sequence numbers of each system and component."""

    check: Check
    flight: Flight
    _last: dict[Source, int] = field(default_factory=dict)
    _frames: Counter[Source] = field(default_factory=Counter)
    _lost: Counter[Source] = field(default_factory=Counter)
    _late: Counter[Source] = field(default_factory=Counter)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        source = (frame.sysid, frame.compid)
        self._frames[source] += 1
        last = self._last.get(source)
        self._last[source] = frame.seq
        if last is None:
            return
        gap = (frame.seq - last - 1) & 0xFF
        if gap == 0:
            return
        if gap > LATE:
            self._late[source] += 1
        else:
            self._lost[source] += gap

    def finish(self) -> Result:
        vehicle = self._vehicle()
        if vehicle is None:
            return absent("no autopilot sent enough frames")
        parts: list[str] = []
        for source, frames in self._frames.most_common(6):
            lost, late = self._lost[source], self._late[source]
            if lost or (late and source == vehicle):
                told = f"{named(source)} {100.0 * lost / (frames + lost):.1f} % of {frames + lost} lost"
                parts.append(told + (f", {late} late or twice" if late else ""))
        lost, frames = self._lost[vehicle], self._frames[vehicle]
        told = "; ".join(parts) or "none lost"
        if 100.0 * lost / (frames + lost) > self.check.limit:
            return found(self.check, told, ())
        return fine(told)

    def _vehicle(self) -> Source | None:
        sysid, compid = self.flight.sysid, self.flight.compid
        if sysid is None or compid is None or self._frames[sysid, compid] < LEAST_FRAMES:
            return None
        return sysid, compid


@dataclass(slots=True)
class Silence:
    """Check `link_silence`: the longest time in which nothing came from the vehicle."""

    check: Check
    flight: Flight
    _arrival_s: float = math.nan
    _t_s: float = 0.0
    _longest_s: float = 0.0
    _spans: list[Span] = field(default_factory=list)
    _samples: int = 0

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        flight = self.flight
        if frame.sysid != flight.sysid or frame.compid != flight.compid or not math.isfinite(flight.arrival_s):
            return
        gap_s = flight.arrival_s - self._arrival_s  # NaN for the first
        self._samples += 1
        if gap_s > self._longest_s:
            self._longest_s = gap_s
        if gap_s > self.check.limit:
            self._spans.append((self._t_s, max(t_s, self._t_s)))
        self._arrival_s, self._t_s = flight.arrival_s, t_s

    def finish(self) -> Result:
        if self._samples < 2:
            return absent("no stamped frames of an autopilot")
        told = f"longest {self._longest_s:.1f} s"
        if self._spans:
            return found(self.check, f"{len(self._spans)} time(s), {told}", tuple(self._spans))
        return fine(told)


@dataclass(slots=True)
class Flood:
    """Check `link_flood`: somebody who is not the vehicle sends more than anybody should, or beats as nobody does."""

    check: Check
    flight: Flight
    _begun: dict[Source, tuple[float, float]] = field(default_factory=dict)  # arrival, vehicle clock
    _count: Counter[Source] = field(default_factory=Counter)
    _beats: Counter[Source] = field(default_factory=Counter)
    _worst: dict[Source, tuple[float, float]] = field(default_factory=dict)  # frames/s, heartbeats/s
    _spans: dict[Source, list[Span]] = field(default_factory=dict)
    _stamped: int = 0

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        now_s = self.flight.arrival_s
        if not math.isfinite(now_s):
            return
        self._stamped += 1
        source = (frame.sysid, frame.compid)
        begun = self._begun.get(source)
        if begun is None or not 0.0 <= now_s - begun[0] < RATE_WINDOW_S:
            if begun is not None:
                # The vehicle's clock counts too: a log written faster than it was flown is no flood.
                self._close(source, max(now_s - begun[0], t_s - begun[1]), t_s)
            self._begun[source] = (now_s, t_s)
            self._count[source] = self._beats[source] = 0
        self._count[source] += 1
        if name == "HEARTBEAT":
            self._beats[source] += 1

    def _close(self, source: Source, length_s: float, t_s: float) -> None:
        length_s = max(length_s, RATE_WINDOW_S)
        rate_hz, beats_hz = self._count[source] / length_s, self._beats[source] / length_s
        own = source[0] == self.flight.sysid
        if not (beats_hz > FLOOD_BEATS_HZ or (rate_hz > self.check.limit and not own)):
            return
        before = self._worst.get(source, (0.0, 0.0))
        self._worst[source] = (max(before[0], rate_hz), max(before[1], beats_hz))
        spans = self._spans.setdefault(source, [])
        if spans and t_s - spans[-1][1] < 3.0 * RATE_WINDOW_S:
            spans[-1] = (spans[-1][0], max(t_s, spans[-1][1]))
        else:
            spans.append((t_s - min(length_s, t_s), t_s))

    def finish(self) -> Result:
        if not self._stamped:
            return absent("no stamped frames")
        spans = {source: lasting for source, found in self._spans.items() if (lasting := _lasting(found))}
        if not spans:
            return fine("no source sends more than it should")
        told = "; ".join(
            f"{named(source)} up to {rate_hz:.0f} frames/s, {beats_hz:.0f} of them heartbeats"
            for source, (rate_hz, beats_hz) in self._worst.items()
            if source in spans
        )
        return found(self.check, told, tuple(sorted(span for lasting in spans.values() for span in lasting)))


def _lasting(spans: list[Span]) -> list[Span]:
    return [span for span in spans if span[1] - span[0] >= FLOOD_S]


@dataclass(slots=True)
class Identity:
    """Check `link_identity`: heartbeats of two types or two autopilots under one system and component."""

    check: Check
    flight: Flight
    _seen: dict[Source, Counter[tuple[int, int]]] = field(default_factory=dict)
    _first_s: dict[Source, float] = field(default_factory=dict)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if name != "HEARTBEAT":
            return
        beat = frame.fields()
        kind, autopilot = beat["type"], beat["autopilot"]
        assert isinstance(kind, int)
        assert isinstance(autopilot, int)
        source = (frame.sysid, frame.compid)
        seen = self._seen.setdefault(source, Counter())
        if seen and (kind, autopilot) not in seen:
            self._first_s.setdefault(source, t_s)
        seen[kind, autopilot] += 1

    def finish(self) -> Result:
        if not self._seen:
            return absent("no HEARTBEAT message")
        double = {source: seen for source, seen in self._seen.items() if sum(n > 1 for n in seen.values()) > 1}
        if not double:
            return fine(f"{len(self._seen)} source(s) beat, each as one")
        told = "; ".join(
            f"{named(source)} beats as "
            + " and as ".join(f"{_kind(kind, pilot)} ({n})" for (kind, pilot), n in seen.items())
            for source, seen in double.items()
        )
        return found(self.check, told, tuple((t_s, t_s) for source, t_s in self._first_s.items() if source in double))


def _kind(kind: int, autopilot: int) -> str:
    def name(group: str, value: int) -> str:
        entry = mavlink.enums[group].get(value)
        return str(entry.name).removeprefix(f"{group}_").lower() if entry is not None else str(value)

    return f"{name('MAV_TYPE', kind)} of {name('MAV_AUTOPILOT', autopilot)}"
