"""Vibration of the accelerometers, and how often they were driven to the end of their range."""

import math
from dataclasses import dataclass, field
from typing import Final

from companion.checks.finding import Check, Held, Result, Span, absent, fine, found, number, total_s
from companion.checks.flight import Flight
from companion.dialect import Fields
from companion.frames import Frame

HOLD_S: Final = 5.0
AXES: Final = ("vibration_x", "vibration_y", "vibration_z")
COUNTERS: Final = ("clipping_0", "clipping_1", "clipping_2")


@dataclass(slots=True)
class Vibration:
    """Check `vibration`: the level of the worst axis while armed."""

    check: Check
    flight: Flight
    _held: Held = field(default_factory=lambda: Held(HOLD_S))
    _worst_m_s2: float = 0.0

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        level_m_s2 = max(number(fields, axis) for axis in AXES)
        if not self.flight.armed or not math.isfinite(level_m_s2):
            self._held.stop()
            return
        self._worst_m_s2 = max(self._worst_m_s2, level_m_s2)
        self._held.take(t_s, level_m_s2 > self.check.limit)

    def finish(self) -> Result:
        if not self._held.samples:
            return absent("no VIBRATION message while armed")
        spans = self._held.spans()
        if spans:
            return found(self.check, f"up to {self._worst_m_s2:.0f} m/s2, {total_s(spans):.0f} s in all", spans)
        return fine(f"at most {self._worst_m_s2:.1f} m/s2")


@dataclass(slots=True)
class Clipping:
    """Check `clipping`: how often accelerometers clipped while armed; the counters count from boot."""

    check: Check
    flight: Flight
    _last: dict[str, float] = field(default_factory=dict)
    _clips: dict[str, float] = field(default_factory=dict)
    _spans: list[Span] = field(default_factory=list)

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
                if self._spans and t_s - self._spans[-1][1] < HOLD_S:
                    self._spans[-1] = (self._spans[-1][0], max(t_s, self._spans[-1][1]))
                else:
                    self._spans.append((t_s, t_s))

    def finish(self) -> Result:
        if not self._clips:
            return absent("no two VIBRATION messages while armed")
        told = ", ".join(
            f"accelerometer {place + 1}: {self._clips.get(name, 0.0):.0f}" for place, name in enumerate(COUNTERS)
        )
        if max(self._clips.values()) > self.check.limit:
            return found(self.check, told, tuple(self._spans))
        return fine(f"{max(self._clips.values()):.0f} times at most")
