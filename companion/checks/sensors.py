"""SYS_STATUS: sensors that are there, are used, and are not healthy by the autopilot's own judgement."""

from dataclasses import dataclass, field
from typing import Final

from companion.checks.finding import Check, Held, Result, Span, Status, absent, fine, found, number, total_s
from companion.checks.flight import Flight
from companion.dialect import Fields
from companion.frames import Frame

# bit of MAV_SYS_STATUS_SENSOR -> (name, does it stand for a sensor, actuator or power supply of the vehicle).  Left out:
# terrain (data that a ground station did not serve), pre-arm check, logging, geofence, reversed motor: no parts that fail.
BITS: Final[dict[int, tuple[str, bool]]] = {
    0x1: ("gyro", True),
    0x2: ("accelerometer", True),
    0x4: ("compass", True),
    0x8: ("barometer", True),
    0x10: ("airspeed sensor", True),
    0x20: ("GPS", True),
    0x40: ("optical flow", True),
    0x80: ("vision position", True),
    0x100: ("range finder", True),
    0x8000: ("motor outputs", True),
    0x10000: ("RC receiver", False),
    0x20000: ("second gyro", True),
    0x40000: ("second accelerometer", True),
    0x80000: ("second compass", True),
    0x200000: ("attitude estimate", False),
    0x2000000: ("battery", False),
    0x4000000: ("proximity sensor", True),
    0x40000000: ("propulsion", True),
}


@dataclass(slots=True)
class Health:
    """Check `sensor_health`: present, enabled, and not healthy for longer than a moment while armed.

    A fault only of a part that was healthy before while armed: what never was is not fitted, or set up wrongly.
    """

    check: Check
    flight: Flight
    _held: dict[int, Held] = field(default_factory=dict)
    _healthy: int = 0  # bits seen healthy while armed
    _samples: int = 0

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if not self.flight.armed:
            for held in self._held.values():
                held.stop()
            return
        self._samples += 1
        used = int(number(fields, "onboard_control_sensors_present")) & int(
            number(fields, "onboard_control_sensors_enabled")
        )
        healthy = int(number(fields, "onboard_control_sensors_health"))
        self._healthy |= used & healthy
        sick = used & ~healthy
        for bit in BITS:
            if sick & bit and bit not in self._held:
                self._held[bit] = Held(self.check.limit)
            if bit in self._held:
                self._held[bit].take(t_s, bool(sick & bit))

    def finish(self) -> Result:
        if not self._samples:
            return absent("no SYS_STATUS message while armed")
        lost: list[str] = []
        fault = False
        all_spans: list[Span] = []
        for bit, held in self._held.items():
            spans = held.spans()
            if not spans:
                continue
            name, part = BITS[bit]
            before = bool(self._healthy & bit)
            fault |= part and before
            lost.append(f"{name} for {total_s(spans):.0f} s" if before else f"{name} throughout")
            all_spans += spans
        if not lost:
            return fine("all that are used are healthy")
        return found(self.check, ", ".join(lost), tuple(sorted(all_spans)), Status.FAULT if fault else Status.WARNING)
