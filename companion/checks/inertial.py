"""Gyros and accelerometers: against each other, against the estimator, against the motion, and frozen.

What is compared is the change within the flight: a constant bias belongs to the sensor and is the autopilot's to calibrate.
"""

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

import numpy as np

from companion.checks.finding import Check, Held, Means, Result, Span, Status, absent, change, fine, found, median, number
from companion.checks.flight import Flight
from companion.checks.series import Series, between, body_to_ned, overlapping, slope, unwrapped, windowed
from companion.dialect import Fields
from companion.frames import Frame

STANDARD_GRAVITY_M_S2: Final = 9.80665
MG_M_S2: Final = STANDARD_GRAVITY_M_S2 / 1000.0
TOGETHER_S: Final = 0.05  # samples of two sensors nearer than this are of one moment
PAIR_WINDOW_S: Final = 10.0
BIAS_WINDOW_S: Final = 20.0
MOTION_WINDOW_S: Final = 30.0
MOTION_HOP_S: Final = 10.0
MOTION_REFERENCES: Final = 9
LEAST_WINDOWS: Final = 6
PAIR_RUN: Final = 3  # windows: half a minute apart is a drift, less may be a knock
ATTITUDE_GAP_S: Final = 0.6
MOTION_GAP_S: Final = 0.35  # of the attitude: thinner streams turn the force of a bend into the wrong axis
VELOCITY_GAP_S: Final = 0.6  # a thinner stream misses what happens in turns
FROZEN_SAMPLES: Final = 10
TURNED_RAD: Final = 0.1
AXES: Final = "xyz"

Triple = tuple[float, float, float]

NAMES: Final = {ending: ("x" + ending, "y" + ending, "z" + ending) for ending in ("acc", "gyro", "mag")}
# Instance of the sensor by message; HIGHRES_IMU says its own.
INSTANCES: Final = {"RAW_IMU": 0, "SCALED_IMU": 0, "SCALED_IMU2": 1, "SCALED_IMU3": 2}


class Quantity(Enum):
    """What two sensors are compared in: (fields' ending, SI per wire unit of the scaled messages, unit, farthest apart).

    The last figure, for what stands throughout, is ArduPilot's pre-arm limit: 5 deg/s for gyros,
    ARMING_ACCTHRESH 0.75 m/s2 for accelerometers.
    """

    GYRO = ("gyro", 1e-3, "rad/s about", 0.0873)
    ACCELEROMETER = ("acc", MG_M_S2, "m/s2 along", 0.75)

    def __init__(self, ending: str, scale: float, unit: str, apart: float) -> None:
        # Plain attributes, and the plain hash: `value` and Enum's own hash go through Python at every sample.
        self.ending, self.scale, self.unit, self.apart = ending, scale, unit, apart

    __hash__ = object.__hash__


def triple(fields: Fields, ending: str, scale: float) -> Triple:
    """Fields x, y, z with this ending, times scale."""
    x, y, z = NAMES[ending]
    return number(fields, x) * scale, number(fields, y) * scale, number(fields, z) * scale


def sensed(name: str, fields: Fields, flight: Flight, quantity: Quantity) -> tuple[int, Triple] | None:
    """(instance, body FRD, SI) of an inertial message; None where it holds no inertial sensor.

    RAW_IMU has units only with ArduPilot, which sends it like SCALED_IMU (GCS_Common.cpp); elsewhere it is counts.
    """
    if name == "RAW_IMU" and not flight.ardupilot:
        return None
    if not (fields["xacc"] or fields["yacc"] or fields["zacc"]):
        return None  # no accelerometer reads zero on all axes: there is none (SCALED_IMU3 often holds a compass alone)
    if name == "HIGHRES_IMU":
        return int(number(fields, "id")), triple(fields, quantity.ending, 1.0)
    return INSTANCES[name], triple(fields, quantity.ending, quantity.scale)


@dataclass(slots=True)
class Pair:
    """Checks `gyro_pair`, `accelerometer_pair`: two sensors of one kind drift apart while under way."""

    check: Check
    flight: Flight
    quantity: Quantity
    _first: tuple[float, Triple] | None = None
    _first_name: str = ""
    _others: dict[int, Means] = field(default_factory=dict)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if not self.flight.under_way:
            return
        sample = sensed(name, fields, self.flight, self.quantity)
        if sample is None:
            return
        instance, value = sample
        if instance == 0:
            if self._first_name in ("", name):
                self._first_name = name
                self._first = (t_s, value)
            return
        if self._first is None or abs(t_s - self._first[0]) > TOGETHER_S:
            return
        if instance not in self._others:
            self._others[instance] = Means(PAIR_WINDOW_S)
        one = self._first[1]
        self._others[instance].take(t_s, (one[0] - value[0], one[1] - value[1], one[2] - value[2]))

    def finish(self) -> Result:
        judged = {instance: means.windows for instance, means in self._others.items() if len(means.windows) >= LEAST_WINDOWS}
        if not judged:
            return absent("no two sensors side by side for a minute under way")
        unit, apart = self.quantity.unit, self.quantity.apart
        told: list[str] = []
        standing: list[str] = []
        spans: list[Span] = []
        largest = 0.0
        for instance, windows in judged.items():
            moved = change(windows, self.check.limit, run=PAIR_RUN)
            assert moved is not None  # LEAST_WINDOWS are enough
            largest = max(largest, moved.size)
            if moved.spans:
                told.append(f"1 and {instance + 1} by {moved.size:.3f} {unit} {AXES[moved.column]}")
                spans += moved.spans
            usual = [median([window.mean[c] for window in windows]) for c in range(3)]
            if math.hypot(*usual) > apart:
                standing.append(f"1 and {instance + 1} by {math.hypot(*usual):.3f} {unit.split()[0]} throughout")
        if told:
            return found(self.check, ", ".join(told), tuple(sorted(spans)))
        if standing:
            return found(self.check, ", ".join(standing), (), Status.WARNING)
        return fine(f"{len(judged) + 1} sensors stay together")


@dataclass(slots=True)
class Frozen:
    """Check `imu_frozen`: a sensor repeats one sample for seconds while the attitude changes."""

    check: Check
    flight: Flight
    _same: dict[tuple[int, Quantity], tuple[Triple, float, float, int]] = field(default_factory=dict)
    _turned_rad: float = 0.0  # summed changes of attitude
    _attitude: Triple | None = None
    _held: dict[tuple[int, Quantity], Held] = field(default_factory=dict)

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
            self._same.clear()
            return
        for quantity in Quantity:
            sample = sensed(name, fields, self.flight, quantity)
            if sample is None:
                return
            key = (sample[0], quantity)
            same = self._same.get(key)
            held = self._held.get(key)
            if held is None:
                held = self._held[key] = Held(0.0)
            if same is None or same[0] != sample[1]:
                self._same[key] = (sample[1], t_s, self._turned_rad, 1)
                held.take(t_s, False)
                continue
            count = same[3] + 1
            self._same[key] = (same[0], same[1], same[2], count)
            stuck = count >= FROZEN_SAMPLES and t_s - same[1] >= self.check.limit and self._turned_rad - same[2] > TURNED_RAD
            held.take(t_s, stuck)

    def finish(self) -> Result:
        if not self._held:
            return absent("no inertial sensor's message while under way")
        bad = {key: held.spans() for key, held in self._held.items()}
        told = [f"{quantity.name.lower()} {instance + 1}" for (instance, quantity), spans in bad.items() if spans]
        if told:
            return found(self.check, ", ".join(told), tuple(sorted(span for spans in bad.values() for span in spans)))
        return fine("all samples differ")


@dataclass(slots=True)
class GyroBias:
    """Check `gyro_bias`: the first gyro against the rates of the estimator, which has taken the bias out of them.

    It shows what two equal sensors hide: a bias that both have.  Where only one has it, `gyro_pair` says so sooner.
    """

    check: Check
    flight: Flight
    _gyro: Series = field(default_factory=Series)
    _rates: Series = field(default_factory=Series)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if name == "ATTITUDE":
            rates = (number(fields, "rollspeed"), number(fields, "pitchspeed"), number(fields, "yawspeed"))
            self._rates.take(self.flight.boot, (t_s, *rates))
            return
        if self.flight.under_way:
            sample = sensed(name, fields, self.flight, Quantity.GYRO)
            if sample is not None and sample[0] == 0:
                self._gyro.take(self.flight.boot, (t_s, *sample[1]))

    def finish(self) -> Result:
        boot = self._gyro.longest()
        if boot is None:
            return absent("no gyro with known units while under way")
        gyro = self._gyro.table(boot)
        bias = gyro[:, 1:] - between(gyro[:, 0], self._rates.table(boot), ATTITUDE_GAP_S)
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
    _force: Series = field(default_factory=Series)
    _attitude: Series = field(default_factory=Series)
    _velocity: Series = field(default_factory=Series)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        boot = self.flight.boot
        if name == "ATTITUDE":
            self._attitude.take(boot, (t_s, number(fields, "roll"), number(fields, "pitch"), number(fields, "yaw")))
        elif name == "GLOBAL_POSITION_INT":
            velocity = (number(fields, "vx") / 100.0, number(fields, "vy") / 100.0, number(fields, "vz") / 100.0)
            self._velocity.take(boot, (t_s, *velocity))
        elif self.flight.under_way:
            sample = sensed(name, fields, self.flight, Quantity.ACCELEROMETER)
            if sample is not None and sample[0] == 0:
                self._force.take(boot, (t_s, *sample[1]))

    def finish(self) -> Result:
        boot = self._force.longest()
        if boot is None:
            return absent("no accelerometer with known units while under way")
        force = self._force.table(boot)
        t_s = force[:, 0]
        attitude = between(t_s, unwrapped(self._attitude.table(boot), -1), MOTION_GAP_S)
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
