"""The barometer's height against that of the GPS, within the flight."""

import math
from dataclasses import dataclass, field
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from companion.checks.finding import Check, Means, Result, Span, absent, fine, found, median, number
from companion.checks.flight import Flight
from companion.checks.reading import FIX_3D
from companion.dialect import Fields
from companion.frames import Frame

WINDOW_S: Final = 10.0
FRESH_S: Final = 2.0
REFERENCES: Final = 3
RUN: Final = 2
SCALE_HEIGHT_M: Final = 8434.5  # of air at 288.15 K: R T / g
WARM: Final = 0.10  # air 29 K off the standard atmosphere's makes a barometer's height 10 % wrong
ACCURACIES: Final = 2.0  # the receiver's own vertical error estimates allowed beside the limit
AIR_HPA: Final = (100.0, 1200.0)  # what air can be; more is water


@dataclass(slots=True)
class BarometerHeight:
    """Check `baro_height`: barometer and GPS part by more than weather, warmth and the GPS's own error explain."""

    check: Check
    flight: Flight
    _gps: tuple[float, float, float] | None = None  # t_s, height, vertical error
    _means: Means = field(default_factory=lambda: Means(WINDOW_S, least=3))
    _accuracy_m: float = 0.0

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if name == "GPS_RAW_INT":
            fix = number(fields, "fix_type") >= FIX_3D
            self._gps = (t_s, number(fields, "alt") / 1e3, number(fields, "v_acc") / 1e3) if fix else None
            return
        pressure_hpa = number(fields, "press_abs")
        if not self.flight.armed or self._gps is None or not 0.0 <= t_s - self._gps[0] < FRESH_S:
            return
        if AIR_HPA[0] < pressure_hpa < AIR_HPA[1] and self.flight.type != mavlink.MAV_TYPE_SUBMARINE:
            baro_m = -SCALE_HEIGHT_M * math.log(pressure_hpa / 1013.25)
            self._means.take(t_s, (baro_m - self._gps[1], self._gps[1]))
            self._accuracy_m = max(self._accuracy_m, self._gps[2])

    def finish(self) -> Result:
        windows = self._means.windows
        if len(windows) < REFERENCES + RUN:
            return absent("no barometer in air with GPS height for a minute while armed")
        usual_m = median([window.mean[0] for window in windows[:REFERENCES]])
        ground_m = median([window.mean[1] for window in windows[:REFERENCES]])
        spans: list[Span] = []
        run = 0
        worst_m = largest_m = 0.0
        for window in windows[REFERENCES:]:
            away_m = abs(window.mean[0] - usual_m)
            largest_m = max(largest_m, away_m)
            allowed_m = self.check.limit + WARM * abs(window.mean[1] - ground_m) + ACCURACIES * self._accuracy_m
            if away_m <= allowed_m:
                run = 0
                continue
            run += 1
            worst_m = max(worst_m, away_m)
            if run == RUN:
                spans.append((window.start_s - WINDOW_S, window.end_s))
            elif run > RUN:
                spans[-1] = (spans[-1][0], window.end_s)
        return found(self.check, f"by {worst_m:.0f} m", tuple(spans)) if spans else fine(f"{largest_m:.0f} m apart at most")
