"""GPS: fix, satellites, accuracies, and the position against the velocity of the same receiver."""

import math
from dataclasses import dataclass, field
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from companion.checks.finding import (
    Check,
    Excess,
    Held,
    Joined,
    Result,
    Span,
    Status,
    absent,
    fine,
    found,
    known,
    number,
    total_s,
)
from companion.checks.flight import Flight
from companion.checks.level import Level
from companion.checks.reading import FIX_3D, UINT16_MAX
from companion.dialect import Fields
from companion.frames import Frame

UINT8_MAX: Final = 255.0
NO_GPS: Final = mavlink.GPS_FIX_TYPE_NO_GPS
SLOWEST_S: Final = 1.2  # samples further apart cannot be joined by a straight line while a vehicle turns
DRIFT_S: Final = 30.0


@dataclass(slots=True)
class Fix:
    """Check `gps_fix`: the 3D fix was there and went while armed; a fault if the receiver itself is gone."""

    check: Check
    flight: Flight
    _held: Held = field(init=False)
    _gone: Held = field(init=False)
    _had: bool = False
    _seen: int = 0

    def __post_init__(self) -> None:
        self._held = Held(self.check.limit)
        self._gone = Held(self.check.limit)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        fix = number(fields, "fix_type")
        self._had |= fix >= FIX_3D
        if not self.flight.armed:
            self._held.stop()
            self._gone.stop()
            return
        if self._had:
            self._held.take(t_s, fix < FIX_3D)
            self._gone.take(t_s, fix == NO_GPS)

    def finish(self) -> Result:
        if not self._had:
            return absent("never a 3D fix")
        if not self._held.samples:
            return absent("no GPS message while armed")
        spans = self._held.spans()
        if not spans:
            return fine("3D fix kept")
        gone = self._gone.spans()
        told = f"{len(spans)} time(s), {total_s(spans):.0f} s in all" + (", the receiver itself is silent" if gone else "")
        return found(self.check, told, spans, Status.FAULT if gone else Status.WARNING)


def fixed(fields: Fields, value: float) -> float:
    """NaN where the receiver has no 3D fix."""
    return value if number(fields, "fix_type") >= FIX_3D else math.nan


def satellites(check: Check, flight: Flight) -> Level:
    """Check `gps_satellites`: fewer than enough while armed."""
    return Level(
        check,
        flight,
        lambda fields: fixed(fields, known(number(fields, "satellites_visible"), UINT8_MAX)),
        "no satellite count with a 3D fix while armed",
        "down to {farthest:.0f}, {lasted_s:.0f} s in all",
        "{farthest:.0f} or more",
        below=True,
    )


def hdop(check: Check, flight: Flight) -> Level:
    """Check `gps_hdop`: the geometry of the satellites is bad while armed."""

    def read(fields: Fields) -> float:
        told = known(number(fields, "eph"), UINT16_MAX) / 100.0
        return fixed(fields, told) if 0.0 < told < 99.0 else math.nan

    words = ("no HDOP with a 3D fix while armed", "up to {farthest:.1f}, {lasted_s:.0f} s in all", "at most {farthest:.1f}")
    return Level(check, flight, read, *words)


@dataclass(slots=True)
class Accuracy:
    """Check `gps_accuracy`: the receiver's own estimate of its horizontal error; its speed error is told beside it."""

    check: Check
    flight: Flight
    _error_m: Excess = field(init=False)
    _worst_m_s: float = 0.0

    def __post_init__(self) -> None:
        self._error_m = Excess(self.check.limit)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        error_m = fixed(fields, number(fields, "h_acc") / 1e3) if self.flight.armed else math.nan
        judged = error_m > 0.0  # 0: not sent (MAVLink 1, or an extension field cut off)
        if judged:
            self._worst_m_s = max(self._worst_m_s, number(fields, "vel_acc") / 1e3)
        self._error_m.take(t_s, error_m if judged else math.nan)

    def finish(self) -> Result:
        told = f"position to {{farthest:.1f}} m, speed to {self._worst_m_s:.1f} m/s"
        beyond = told + ", {lasted_s:.0f} s in all"
        return self._error_m.result(self.check, "the receiver states no accuracy while armed", beyond, told)


@dataclass(slots=True)
class Jump:
    """Check `gps_jump`: one step of the position that the velocity does not explain."""

    check: Check
    flight: Flight
    _largest_m: float = 0.0
    _samples: int = 0
    _spans: list[Span] = field(default_factory=list)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        step = self.flight.gps_step
        if step is None or not self.flight.armed:
            return
        self._samples += 1
        size_m = math.hypot(step.north_m, step.east_m)
        self._largest_m = max(self._largest_m, size_m)
        if size_m > self.check.limit:
            self._spans.append((t_s - step.dt_s, t_s))

    def finish(self) -> Result:
        if not self._samples:
            return absent("no two GPS positions with velocity in a row while armed")
        if self._spans:
            return found(self.check, f"{len(self._spans)} time(s), largest {self._largest_m:.0f} m", tuple(self._spans))
        return fine(f"largest step {self._largest_m:.1f} m")


@dataclass(slots=True)
class Drift:
    """Check `gps_drift`: the position goes where the velocity, summed over half a minute, does not.

    A position held false (spoofed, reflected) or a velocity read false both show here; single steps belong to `gps_jump`.
    """

    check: Check
    flight: Flight
    jump_m: float = 10.0  # a step that is a jump is left out
    _start_s: float | None = None
    _length_s: float = 0.0
    _north_m: float = 0.0
    _east_m: float = 0.0
    _worst_m_s: float = 0.0
    _windows: int = 0
    _beyond: Joined = field(default_factory=lambda: Joined(2.0 * SLOWEST_S))

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        step = self.flight.gps_step
        if step is None:
            return
        if not self.flight.armed or step.dt_s > SLOWEST_S:
            self._start_s = None
            return
        if math.hypot(step.north_m, step.east_m) > self.jump_m:
            return
        if self._start_s is None or not 0.0 <= t_s - self._start_s < 1.5 * DRIFT_S:
            self._start_s, self._length_s, self._north_m, self._east_m = t_s - step.dt_s, 0.0, 0.0, 0.0
        self._length_s += step.dt_s
        self._north_m += step.north_m
        self._east_m += step.east_m
        if self._length_s >= DRIFT_S:
            drift_m_s = math.hypot(self._north_m, self._east_m) / self._length_s
            self._windows += 1
            self._worst_m_s = max(self._worst_m_s, drift_m_s)
            if drift_m_s > self.check.limit:
                self._beyond.add(self._start_s, t_s)
            self._start_s = None

    def finish(self) -> Result:
        if not self._windows:
            return absent(
                f"no {DRIFT_S:.0f} s of GPS positions and velocities, {1.0 / SLOWEST_S:.1f} a second or more, while armed"
            )
        if self._beyond.spans:
            return found(self.check, f"by {self._worst_m_s:.2f} m/s", tuple(self._beyond.spans))
        return fine(f"at most {self._worst_m_s:.2f} m/s apart")
