"""Power: charge, volts a cell, a voltage that falls without cause, and the autopilot's own supply."""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from companion.checks.finding import Check, Excess, Held, Result, Status, absent, fine, found, known, number
from companion.checks.flight import Flight
from companion.checks.level import Level
from companion.checks.reading import UINT16_MAX
from companion.dialect import Fields
from companion.frames import Frame

CHARGE_STATES: Final = {
    mavlink.MAV_BATTERY_CHARGE_STATE_LOW: "low",
    mavlink.MAV_BATTERY_CHARGE_STATE_CRITICAL: "critical",
    mavlink.MAV_BATTERY_CHARGE_STATE_EMERGENCY: "emergency",
    mavlink.MAV_BATTERY_CHARGE_STATE_FAILED: "failed",
    mavlink.MAV_BATTERY_CHARGE_STATE_UNHEALTHY: "unhealthy",
}
BROKEN: Final = frozenset({"failed", "unhealthy"})
FULL_CELL_V: Final = 4.25  # a lithium polymer cell is full at 4.2 V
SOUND_CELL_V: Final = 3.6  # a cell that begins below is of another chemistry, or the count of cells is wrong
LEAST_V: Final = 3.0
SETTLE_S: Final = 4.0  # length of either mean
APART_S: Final = 6.0  # between them
RAIL_HOLD_S: Final = 0.5
STEADY_A: Final = 2.0
STEADY: Final = 0.10  # a current that grew by less than this part and by less than STEADY_A explains no sag


def pack_v(fields: Fields) -> float:
    """The voltage of SYS_STATUS; NaN where unknown or no battery is measured."""
    volts = known(number(fields, "voltage_battery"), UINT16_MAX) / 1e3
    return volts if volts >= LEAST_V else math.nan


@dataclass(slots=True)
class Charge:
    """Check `battery_low`: little charge is left, or the battery's own monitor complains, while armed."""

    check: Check
    flight: Flight
    _left: Excess = field(init=False)
    _states: list[str] = field(default_factory=list)
    _sound: bool = False  # it said OK before: what never did may just not be connected

    def __post_init__(self) -> None:
        self._left = Excess(self.check.limit, below=True)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if not self.flight.armed:
            self._left.take(t_s, math.nan)
            return
        if name == "BATTERY_STATUS":
            value = int(number(fields, "charge_state"))
            self._sound |= value == mavlink.MAV_BATTERY_CHARGE_STATE_OK
            state = CHARGE_STATES.get(value)
            if state is not None and state not in self._states:
                self._states.append(state)
            return
        left = number(fields, "battery_remaining")
        if 0.0 <= left <= 100.0 and not math.isnan(pack_v(fields)):
            self._left.take(t_s, left)

    def finish(self) -> Result:
        if not self._left.samples and not self._states:
            return absent("the battery's charge is not told while armed")
        spans = self._left.spans()
        parts = [f"down to {self._left.farthest:.0f} %"] if spans else []
        parts += [f"battery says {state}" for state in self._states]
        if parts:
            broken = self._sound and any(state in BROKEN for state in self._states)
            return found(self.check, ", ".join(parts), spans, Status.FAULT if broken else Status.WARNING)
        return fine(f"{self._left.farthest:.0f} % or more")


@dataclass(slots=True)
class Cells:
    """Check `battery_cell`: volts a cell while armed; the number of cells follows from the highest voltage."""

    check: Check
    flight: Flight
    _samples: list[tuple[float, float]] = field(default_factory=list)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        volts = pack_v(fields)
        if self.flight.armed and math.isfinite(volts):
            self._samples.append((t_s, volts))

    def finish(self) -> Result:
        if not self._samples:
            return absent("no battery voltage while armed")
        # The highest fiftieth is at rest; the very highest one may be a spike.
        high_v = sorted(volts for _, volts in self._samples)[-max(1, len(self._samples) // 50)]
        cells = math.ceil(high_v / FULL_CELL_V)
        if high_v / cells < SOUND_CELL_V:
            return absent(f"{high_v:.1f} V tells no number of lithium cells")
        cell_v = Excess(self.check.limit, below=True)
        for t_s, volts in self._samples:
            cell_v.take(t_s, volts / cells)
        beyond = f"{{worst:.2f}} V a cell of {cells}, {{lasted_s:.0f}} s in all"
        return cell_v.result(self.check, "", beyond, f"{{farthest:.2f}} V a cell of {cells} or more")


@dataclass(slots=True)
class Drop:
    """Check `battery_drop`: the voltage falls within ten seconds although no more current is drawn."""

    check: Check
    flight: Flight
    _recent: deque[tuple[float, float, float]] = field(default_factory=deque)
    _held: Held = field(default_factory=lambda: Held(2.0))
    _told: str = ""

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        volts = pack_v(fields)
        amperes = number(fields, "current_battery") / 100.0
        if not self.flight.armed or math.isnan(volts) or amperes < 0.0:
            self._recent.clear()
            self._held.stop()
            return
        recent = self._recent
        if recent and not 0.0 <= t_s - recent[-1][0] < 5.0:
            recent.clear()
        recent.append((t_s, volts, amperes))
        while t_s - recent[0][0] > 2.0 * SETTLE_S + APART_S:
            recent.popleft()
        early = [sample for sample in recent if t_s - sample[0] > SETTLE_S + APART_S]
        late = [sample for sample in recent if t_s - sample[0] <= SETTLE_S]
        if len(early) < 3 or len(late) < 3:
            return
        before_v, after_v = _mean(early, 1), _mean(late, 1)
        before_a, after_a = _mean(early, 2), _mean(late, 2)
        explained = after_a - before_a > min(STEADY_A, STEADY * before_a)
        drop = 1.0 - after_v / before_v
        stands = drop > self.check.limit and not explained and before_a > 0.0
        if stands and drop > self._held.worst and not self._told:
            self._told = f"from {before_v:.1f} to {after_v:.1f} V at {before_a:.1f} and {after_a:.1f} A"
        self._held.take(t_s, stands, drop)

    def finish(self) -> Result:
        if not self._held.samples:
            return absent("no battery voltage with a current beside it while armed")
        spans = self._held.spans()
        return found(self.check, self._told, spans) if spans else fine("none that the current does not explain")


def _mean(samples: list[tuple[float, float, float]], place: int) -> float:
    return math.fsum(sample[place] for sample in samples) / len(samples)


def rail(check: Check, flight: Flight) -> Level:
    """Check `power_rail`: the autopilot's own 5 V supply while armed."""

    def read(fields: Fields) -> float:
        volts = known(number(fields, "Vcc"), UINT16_MAX) / 1e3
        return volts if volts > 1.0 else math.nan

    words = ("the autopilot's supply is not told while armed", "down to {farthest:.2f} V", "{farthest:.2f} V or more")
    return Level(check, flight, read, *words, below=True, hold_s=RAIL_HOLD_S)
