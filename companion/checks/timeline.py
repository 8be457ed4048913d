"""What happened, told and not judged: who is in the log, when it was armed, in which modes it was."""

from dataclasses import dataclass, field
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from companion.checks.finding import Check, Result, Span, Status, absent, total_s
from companion.checks.flight import Flight
from companion.checks.link import named
from companion.dialect import Fields
from companion.frames import Frame
from companion.vehicle import NO_VEHICLE, heartbeat

MODES_TOLD: Final = 12


@dataclass(slots=True)
class Vehicles:
    """Check `vehicles`: the autopilots heard, and which of them is judged."""

    check: Check
    flight: Flight
    _autopilots: dict[tuple[int, int], tuple[int, int]] = field(default_factory=dict)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        beat = heartbeat(frame)
        if beat.autopilot != mavlink.MAV_AUTOPILOT_INVALID and beat.type not in NO_VEHICLE:
            self._autopilots.setdefault((beat.sysid, beat.compid), (beat.type, beat.autopilot))

    def finish(self) -> Result:
        if self.flight.sysid is None or self.flight.compid is None:
            return absent("no autopilot's HEARTBEAT")
        judged = (self.flight.sysid, self.flight.compid)
        others = [named(source) for source in self._autopilots if source != judged]
        told = f"{named(judged)} is judged" + (f"; also there, not judged: {', '.join(others)}" if others else "")
        return Result(Status.OK, told)


@dataclass(slots=True)
class Arming:
    """Check `arming`: while it was armed."""

    check: Check
    flight: Flight

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None: ...

    def finish(self) -> Result:
        spans: tuple[Span, ...] = tuple(self.flight.armed_spans)
        if not spans:
            return Result(Status.OK, "never armed")
        return Result(Status.OK, f"armed {len(spans)} time(s), {total_s(spans):.0f} s in all", spans[0][0], spans)


@dataclass(slots=True)
class Modes:
    """Check `modes`: the flight modes in their order."""

    check: Check
    flight: Flight

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None: ...

    def finish(self) -> Result:
        modes = self.flight.modes
        told = ", ".join(f"{name} at {t_s:.0f} s" for t_s, name in modes[:MODES_TOLD])
        more = f" and {len(modes) - MODES_TOLD} more" if len(modes) > MODES_TOLD else ""
        return Result(Status.OK, told + more if modes else "none told", modes[0][0] if modes else None)
