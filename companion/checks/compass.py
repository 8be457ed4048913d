"""Compasses: the field's strength, each other, an offset that came in flight, and the heading against the course."""

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from companion.checks.finding import Check, Excess, Mean, Means, Result, Span, absent, change, fine, found, known, number
from companion.checks.flight import SURFACE, Flight
from companion.checks.inertial import ATTITUDE_GAP_S, AXES
from companion.checks.reading import ANGLES, FIX_3D, MAGNETIC, UINT16_MAX
from companion.checks.series import Array, between, body_to_ned, sliding, unwrapped
from companion.dialect import Fields
from companion.frames import Frame

FIELD_WINDOW_S: Final = 2.0
OFFSET_WINDOW_S: Final = 60.0
OFFSET_HOP_S: Final = 20.0
OFFSET_ROWS: Final = 30
PRIOR: Final = 0.01  # of rows: holds the vertical offset of a vehicle that never tilts, where nothing tells it
WORST_CONDITION: Final = 1e5
HEADING_HOLD_S: Final = 10.0
PLANE_M_S, SURFACE_M_S = 10.0, 2.0
REVERSE_DEG: Final = 135.0


@dataclass(slots=True)
class Field:
    """Check `compass_field`: the strength of the field changes while under way."""

    check: Check
    flight: Flight
    _means: dict[int, Means] = field(default_factory=dict)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        imu = self.flight.imu
        if imu is None or imu.field_mg is None:
            return
        means = self._means.get(imu.instance)
        if means is None:
            means = self._means[imu.instance] = Means(FIELD_WINDOW_S, least=2)
        means.take(t_s, (math.hypot(*imu.field_mg),))

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
class Offset:
    """Check `compass_offset`: an offset fixed to the body came up within the flight, in the first compass.

    Over a minute with turns, m_body = R(q)^T m_earth + b is solved for the earth's field and b by least squares; the change
    of b's horizontal components is judged (the vertical one is hardly told from the earth's).
    """

    check: Check
    flight: Flight

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None: ...

    def finish(self) -> Result:
        boot = self.flight.inertial.longest(MAGNETIC)
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
        magnetic_table = self.flight.inertial.table(boot, MAGNETIC)
        t_s, field_mg = magnetic_table[:, 0], magnetic_table[:, 1:]
        attitude = between(t_s, unwrapped(self.flight.attitude.table(boot, ANGLES), -1), ATTITUDE_GAP_S)
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
    _apart_deg: Excess = field(init=False)

    def __post_init__(self) -> None:
        self._apart_deg = Excess(self.check.limit, HEADING_HOLD_S)

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
        apart_deg = abs(math.remainder(self._yaw_deg - course_deg, 360.0)) if judged and fast else math.nan
        self._apart_deg.take(t_s, math.nan if surface and apart_deg > REVERSE_DEG else apart_deg)

    def finish(self) -> Result:
        nothing = "no fixed wing, rover or boat under way with GPS course and ATTITUDE"
        beyond = "by up to {worst:.0f} deg, {lasted_s:.0f} s in all"
        return self._apart_deg.result(self.check, nothing, beyond, "goes where it looks")
