"""The autopilot's estimator: how far it distrusts its sensors, and what it no longer claims to know."""

import math
from dataclasses import dataclass, field
from typing import Final

from companion.checks.finding import Check, Held, Result, Span, absent, fine, found, number, total_s
from companion.checks.flight import Flight
from companion.dialect import Fields
from companion.frames import Frame

HOLD_S: Final = 1.0
RATIO_LIMIT: Final = 1.0  # of ESTIMATOR_STATUS: beyond it the sample was rejected (MAVLink, ESTIMATOR_STATUS)

# field -> what is distrusted, message by message
VARIANCES: Final = {
    "EKF_STATUS_REPORT": {
        "velocity_variance": "velocity",
        "pos_horiz_variance": "position",
        "pos_vert_variance": "height",
        "compass_variance": "compass",
        "airspeed_variance": "airspeed",
    },
    "ESTIMATOR_STATUS": {
        "vel_ratio": "velocity",
        "pos_horiz_ratio": "position",
        "pos_vert_ratio": "height",
        "mag_ratio": "compass",
        "tas_ratio": "airspeed",
    },
}

CONSTANT_POSITION: Final = 128
POSITION: Final = 8 | 16  # horizontal, relative and absolute

CLAIMS: Final = {  # both messages use the same bits (EKF_STATUS_FLAGS, ESTIMATOR_STATUS_FLAGS)
    1: "attitude",
    2: "horizontal velocity",
    4: "vertical velocity",
    16: "horizontal position",
    32: "height",
}
TROUBLES: Final = {
    "EKF_STATUS_REPORT": {CONSTANT_POSITION: "constant position mode", 1024: "not initialised", 32768: "GPS glitch"},
    "ESTIMATOR_STATUS": {CONSTANT_POSITION: "constant position mode", 1024: "GPS glitch", 2048: "accelerometer error"},
}


@dataclass(slots=True)
class Variances:
    """Check `ekf_variance`: innovations beyond what the estimator believes, for a second or more while armed."""

    check: Check
    flight: Flight
    _held: dict[str, Held] = field(default_factory=dict)
    _worst: dict[str, float] = field(default_factory=dict)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        limit = self.check.limit if name == "EKF_STATUS_REPORT" else RATIO_LIMIT
        for field_name, what in VARIANCES[name].items():
            held = self._held.get(what)
            if held is None:
                held = self._held[what] = Held(HOLD_S)
            value = number(fields, field_name)
            if not self.flight.armed or not math.isfinite(value):
                held.stop()
                continue
            held.take(t_s, value > limit, value)
            if value > self._worst.get(what, 0.0):
                self._worst[what] = value

    def finish(self) -> Result:
        if not any(held.samples for held in self._held.values()):
            return absent("no estimator status while armed")
        bad = {what: held.spans() for what, held in self._held.items()}
        parts = [f"{what} {self._held[what].worst:.1f} for {total_s(spans):.0f} s" for what, spans in bad.items() if spans]
        if parts:
            return found(self.check, ", ".join(parts), tuple(sorted(span for spans in bad.values() for span in spans)))
        worst = max(self._worst, key=lambda what: self._worst[what], default="")
        return fine(f"largest {self._worst[worst]:.2f} ({worst})" if worst else "all zero")


@dataclass(slots=True)
class Flags:
    """Check `ekf_flags`: the estimator had claimed to know something and withdrew it, or reports trouble, while armed."""

    check: Check
    flight: Flight
    _claimed: int = 0
    _held: dict[str, Held] = field(default_factory=dict)
    _samples: int = 0

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        flags = int(number(fields, "flags"))
        if not self.flight.armed:
            self._claimed = 0
            for held in self._held.values():
                held.stop()
            return
        self._samples += 1
        for bit, what in CLAIMS.items():
            self._hold(f"{what} lost", t_s, bool(self._claimed & bit and not flags & bit))
        for bit, what in TROUBLES[name].items():
            # A vehicle that never had a position (indoors, under water) is in this mode by right.
            judged = self._claimed & POSITION if bit == CONSTANT_POSITION else self._claimed
            self._hold(what, t_s, bool(flags & bit and judged))
        self._claimed |= flags

    def _hold(self, what: str, t_s: float, stands: bool) -> None:
        if what not in self._held:
            self._held[what] = Held(self.check.limit)
        self._held[what].take(t_s, stands)

    def finish(self) -> Result:
        if not self._samples:
            return absent("no estimator status while armed")
        bad: dict[str, tuple[Span, ...]] = {what: held.spans() for what, held in self._held.items()}
        parts = [f"{what} for {total_s(spans):.0f} s" for what, spans in bad.items() if spans]
        if parts:
            return found(self.check, ", ".join(parts), tuple(sorted(span for spans in bad.values() for span in spans)))
        return fine("nothing withdrawn")
