"""Vibration of the accelerometers, and how often they were driven to the end of their range."""

import math
from dataclasses import dataclass, field
from typing import Final

from companion.checks.finding import HOLD_S, Check, Joined, Result, absent, fine, found, number
from companion.checks.flight import Flight
from companion.checks.level import Level
from companion.dialect import Fields
from companion.frames import Frame

AXES: Final = ("vibration_x", "vibration_y", "vibration_z")
COUNTERS: Final = ("clipping_0", "clipping_1", "clipping_2")


def vibration(check: Check, flight: Flight) -> Level:
    """Check `vibration`: the level of the worst axis while armed."""

    def read(fields: Fields) -> float:
        level_m_s2 = max(number(fields, axis) for axis in AXES)
        return level_m_s2 if math.isfinite(level_m_s2) else math.nan

    beyond = "up to {farthest:.0f} m/s2, {lasted_s:.0f} s in all"
    return Level(check, flight, read, "no VIBRATION message while armed", beyond, "at most {farthest:.1f} m/s2")


@dataclass(slots=True)
class Clipping:
    """Check `clipping`: how often accelerometers clipped while armed; the counters count from boot."""

    check: Check
    flight: Flight
    _last: dict[str, float] = field(default_factory=dict)
    _clips: dict[str, float] = field(default_factory=dict)
    _clipped: Joined = field(default_factory=lambda: Joined(HOLD_S))

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        for counter in COUNTERS:
            now = number(fields, counter)
            before = self._last.get(counter)
            self._last[counter] = now
            if before is None or not self.flight.armed:
                continue
            more = now - before
            self._clips[counter] = self._clips.get(counter, 0.0) + max(0.0, more)
            if more > 0.0:
                self._clipped.add(t_s, t_s)

    def finish(self) -> Result:
        if not self._clips:
            return absent("no two VIBRATION messages while armed")
        told = ", ".join(
            f"accelerometer {place + 1}: {self._clips.get(name, 0.0):.0f}" for place, name in enumerate(COUNTERS)
        )
        if max(self._clips.values()) > self.check.limit:
            return found(self.check, told, tuple(self._clipped.spans))
        return fine(f"{max(self._clips.values()):.0f} times at most")
