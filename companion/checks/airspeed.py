"""Airspeed of fixed wings: gone, stuck, or of another scale than before, against ground speed and heading."""

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from companion.checks.finding import HOLD_S, Check, Held, Result, absent, fine, found, median, number, runs, total_s
from companion.checks.flight import Flight
from companion.checks.reading import FIX_3D, PITCH_AND_YAW, UINT16_MAX
from companion.checks.series import Series, between, sliding, unwrapped
from companion.dialect import Fields
from companion.frames import Frame

WORKED_M_S: Final = 5.0  # a sensor that never read so much is none
GROUND_M_S: Final = 10.0  # the ground speed at which no airspeed can be next to nothing but in a gale
SAME_M_S: Final = 0.005
CHANGED_M_S: Final = 1.0
STUCK_SAMPLES: Final = 10
WINDOW_S: Final = 60.0  # long enough to turn through different headings, and to outlast gusts
HOP_S: Final = 10.0
GUST_S: Final = 5.0  # for so long a gust keeps its direction: residuals of a window are not independent
TURNED: Final = 0.3  # spread of the air velocity's direction that separates scale and wind, in airspeeds
GAP_S: Final = 1.2
REFERENCES: Final = 4

SOURCES: Final = ("AIRSPEED", "VFR_HUD")


@dataclass(slots=True)
class _Sensor:
    """Airspeed from AIRSPEED of the first sensor where it is sent, else from VFR_HUD."""

    own: bool = False

    def read_m_s(self, name: str, fields: Fields) -> float | None:
        if name == "AIRSPEED":
            if number(fields, "id") != 0.0:
                return None
            self.own = True
        elif name != "VFR_HUD" or self.own:
            return None
        value = number(fields, "airspeed")
        return value if math.isfinite(value) else None


@dataclass(slots=True)
class Zero:
    """Check `airspeed_zero`: it worked, and reads next to nothing in flight."""

    check: Check
    flight: Flight
    _sensor: _Sensor = field(default_factory=_Sensor)
    _held: Held = field(default_factory=lambda: Held(HOLD_S))
    _worked: bool = False

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        value = self._sensor.read_m_s(name, fields)
        if value is None:
            return
        self._worked |= self.flight.airborne and value > WORKED_M_S
        if not self._worked or not self.flight.airborne or not self.flight.ground_speed_m_s > GROUND_M_S:
            self._held.stop()
            return
        self._held.take(t_s, value < self.check.limit)

    def finish(self) -> Result:
        if not self.flight.fixed_wing:
            return absent("no fixed wing")
        if not self._worked:
            return absent("no airspeed sensor reads in flight")
        spans = self._held.spans()
        return found(self.check, f"{total_s(spans):.0f} s in all", spans) if spans else fine("reads in flight")


@dataclass(slots=True)
class Stuck:
    """Check `airspeed_stuck`: it repeats one value while the ground speed changes."""

    check: Check
    flight: Flight
    _sensor: _Sensor = field(default_factory=_Sensor)
    _since: tuple[float, float, int, float, float] | None = None  # t_s, value, samples, least and most ground speed
    _held: Held = field(default_factory=lambda: Held(0.0))
    _value_m_s: float = 0.0

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        value = self._sensor.read_m_s(name, fields)
        if value is None:
            return
        ground_m_s = self.flight.ground_speed_m_s
        if not self.flight.airborne or value < WORKED_M_S or math.isnan(ground_m_s):
            self._since = None
            self._held.stop()
            return
        if self._since is None or abs(value - self._since[1]) > SAME_M_S:
            self._since = (t_s, value, 1, ground_m_s, ground_m_s)
            self._held.take(t_s, False)
            return
        start_s, same_m_s, count, least, most = self._since
        self._since = (start_s, same_m_s, count + 1, min(least, ground_m_s), max(most, ground_m_s))
        stuck = t_s - start_s >= self.check.limit and count >= STUCK_SAMPLES and most - least > CHANGED_M_S
        if stuck:
            self._value_m_s = value
        self._held.take(t_s, stuck)

    def finish(self) -> Result:
        if not self.flight.fixed_wing:
            return absent("no fixed wing")
        if not self._held.samples:
            return absent("no airspeed sensor reads in flight")
        spans = self._held.spans()
        if spans:
            return found(self.check, f"at {self._value_m_s:.1f} m/s for {total_s(spans):.0f} s and more", spans)
        return fine("changes in flight")


@dataclass(slots=True)
class Scale:
    """Check `airspeed_scale`: the factor between airspeed and the air's velocity changed within the flight.

    Over a minute with turns, v_ground = wind + k V (cos yaw, sin yaw) cos pitch is solved for the wind and k by least
    squares; k is compared with that of the flight's first minutes, so that neither wind nor density matters.
    """

    check: Check
    flight: Flight
    _sensor: _Sensor = field(default_factory=_Sensor)
    _air: Series = field(default_factory=Series)
    _ground: Series = field(default_factory=Series)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        boot = self.flight.boot
        if name == "GPS_RAW_INT":
            speed, course = number(fields, "vel"), number(fields, "cog")
            if number(fields, "fix_type") >= FIX_3D and UINT16_MAX not in (speed, course):
                course_rad = math.radians(course / 100.0)
                velocity = (speed / 100.0 * math.cos(course_rad), speed / 100.0 * math.sin(course_rad))
                self._ground.take(boot, (t_s, *velocity))
        else:
            value = self._sensor.read_m_s(name, fields)
            if value is not None and self.flight.airborne:
                self._air.take(boot, (t_s, value))

    def finish(self) -> Result:
        if not self.flight.fixed_wing:
            return absent("no fixed wing")
        boot = self._air.longest()
        if boot is None:
            return absent("no airspeed in flight")
        windows = self._windows(boot)
        if len(windows) < REFERENCES + 2:
            return absent("no airspeed with GPS velocity and attitude through enough turns")
        reference = median([scale for _, scale, _ in windows[:REFERENCES]])
        away = [scale / reference - 1.0 for _, scale, _ in windows[REFERENCES:]]
        errors = [error / reference for _, _, error in windows[REFERENCES:]]
        beyond = [abs(part) > max(self.check.limit, 5.0 * error) for part, error in zip(away, errors, strict=True)]
        worst = max((part for part, stands in zip(away, beyond, strict=True) if stands), key=abs, default=0.0)
        ends_s = [end_s for end_s, _, _ in windows[REFERENCES:]]
        spans = [(ends_s[first] - HOP_S, ends_s[last]) for first, last in runs(beyond, 2)]
        if spans:
            return found(self.check, f"reads {100.0 * (1.0 / (1.0 + worst) - 1.0):+.0f} % against before", tuple(spans))
        return fine("agrees with ground speed and heading")

    def _windows(self, boot: int) -> list[tuple[float, float, float]]:
        """(end of window, k, its standard error) where the turns tell k from the wind."""
        air = self._air.table(boot)
        t_s = air[:, 0]
        attitude = between(t_s, unwrapped(self.flight.attitude.table(boot, PITCH_AND_YAW), -1), GAP_S)
        ground = between(t_s, self._ground.table(boot), GAP_S)
        if attitude.shape[1] != 2 or ground.shape[1] != 2:
            return []
        level = air[:, 1] * np.cos(attitude[:, 0])
        north, east = level * np.cos(attitude[:, 1]), level * np.sin(attitude[:, 1])
        usable = np.isfinite(north) & np.isfinite(ground).all(axis=1)
        t_s, north, east, ground = t_s[usable], north[usable], east[usable], ground[usable]
        out: list[tuple[float, float, float]] = []
        for end_s, rows in sliding(t_s, WINDOW_S, HOP_S):
            n, e, g = north[rows], east[rows], ground[rows]
            if len(n) < 2 * STUCK_SAMPLES:
                continue
            spread = float(np.sqrt(np.var(n) + np.var(e)))
            if not spread > TURNED * max(WORKED_M_S, float(np.median(np.hypot(n, e)))):
                continue
            # Least squares with the means taken out: k is all that is left.
            dn, de, gn, ge = n - n.mean(), e - e.mean(), g[:, 0] - g[:, 0].mean(), g[:, 1] - g[:, 1].mean()
            scale = float((dn * gn + de * ge).sum() / (dn * dn + de * de).sum())
            rms = float(np.sqrt(((gn - scale * dn) ** 2 + (ge - scale * de) ** 2).mean()))
            out.append((end_s, scale, rms / (spread * math.sqrt(WINDOW_S / GUST_S))))
        return out
