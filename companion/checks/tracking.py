"""Does the attitude follow its command?"""

import math
from dataclasses import dataclass, field
from typing import Final

from companion.checks.finding import Check, Held, Result, absent, fine, found, number, total_s
from companion.checks.flight import Flight
from companion.dialect import Fields
from companion.frames import Frame

HOLD_S: Final = 3.0  # longer than rolling into a turn takes
FRESH_S: Final = 0.6
IGNORE_ATTITUDE: Final = 128  # ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE


@dataclass(slots=True)
class Tracking:
    """Check `attitude_tracking`: roll and pitch against what the autopilot commands, in the air."""

    check: Check
    flight: Flight
    _attitude: tuple[float, float, float] | None = None  # t_s, roll and pitch in degrees
    _roll: Held = field(default_factory=lambda: Held(HOLD_S))
    _pitch: Held = field(default_factory=lambda: Held(HOLD_S))

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if name == "ATTITUDE":
            self._attitude = (t_s, math.degrees(number(fields, "roll")), math.degrees(number(fields, "pitch")))
            return
        if not self.flight.airborne or not (self.flight.fixed_wing or self.flight.rotors):
            self._roll.stop()
            self._pitch.stop()
            return
        wanted = self._from_target(fields) if name == "ATTITUDE_TARGET" else self._from_navigation(fields)
        if self._attitude is None or wanted is None or not 0.0 <= t_s - self._attitude[0] < FRESH_S:
            return
        for held, want_deg, is_deg in zip((self._roll, self._pitch), wanted, self._attitude[1:], strict=True):
            error_deg = abs((want_deg - is_deg + 180.0) % 360.0 - 180.0)
            if math.isfinite(error_deg):
                held.take(t_s, error_deg > self.check.limit, error_deg)

    @staticmethod
    def _from_navigation(fields: Fields) -> tuple[float, float]:
        return number(fields, "nav_roll"), number(fields, "nav_pitch")

    @staticmethod
    def _from_target(fields: Fields) -> tuple[float, float] | None:
        q = fields["q"]
        assert isinstance(q, tuple)
        w, x, y, z = q
        length = math.sqrt(w * w + x * x + y * y + z * z)
        if int(number(fields, "type_mask")) & IGNORE_ATTITUDE or not 0.9 < length < 1.1:
            return None
        roll_rad = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        pitch_rad = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
        return math.degrees(roll_rad), math.degrees(pitch_rad)

    def finish(self) -> Result:
        if not self._roll.samples:
            return absent("no commanded attitude with a measured one beside it in the air")
        parts = []
        roll, pitch = self._roll.spans(), self._pitch.spans()
        for what, held, spans in (("roll", self._roll, roll), ("pitch", self._pitch, pitch)):
            if spans:
                parts.append(f"{what} by up to {held.worst:.0f} deg, {total_s(spans):.0f} s in all")
        return found(self.check, ", ".join(parts), tuple(sorted(roll + pitch))) if parts else fine("follows")
