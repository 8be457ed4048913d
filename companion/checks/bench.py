"""Runs every check over one log: fed its frames in order, asked once at the end.

Pure: no clock and no file; arrival stamps come with the frames.  One vehicle is judged, the first autopilot heard or the one
that is asked for; of all others only what they do to the link.
"""

import math
from collections import defaultdict
from dataclasses import dataclass, field
from functools import cache
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from companion.checks.bootclock import BootClock, Clocks, Reboots
from companion.checks.finding import EVERY_FRAME, Check, Finding, Result, Status, Unit, absent, number
from companion.checks.flight import Flight
from companion.checks.table import CLOCK, REBOOT, ROWS
from companion.dialect import Definition, Fields, definition
from companion.frames import Frame
from companion.vehicle import NO_VEHICLE

WAIT_FRAMES: Final = 5000  # for an autopilot and its clock, before the rest is judged without
WAIT_S: Final = 10.0
NOTHING: Final[Fields] = {}

# Messages that the bench itself reads, needed by a check or not.
OWN: Final = frozenset({"HEARTBEAT", "SYSTEM_TIME", "VFR_HUD", "GLOBAL_POSITION_INT", "EXTENDED_SYS_STATE"})


@cache
def _plain(message_id: int) -> bool:
    message = definition(message_id)
    return message is not None and not any(message.counts) and "char" not in message.types


def _fields(frame: Frame, message: Definition) -> Fields:
    """Frame.fields, with a shorter way for messages of scalars only."""
    if _plain(message.id):
        return dict(zip(message.fields, message.unpack(frame.payload), strict=True))  # type: ignore[arg-type]  # no texts
    return frame.fields()


@dataclass(slots=True)
class Bench:
    """All checks over one log.

        bench = Bench()
        for record in reader:
            bench.take(record.frame, record.stamp_us)
        findings = bench.finish()

    sysid: judge this system's autopilot instead of the first one heard.
    """

    sysid: int | None = None
    flight: Flight = field(default_factory=Flight)
    clock: BootClock = field(default_factory=BootClock)
    _units: list[tuple[Check, Unit]] = field(default_factory=list)
    _every: list[Unit] = field(default_factory=list)
    _needed: dict[str, list[Unit]] = field(default_factory=lambda: defaultdict(list))
    _heard: set[str] = field(default_factory=set)
    _waiting: list[tuple[Frame, float]] | None = field(default_factory=list)
    _waiting_since_s: float = math.nan
    _arrival_s: float = math.nan

    def __post_init__(self) -> None:
        for check, build in ROWS:
            self._add(check, build(check, self.flight))
        self._add(REBOOT, Reboots(REBOOT, self.flight, self.clock))
        self._add(CLOCK, Clocks(CLOCK, self.flight, self.clock))

    def _add(self, check: Check, unit: Unit) -> None:
        self._units.append((check, unit))
        if EVERY_FRAME in check.needs:
            self._every.append(unit)
            return
        for names in (*check.needs, *check.also):
            for name in names.split("|"):
                if not any(unit is other for other in self._needed[name]):
                    self._needed[name].append(unit)

    def take(self, frame: Frame, arrival_us: int | None) -> None:
        """The next frame of the log.  arrival_us: its stamp, None where it has none (or no plausible one)."""
        if frame.definition is None:
            return  # its CRC could not be checked: nothing in it is believed
        if arrival_us is not None:
            self._arrival_s = arrival_us / 1e6
        if self._waiting is None:
            self._judge(frame, self._arrival_s)
            return
        self._waiting.append((frame, self._arrival_s))
        if self.flight.sysid is None and frame.name == "HEARTBEAT":
            self._offer(frame)
        if math.isnan(self._waiting_since_s):
            self._waiting_since_s = self._arrival_s
        own = (frame.sysid, frame.compid) == (self.flight.sysid, self.flight.compid)
        clocked = own and "time_boot_ms" in frame.definition.fields
        late = len(self._waiting) >= WAIT_FRAMES or abs(self._arrival_s - self._waiting_since_s) > WAIT_S
        if clocked or late:
            self._release()

    def _offer(self, frame: Frame) -> None:
        beat = frame.fields()
        kind, autopilot = int(number(beat, "type")), int(number(beat, "autopilot"))
        if autopilot == mavlink.MAV_AUTOPILOT_INVALID or kind in NO_VEHICLE:
            return
        if self.sysid is None or self.sysid == frame.sysid:
            flight = self.flight
            flight.sysid, flight.compid, flight.type, flight.autopilot = frame.sysid, frame.compid, kind, autopilot

    def _release(self) -> None:
        """Judge what was kept back; what came before the vehicle's first stamp gets the time counted back from there."""
        waiting, self._waiting = self._waiting or [], None
        arrivals = [arrival_s for _, arrival_s in waiting if math.isfinite(arrival_s)]
        for frame, arrival_s in waiting:
            if frame.sysid == self.flight.sysid and frame.compid == self.flight.compid:
                stamp = frame.fields().get("time_boot_ms")
                if isinstance(stamp, int) and stamp > 0:
                    self.clock.expect(stamp / 1e3, arrival_s - arrivals[0] if math.isfinite(arrival_s) else 0.0)
                    break
        for frame, arrival_s in waiting:
            self._judge(frame, arrival_s)

    def _judge(self, frame: Frame, arrival_s: float) -> None:
        flight = self.flight
        message = frame.definition
        assert message is not None  # `take` lets no other in
        name = message.name
        flight.arrival_s = arrival_s
        if flight.sysid is None and name == "HEARTBEAT":
            self._offer(frame)
        ours = frame.sysid == flight.sysid and frame.compid == flight.compid
        units = self._needed.get(name) if ours else None
        fields = NOTHING
        if units is not None or (ours and name in OWN):
            fields = _fields(frame, message)
            self._heard.add(name)
        flight.t_s = t_s = self.clock.take(fields, arrival_s, flight.armed) if ours else self._time(arrival_s)
        flight.clocked = self.clock.started
        flight.boot = len(self.clock.jumps)
        if fields and name in OWN:
            self._own(name, fields)
        for unit in self._every:
            unit.take(name, NOTHING, t_s, frame)
        for unit in units or ():
            unit.take(name, fields, t_s, frame)

    def _time(self, arrival_s: float) -> float:
        """The vehicle's clock when somebody else speaks."""
        return self.clock.take(NOTHING, arrival_s, self.flight.armed)

    def _own(self, name: str, fields: Fields) -> None:
        flight = self.flight
        if name == "HEARTBEAT":
            if number(fields, "autopilot") == flight.autopilot and number(fields, "type") == flight.type:
                flight.beat(fields)  # a beat of another kind under the same id is not the vehicle's
        elif name == "VFR_HUD":
            flight.ground_speed_m_s = number(fields, "groundspeed")
        elif name == "GLOBAL_POSITION_INT":
            flight.height_m = number(fields, "relative_alt") / 1e3
        elif name == "EXTENDED_SYS_STATE":
            flight.landed_state = int(number(fields, "landed_state"))

    def finish(self) -> list[Finding]:
        """What was found, one finding a check, in the order of the table."""
        if self._waiting is not None:
            self._release()
        self.flight.disarm(self.flight.t_s)
        return [self._finding(check, unit) for check, unit in self._units]

    def _finding(self, check: Check, unit: Unit) -> Finding:
        result = self._result(check, unit)
        if self.clock.started:
            return Finding(check.id, result.status, result.text, result.t, result.spans)
        return Finding(check.id, result.status, result.text)

    def _result(self, check: Check, unit: Unit) -> Result:
        if EVERY_FRAME in check.needs:
            return unit.finish()
        if self.flight.sysid is None:
            return absent("no autopilot's HEARTBEAT")
        for names in check.needs:
            if not any(name in self._heard for name in names.split("|")):
                return absent(f"no {names.replace('|', ' or ')} message")
        return unit.finish()


def worst(findings: list[Finding]) -> Status:
    """The gravest status of all; NOT_AVAILABLE if nothing could be judged."""
    order = (Status.FAULT, Status.WARNING, Status.OK)
    return next((status for status in order if any(finding.status is status for finding in findings)), Status.NOT_AVAILABLE)
