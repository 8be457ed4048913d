"""GPS: fix, satellites, accuracies, and the position against the velocity of the same receiver."""

import math
from dataclasses import dataclass, field
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from companion.checks.finding import (
    Check,
    Held,
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
from companion.dialect import Fields
from companion.frames import Frame

UINT8_MAX: Final = 255.0
UINT16_MAX: Final = 65535.0
FIX_3D: Final = mavlink.GPS_FIX_TYPE_3D_FIX
NO_GPS: Final = mavlink.GPS_FIX_TYPE_NO_GPS
METRES_A_DEGREE: Final = 111_319.5  # of latitude, WGS 84 equatorial radius times pi / 180
HOLD_S: Final = 5.0
STILL_M_S: Final = 0.5  # below, a receiver states no course
SLOWEST_S: Final = 1.2  # samples further apart cannot be joined by a straight line while a vehicle turns
LONGEST_STEP_S: Final = 2.5
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


@dataclass(slots=True)
class Satellites:
    """Check `gps_satellites`: fewer than enough while armed."""

    check: Check
    flight: Flight
    _held: Held = field(default_factory=lambda: Held(HOLD_S))
    _least: float = math.inf

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        seen = known(number(fields, "satellites_visible"), UINT8_MAX)
        if not self.flight.armed or math.isnan(seen) or number(fields, "fix_type") < FIX_3D:
            self._held.stop()
            return
        self._least = min(self._least, seen)
        self._held.take(t_s, seen < self.check.limit)

    def finish(self) -> Result:
        if not self._held.samples:
            return absent("no satellite count with a 3D fix while armed")
        spans = self._held.spans()
        if spans:
            return found(self.check, f"down to {self._least:.0f}, {total_s(spans):.0f} s in all", spans)
        return fine(f"{self._least:.0f} or more")


@dataclass(slots=True)
class Hdop:
    """Check `gps_hdop`: the geometry of the satellites is bad while armed."""

    check: Check
    flight: Flight
    _held: Held = field(default_factory=lambda: Held(HOLD_S))
    _worst: float = 0.0

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        hdop = known(number(fields, "eph"), UINT16_MAX) / 100.0
        if not self.flight.armed or not 0.0 < hdop < 99.0 or number(fields, "fix_type") < FIX_3D:
            self._held.stop()
            return
        self._worst = max(self._worst, hdop)
        self._held.take(t_s, hdop > self.check.limit)

    def finish(self) -> Result:
        if not self._held.samples:
            return absent("no HDOP with a 3D fix while armed")
        spans = self._held.spans()
        if spans:
            return found(self.check, f"up to {self._worst:.1f}, {total_s(spans):.0f} s in all", spans)
        return fine(f"at most {self._worst:.1f}")


@dataclass(slots=True)
class Accuracy:
    """Check `gps_accuracy`: the receiver's own estimate of its horizontal error; its speed error is told beside it."""

    check: Check
    flight: Flight
    _held: Held = field(default_factory=lambda: Held(HOLD_S))
    _worst_m: float = 0.0
    _worst_m_s: float = 0.0

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        error_m = number(fields, "h_acc") / 1e3  # 0: not sent (MAVLink 1, or an extension field cut off)
        if not self.flight.armed or error_m <= 0.0 or number(fields, "fix_type") < FIX_3D:
            self._held.stop()
            return
        self._worst_m = max(self._worst_m, error_m)
        self._worst_m_s = max(self._worst_m_s, number(fields, "vel_acc") / 1e3)
        self._held.take(t_s, error_m > self.check.limit)

    def finish(self) -> Result:
        if not self._held.samples:
            return absent("the receiver states no accuracy while armed")
        told = f"position to {self._worst_m:.1f} m, speed to {self._worst_m_s:.1f} m/s"
        spans = self._held.spans()
        return found(self.check, f"{told}, {total_s(spans):.0f} s in all", spans) if spans else fine(told)


@dataclass(frozen=True, slots=True)
class _Sample:
    stamp_us: float
    t_s: float
    latitude_deg: float
    longitude_deg: float
    velocity_north_m_s: float
    velocity_east_m_s: float


@dataclass(slots=True)
class Steps:
    """From GPS_RAW_INT to what the position did beyond the receiver's own velocity, step by step.

    `take` -> (t_s, dt_s, north_m, east_m), None where two samples cannot be compared.
    """

    _last: _Sample | None = None

    def take(self, fields: Fields, t_s: float) -> tuple[float, float, float, float] | None:
        speed_m_s = known(number(fields, "vel"), UINT16_MAX) / 100.0
        course_deg = known(number(fields, "cog"), UINT16_MAX) / 100.0
        if math.isnan(course_deg) and speed_m_s < STILL_M_S:
            course_deg = 0.0
        if number(fields, "fix_type") < FIX_3D or math.isnan(speed_m_s + course_deg):
            self._last = None
            return None
        course_rad = math.radians(course_deg)
        new = _Sample(
            number(fields, "time_usec"),
            t_s,
            number(fields, "lat") * 1e-7,
            number(fields, "lon") * 1e-7,
            speed_m_s * math.cos(course_rad),
            speed_m_s * math.sin(course_rad),
        )
        old = self._last
        if old is not None and new.stamp_us == old.stamp_us and new.stamp_us > 0.0:
            return None  # the stream is faster than the receiver
        self._last = new
        if old is None:
            return None
        dt_s = new.t_s - old.t_s
        own_s = (new.stamp_us - old.stamp_us) / 1e6
        if own_s > 0.0 and abs(own_s - dt_s) < 1.5:
            dt_s = own_s
        if not 0.0 < dt_s <= LONGEST_STEP_S:
            return None
        east_scale = METRES_A_DEGREE * math.cos(math.radians(new.latitude_deg))
        north_m = (new.latitude_deg - old.latitude_deg) * METRES_A_DEGREE
        east_m = (new.longitude_deg - old.longitude_deg) * east_scale
        north_m -= 0.5 * (new.velocity_north_m_s + old.velocity_north_m_s) * dt_s
        east_m -= 0.5 * (new.velocity_east_m_s + old.velocity_east_m_s) * dt_s
        return t_s, dt_s, north_m, east_m


@dataclass(slots=True)
class Jump:
    """Check `gps_jump`: one step of the position that the velocity does not explain."""

    check: Check
    flight: Flight
    _steps: Steps = field(default_factory=Steps)
    _largest_m: float = 0.0
    _samples: int = 0
    _spans: list[Span] = field(default_factory=list)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        step = self._steps.take(fields, t_s)
        if step is None or not self.flight.armed:
            return
        self._samples += 1
        size_m = math.hypot(step[2], step[3])
        self._largest_m = max(self._largest_m, size_m)
        if size_m > self.check.limit:
            self._spans.append((t_s - step[1], t_s))

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
    _steps: Steps = field(default_factory=Steps)
    _start_s: float | None = None
    _length_s: float = 0.0
    _north_m: float = 0.0
    _east_m: float = 0.0
    _worst_m_s: float = 0.0
    _windows: int = 0
    _spans: list[Span] = field(default_factory=list)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        step = self._steps.take(fields, t_s)
        if step is None:
            return
        if not self.flight.armed or step[1] > SLOWEST_S:
            self._start_s = None
            return
        if math.hypot(step[2], step[3]) > self.jump_m:
            return
        if self._start_s is None or not 0.0 <= t_s - self._start_s < 1.5 * DRIFT_S:
            self._start_s, self._length_s, self._north_m, self._east_m = t_s - step[1], 0.0, 0.0, 0.0
        self._length_s += step[1]
        self._north_m += step[2]
        self._east_m += step[3]
        if self._length_s >= DRIFT_S:
            self._close(t_s)

    def _close(self, t_s: float) -> None:
        assert self._start_s is not None
        drift_m_s = math.hypot(self._north_m, self._east_m) / self._length_s
        self._windows += 1
        self._worst_m_s = max(self._worst_m_s, drift_m_s)
        if drift_m_s > self.check.limit:
            if self._spans and self._start_s - self._spans[-1][1] < 2.0 * SLOWEST_S:
                self._spans[-1] = (self._spans[-1][0], t_s)
            else:
                self._spans.append((self._start_s, t_s))
        self._start_s = None

    def finish(self) -> Result:
        if not self._windows:
            return absent(
                f"no {DRIFT_S:.0f} s of GPS positions and velocities, {1.0 / SLOWEST_S:.1f} a second or more, while armed"
            )
        if self._spans:
            return found(self.check, f"by {self._worst_m_s:.2f} m/s", tuple(self._spans))
        return fine(f"at most {self._worst_m_s:.2f} m/s apart")
