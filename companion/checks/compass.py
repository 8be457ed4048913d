"""Compasses: the field's strength, each other, an offset that came in flight, and the heading against the course."""

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from companion.checks.finding import (
    Check,
    Held,
    Mean,
    Means,
    Result,
    Span,
    absent,
    change,
    fine,
    found,
    known,
    number,
    total_s,
)
from companion.checks.flight import SURFACE, Flight
from companion.checks.gps import FIX_3D, UINT16_MAX
from companion.checks.inertial import ATTITUDE_GAP_S, AXES, INSTANCES, TOGETHER_S, Triple, triple
from companion.checks.series import Array, Series, between, body_to_ned, sliding, unwrapped
from companion.dialect import Fields
from companion.frames import Frame

FIELD_WINDOW_S: Final = 2.0
PAIR_WINDOW_S: Final = 20.0
OFFSET_WINDOW_S: Final = 60.0
OFFSET_HOP_S: Final = 20.0
OFFSET_ROWS: Final = 30
PRIOR: Final = 0.01  # of rows: holds the vertical offset of a vehicle that never tilts, where nothing tells it
WORST_CONDITION: Final = 1e5
HEADING_HOLD_S: Final = 10.0
PLANE_M_S, SURFACE_M_S = 10.0, 2.0
REVERSE_DEG: Final = 135.0


def magnetic(name: str, fields: Fields, flight: Flight) -> tuple[int, Triple] | None:
    """(instance, field in mG, body FRD); None where there is no compass, or only counts (RAW_IMU but ArduPilot's)."""
    if name == "RAW_IMU" and not flight.ardupilot:
        return None
    if name == "HIGHRES_IMU":
        instance, value = int(number(fields, "id")), triple(fields, "mag", 1000.0)  # gauss
    else:
        instance, value = INSTANCES[name], triple(fields, "mag", 1.0)
    return (instance, value) if any(value) else None


@dataclass(slots=True)
class Field:
    """Check `compass_field`: the strength of the field changes while under way."""

    check: Check
    flight: Flight
    _means: dict[int, Means] = field(default_factory=dict)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if not self.flight.under_way:
            return
        sample = magnetic(name, fields, self.flight)
        if sample is None:
            return
        if sample[0] not in self._means:
            self._means[sample[0]] = Means(FIELD_WINDOW_S, least=2)
        self._means[sample[0]].take(t_s, (math.hypot(*sample[1]),))

    def finish(self) -> Result:
        judged = {instance: means.windows for instance, means in self._means.items() if len(means.windows) >= 5}
        if not judged:
            return absent("no compass with known units while under way")
        told: list[str] = []
        spans: list[Span] = []
        largest = 0.0
        for instance, windows in judged.items():
            least = min(windows, key=lambda window: window.mean[0])
            most = max(windows, key=lambda window: window.mean[0])
            part = most.mean[0] / least.mean[0] - 1.0
            largest = max(largest, part)
            if part > self.check.limit:
                told.append(f"compass {instance + 1} from {least.mean[0]:.0f} to {most.mean[0]:.0f} mG")
                spans.append((min(least.start_s, most.start_s), max(least.end_s, most.end_s)))
        return found(self.check, ", ".join(told), tuple(sorted(spans))) if told else fine(f"by {100.0 * largest:.0f} %")


@dataclass(slots=True)
class CompassPair:
    """Check `compass_pair`: two compasses drift apart while under way, in body axes."""

    check: Check
    flight: Flight
    _first: tuple[float, Triple] | None = None
    _others: dict[int, Means] = field(default_factory=dict)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if not self.flight.under_way:
            return
        sample = magnetic(name, fields, self.flight)
        if sample is None:
            return
        instance, value = sample
        if instance == 0:
            self._first = (t_s, value)
            return
        if self._first is None or abs(t_s - self._first[0]) > TOGETHER_S:
            return
        if instance not in self._others:
            self._others[instance] = Means(PAIR_WINDOW_S)
        one = self._first[1]
        self._others[instance].take(t_s, (one[0] - value[0], one[1] - value[1], one[2] - value[2]))

    def finish(self) -> Result:
        judged = {instance: means.windows for instance, means in self._others.items() if len(means.windows) >= 5}
        if not judged:
            return absent("no two compasses side by side for two minutes under way")
        told: list[str] = []
        spans: list[Span] = []
        for instance, windows in judged.items():
            moved = change(windows, self.check.limit)
            assert moved is not None  # five windows are enough
            if moved.spans:
                told.append(f"1 and {instance + 1} by {moved.size:.0f} mG along {AXES[moved.column]}")
                spans += moved.spans
        return found(self.check, ", ".join(told), tuple(sorted(spans))) if told else fine("stay together")


@dataclass(slots=True)
class Offset:
    """Check `compass_offset`: an offset fixed to the body came up within the flight, in the first compass.

    Over a minute with turns, m_body = R(q)^T m_earth + b is solved for the earth's field and b by least squares; the change
    of b's horizontal components is judged (the vertical one is hardly told from the earth's).
    """

    check: Check
    flight: Flight
    _field: Series = field(default_factory=Series)
    _attitude: Series = field(default_factory=Series)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if name == "ATTITUDE":
            row = (t_s, number(fields, "roll"), number(fields, "pitch"), number(fields, "yaw"))
            self._attitude.take(self.flight.boot, row)
        elif self.flight.under_way:
            sample = magnetic(name, fields, self.flight)
            if sample is not None and sample[0] == 0:
                self._field.take(self.flight.boot, (t_s, *sample[1]))

    def finish(self) -> Result:
        boot = self._field.longest()
        if boot is None:
            return absent("no compass with known units while under way")
        windows = self._windows(boot)
        moved = change(windows, self.check.limit)
        if moved is None:
            return absent("no compass and attitude through enough turns")
        if moved.spans:
            return found(self.check, f"by {moved.size:.0f} mG along {AXES[moved.column]}", moved.spans)
        return fine("none came up")

    def _windows(self, boot: int) -> list[Mean]:
        magnetic_table = self._field.table(boot)
        t_s, field_mg = magnetic_table[:, 0], magnetic_table[:, 1:]
        attitude = between(t_s, unwrapped(self._attitude.table(boot), -1), ATTITUDE_GAP_S)
        if attitude.shape[1] != 3:
            return []
        usable = np.isfinite(attitude).all(axis=1)
        t_s, field_mg, attitude = t_s[usable], field_mg[usable], attitude[usable]
        turn = body_to_ned(attitude[:, 0], attitude[:, 1], attitude[:, 2])
        out: list[Mean] = []
        for end_s, rows in sliding(t_s, OFFSET_WINDOW_S, OFFSET_HOP_S):
            solved = _offset(turn[rows], field_mg[rows])
            if solved is not None:
                out.append(Mean(end_s - OFFSET_WINDOW_S, end_s, *solved))
        return out


def _offset(turn: Array, field_mg: Array) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Horizontal body offset in mG and its standard error.  turn: (row, 3, 3) body to NED; field_mg: (row, 3)."""
    rows = len(turn)
    if rows < OFFSET_ROWS:
        return None
    design = np.concatenate([turn.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (rows, 3, 3))], axis=2).reshape(3 * rows, 6)
    normal = design.T @ design
    normal[5, 5] += PRIOR * rows
    if np.linalg.cond(normal) > WORST_CONDITION:
        return None
    target = field_mg.reshape(-1)
    inverse = np.linalg.inv(normal)
    solution = inverse @ (design.T @ target)
    residual = target - design @ solution
    error = np.sqrt(float(residual @ residual) / len(residual) * np.diag(inverse))
    return (float(solution[3]), float(solution[4])), (float(error[3]), float(error[4]))


@dataclass(slots=True)
class HeadingCourse:
    """Check `heading_course`: the heading lies far from the course over ground, of vehicles that go where they look."""

    check: Check
    flight: Flight
    _yaw_deg: float = math.nan
    _held: Held = field(default_factory=lambda: Held(HEADING_HOLD_S))

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if name == "ATTITUDE":
            yaw_rad = number(fields, "yaw")
            self._yaw_deg = math.degrees(yaw_rad) if math.isfinite(yaw_rad) else math.nan
            return
        surface = self.flight.type in SURFACE
        speed_m_s = known(number(fields, "vel"), UINT16_MAX) / 100.0
        course_deg = known(number(fields, "cog"), UINT16_MAX) / 100.0
        fast = speed_m_s > (SURFACE_M_S if surface else PLANE_M_S)
        judged = self.flight.armed and (surface or self.flight.fixed_wing) and number(fields, "fix_type") >= FIX_3D
        if not judged or not fast or math.isnan(course_deg + self._yaw_deg):
            self._held.stop()
            return
        apart_deg = abs(math.remainder(self._yaw_deg - course_deg, 360.0))
        if surface and apart_deg > REVERSE_DEG:
            self._held.stop()
            return
        self._held.take(t_s, apart_deg > self.check.limit, apart_deg)

    def finish(self) -> Result:
        if not self._held.samples:
            return absent("no fixed wing, rover or boat under way with GPS course and ATTITUDE")
        spans = self._held.spans()
        if spans:
            return found(self.check, f"by up to {self._held.worst:.0f} deg, {total_s(spans):.0f} s in all", spans)
        return fine("goes where it looks")
