"""Gyros and accelerometers: against each other, against the estimator, against the motion, and frozen.

What is compared is the change within the flight: a constant bias belongs to the sensor and is the autopilot's to calibrate.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Final

import numpy as np

from companion.checks.finding import Check, Held, Means, Result, Span, Status, absent, change, fine, found, median, number
from companion.checks.flight import Flight
from companion.checks.reading import ACCELERATION, ANGLES, GYRO, RATES, STANDARD_GRAVITY_M_S2, Imu, Triple
from companion.checks.series import Series, between, body_to_ned, overlapping, slope, unwrapped, windowed
from companion.dialect import Fields
from companion.frames import Frame

TOGETHER_S: Final = 0.05  # samples of two sensors nearer than this are of one moment
BIAS_WINDOW_S: Final = 20.0
MOTION_WINDOW_S: Final = 30.0
MOTION_HOP_S: Final = 10.0
MOTION_REFERENCES: Final = 9
ATTITUDE_GAP_S: Final = 0.6
MOTION_GAP_S: Final = 0.35  # of the attitude: thinner streams turn the force of a bend into the wrong axis
VELOCITY_GAP_S: Final = 0.6  # a thinner stream misses what happens in turns
FROZEN_SAMPLES: Final = 10
TURNED_RAD: Final = 0.1
AXES: Final = "xyz"


@dataclass(frozen=True, slots=True)
class Quantity:
    """What two sensors are compared in.

    of: its part of a message.  least: windows of window_s without which nothing is judged; run: so many in a row are a
    drift and no knock.  apart: farthest that they may be from each other throughout.
    """

    of: Callable[[Imu], Triple | None]
    size: str  # how a change is said
    together: str
    nothing: str = "no two sensors side by side for a minute under way"
    window_s: float = 10.0
    least: int = 6
    run: int = 3
    apart: float = math.inf
    apart_unit: str = ""


# Throughout: ArduPilot's pre-arm limits, 5 deg/s for gyros, ARMING_ACCTHRESH 0.75 m/s2.
GYROS: Final = Quantity(
    attrgetter("gyro_rad_s"),
    "{size:.3f} rad/s about {axis}",
    "{count} sensors stay together",
    apart=0.0873,
    apart_unit="rad/s",
)
ACCELEROMETERS: Final = Quantity(
    attrgetter("acceleration_m_s2"),
    "{size:.3f} m/s2 along {axis}",
    "{count} sensors stay together",
    apart=0.75,
    apart_unit="m/s2",
)
COMPASSES: Final = Quantity(
    attrgetter("field_mg"),
    "{size:.0f} mG along {axis}",
    "stay together",
    "no two compasses side by side for two minutes under way",
    window_s=20.0,
    least=5,
    run=2,
)


@dataclass(slots=True)
class Pair:
    """Checks `gyro_pair`, `accelerometer_pair`, `compass_pair`: two sensors of one kind drift apart while under way."""

    check: Check
    flight: Flight
    quantity: Quantity
    _first: tuple[float, Triple] | None = None
    _first_name: str = ""
    _others: dict[int, Means] = field(default_factory=dict)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        imu = self.flight.imu
        if imu is None or (value := self.quantity.of(imu)) is None:
            return
        if imu.instance == 0:
            if self._first_name in ("", name):
                self._first_name = name
                self._first = (t_s, value)
            return
        if self._first is None or abs(t_s - self._first[0]) > TOGETHER_S:
            return
        if imu.instance not in self._others:
            self._others[imu.instance] = Means(self.quantity.window_s)
        one = self._first[1]
        self._others[imu.instance].take(t_s, (one[0] - value[0], one[1] - value[1], one[2] - value[2]))

    def finish(self) -> Result:
        kind = self.quantity
        judged = {instance: means.windows for instance, means in self._others.items() if len(means.windows) >= kind.least}
        if not judged:
            return absent(kind.nothing)
        told: list[str] = []
        standing: list[str] = []
        spans: list[Span] = []
        for instance, windows in judged.items():
            moved = change(windows, self.check.limit, run=kind.run)
            assert moved is not None  # `least` windows are enough
            if moved.spans:
                told.append(f"1 and {instance + 1} by {kind.size.format(size=moved.size, axis=AXES[moved.column])}")
                spans += moved.spans
            apart = math.hypot(*(median([window.mean[c] for window in windows]) for c in range(3)))
            if apart > kind.apart:
                standing.append(f"1 and {instance + 1} by {apart:.3f} {kind.apart_unit} throughout")
        if told:
            return found(self.check, ", ".join(told), tuple(sorted(spans)))
        if standing:
            return found(self.check, ", ".join(standing), (), Status.WARNING)
        return fine(kind.together.format(count=len(judged) + 1))


@dataclass(slots=True)
class _Repeat:
    """A sensor's newest sample, since when it has been the same, and how far the vehicle had turned by then."""

    value: Triple | None = None
    since_s: float = 0.0
    turned_rad: float = 0.0
    count: int = 0
    held: Held = field(default_factory=lambda: Held(0.0))


@dataclass(slots=True)
class Frozen:
    """Check `imu_frozen`: a sensor repeats one sample for seconds while the attitude changes."""

    check: Check
    flight: Flight
    _repeats: dict[int, tuple[_Repeat, _Repeat]] = field(default_factory=dict)
    _turned_rad: float = 0.0  # summed changes of attitude
    _attitude: Triple | None = None

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if name == "ATTITUDE":
            attitude = (number(fields, "roll"), number(fields, "pitch"), number(fields, "yaw"))
            if self._attitude is not None:
                for now, before in zip(attitude, self._attitude, strict=True):
                    if math.isfinite(now - before):
                        self._turned_rad += abs(math.remainder(now - before, 2.0 * math.pi))
            self._attitude = attitude
            return
        if not self.flight.under_way:
            for gyro, accelerometer in self._repeats.values():
                gyro.value = accelerometer.value = None
            return
        imu = self.flight.imu
        if imu is None or imu.acceleration_m_s2 is None:
            return
        repeats = self._repeats.get(imu.instance)
        if repeats is None:
            repeats = self._repeats[imu.instance] = (_Repeat(), _Repeat())
        for repeat, value in zip(repeats, (imu.gyro_rad_s, imu.acceleration_m_s2), strict=True):
            if repeat.value != value:
                repeat.value, repeat.since_s, repeat.turned_rad, repeat.count = value, t_s, self._turned_rad, 1
                repeat.held.take(t_s, False)
                continue
            repeat.count += 1
            lasting = repeat.count >= FROZEN_SAMPLES and t_s - repeat.since_s >= self.check.limit
            repeat.held.take(t_s, lasting and self._turned_rad - repeat.turned_rad > TURNED_RAD)

    def finish(self) -> Result:
        if not self._repeats:
            return absent("no inertial sensor's message while under way")
        told: list[str] = []
        spans: list[Span] = []
        for instance, repeats in self._repeats.items():
            for kind, repeat in zip(("gyro", "accelerometer"), repeats, strict=True):
                stuck = repeat.held.spans()
                told += [f"{kind} {instance + 1}"] if stuck else []
                spans += stuck
        if told:
            return found(self.check, ", ".join(told), tuple(sorted(spans)))
        return fine("all samples differ")


@dataclass(slots=True)
class GyroBias:
    """Check `gyro_bias`: the first gyro against the rates of the estimator, which has taken the bias out of them.

    It shows what two equal sensors hide: a bias that both have.  Where only one has it, `gyro_pair` says so sooner.
    """

    check: Check
    flight: Flight

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None: ...

    def finish(self) -> Result:
        boot = self.flight.inertial.longest(GYRO)
        if boot is None:
            return absent("no gyro with known units while under way")
        gyro = self.flight.inertial.table(boot, GYRO)
        bias = gyro[:, 1:] - between(gyro[:, 0], self.flight.attitude.table(boot, RATES), ATTITUDE_GAP_S)
        moved = change(windowed(gyro[:, 0], bias, BIAS_WINDOW_S), self.check.limit)
        if moved is None:
            return absent("no two minutes of gyro and ATTITUDE, twice a second or more, under way")
        if moved.spans:
            return found(self.check, f"by {moved.size:.3f} rad/s about {AXES[moved.column]}", moved.spans)
        return fine("the estimated bias stays")


@dataclass(slots=True)
class AccelerometerMotion:
    """Check `accelerometer_motion`: the mean specific force against velocity and attitude, over half a minute.

    f = R(q)^T (dv/dt - g), body FRD.  An accelerometer's bias, or an attitude estimated wrongly, moves the difference.
    """

    check: Check
    flight: Flight
    _velocity: Series = field(default_factory=Series)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if name == "GLOBAL_POSITION_INT":
            velocity = (number(fields, "vx") / 100.0, number(fields, "vy") / 100.0, number(fields, "vz") / 100.0)
            self._velocity.take(self.flight.boot, (t_s, *velocity))

    def finish(self) -> Result:
        boot = self.flight.inertial.longest(ACCELERATION)
        if boot is None:
            return absent("no accelerometer with known units while under way")
        force = self.flight.inertial.table(boot, ACCELERATION)
        t_s = force[:, 0]
        attitude = between(t_s, unwrapped(self.flight.attitude.table(boot, ANGLES), -1), MOTION_GAP_S)
        acceleration = between(t_s, slope(self._velocity.table(boot), VELOCITY_GAP_S), 2.0 * VELOCITY_GAP_S)
        if attitude.shape[1] != 3 or acceleration.shape[1] != 3:
            return absent("no ATTITUDE and GLOBAL_POSITION_INT beside the accelerometer")
        turn = body_to_ned(attitude[:, 0], attitude[:, 1], attitude[:, 2])
        expected = np.einsum("tji,tj->ti", turn, acceleration - np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2]))
        windows = overlapping(t_s, force[:, 1:] - expected, MOTION_WINDOW_S, MOTION_HOP_S)
        moved = change(windows, self.check.limit, references=MOTION_REFERENCES, run=1)
        if moved is None:
            return absent("no two minutes of accelerometer, velocity (2 Hz) and attitude (3 Hz) under way")
        if moved.spans:
            return found(self.check, f"by {moved.size:.2f} m/s2 along {AXES[moved.column]}", moved.spans)
        return fine("agrees with the motion")
