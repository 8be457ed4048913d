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
MOST_TOLD: Final = 6
RATE_WINDOW_S: Final = 1.0
FLOOD_S: Final = 3.0  # a burst is shorter
FLOOD_BEATS_HZ: Final = 50.0  # a heartbeat comes once a second; some ground stations send ten, nobody fifty

Source = tuple[int, int]


def named(source: Source) -> str:
    return f"{source[0]}/{source[1]}"


@dataclass(slots=True)
class _Numbers:
    """The sequence numbers of one source."""

    last: int
    frames: int = 0
    lost: int = 0
    late: int = 0


@dataclass(slots=True)
class Loss:
    """Check `link_loss`: gaps in the sequence numbers of each system and component."""

    check: Check
    flight: Flight
    _sources: dict[Source, _Numbers] = field(default_factory=dict)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        seq = frame.seq
        numbers = self._sources.get((frame.sysid, frame.compid))
        if numbers is None:
            numbers = self._sources[frame.sysid, frame.compid] = _Numbers(seq - 1)
        numbers.frames += 1
        gap = (seq - numbers.last - 1) & 0xFF
        numbers.last = seq
        if gap > LATE:
            numbers.late += 1
        elif gap:
            numbers.lost += gap

    def finish(self) -> Result:
        vehicle = self._vehicle()
        if vehicle is None:
            return absent("no autopilot sent enough frames")
        parts: list[str] = []
        most = sorted(self._sources.items(), key=lambda item: item[1].frames, reverse=True)
        for source, numbers in most[:MOST_TOLD]:
            if numbers.lost or (numbers.late and numbers is vehicle):
                sent = numbers.frames + numbers.lost
                told = f"{named(source)} {100.0 * numbers.lost / sent:.1f} % of {sent} lost"
                parts.append(told + (f", {numbers.late} late or twice" if numbers.late else ""))
        told = "; ".join(parts) or "none lost"
        if 100.0 * vehicle.lost / (vehicle.frames + vehicle.lost) > self.check.limit:
            return found(self.check, told, ())
        return fine(told)

    def _vehicle(self) -> _Numbers | None:
        sysid, compid = self.flight.sysid, self.flight.compid
        found = self._sources.get((sysid, compid)) if sysid is not None and compid is not None else None
        return found if found is not None and found.frames >= LEAST_FRAMES else None


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
        arrival_s = flight.arrival_s
        if frame.compid != flight.compid or frame.sysid != flight.sysid or not math.isfinite(arrival_s):
            return
        gap_s = arrival_s - self._arrival_s  # NaN for the first
        self._samples += 1
        if gap_s > self._longest_s:
            self._longest_s = gap_s
        if gap_s > self.check.limit:
            self._spans.append((self._t_s, max(t_s, self._t_s)))
        self._arrival_s, self._t_s = arrival_s, t_s

    def finish(self) -> Result:
        if self._samples < 2:
            return absent("no stamped frames of an autopilot")
        told = f"longest {self._longest_s:.1f} s"
        if self._spans:
            return found(self.check, f"{len(self._spans)} time(s), {told}", tuple(self._spans))
        return fine(told)


@dataclass(slots=True)
class _Rate:
    """What one source sends."""

    begun_s: float = math.nan  # the window under way: arrival
    begun_t_s: float = 0.0  # and vehicle clock
    frames: int = 0
    beats: int = 0
    most_hz: float = 0.0  # of the windows that were too much
    most_beats_hz: float = 0.0
    spans: list[Span] = field(default_factory=list)


@dataclass(slots=True)
class Flood:
    """Check `link_flood`: somebody who is not the vehicle sends more than anybody should, or beats as nobody does."""

    check: Check
    flight: Flight
    _rates: dict[Source, _Rate] = field(default_factory=dict)
    _too_much: dict[Source, _Rate] = field(default_factory=dict)  # in the order in which they first were

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        now_s = self.flight.arrival_s
        if not math.isfinite(now_s):
            return
        rate = self._rates.get((frame.sysid, frame.compid))
        if rate is None:
            rate = self._rates[frame.sysid, frame.compid] = _Rate()
        if not 0.0 <= now_s - rate.begun_s < RATE_WINDOW_S:  # nor of the first, whose begin is NaN
            if rate.frames:
                # The vehicle's clock counts too: a log written faster than it was flown is no flood.
                self._close((frame.sysid, frame.compid), rate, max(now_s - rate.begun_s, t_s - rate.begun_t_s), t_s)
            rate.begun_s, rate.begun_t_s, rate.frames, rate.beats = now_s, t_s, 0, 0
        rate.frames += 1
        if name == "HEARTBEAT":
            rate.beats += 1

    def _close(self, source: Source, rate: _Rate, length_s: float, t_s: float) -> None:
        length_s = max(length_s, RATE_WINDOW_S)
        rate_hz, beats_hz = rate.frames / length_s, rate.beats / length_s
        own = source[0] == self.flight.sysid
        if not (beats_hz > FLOOD_BEATS_HZ or (rate_hz > self.check.limit and not own)):
            return
        self._too_much[source] = rate
        rate.most_hz, rate.most_beats_hz = max(rate.most_hz, rate_hz), max(rate.most_beats_hz, beats_hz)
        spans = rate.spans
        if spans and t_s - spans[-1][1] < 3.0 * RATE_WINDOW_S:
            spans[-1] = (spans[-1][0], max(t_s, spans[-1][1]))
        else:
            spans.append((t_s - min(length_s, t_s), t_s))

    def finish(self) -> Result:
        if not self._rates:
            return absent("no stamped frames")
        spans = {source: lasting for source, rate in self._too_much.items() if (lasting := _lasting(rate.spans))}
        if not spans:
            return fine("no source sends more than it should")
        told = "; ".join(
            f"{named(source)} up to {rate.most_hz:.0f} frames/s, {rate.most_beats_hz:.0f} of them heartbeats"
            for source, rate in self._too_much.items()
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
