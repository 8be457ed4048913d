"""Arrival stamps: microseconds since 1970 that never run backwards, at the pace of the vehicle.

The wall clock is read once, at the start; a step of NTP afterwards moves no stamp.  Stamps are multiples of 4 us because
a tlog keeps the link's number in the two lowest bits: what is decided live is decided from the very stamp on disk.
"""

import time
from typing import Final, Protocol

from pymavlink.dialects.v20.all import MAV_COMP_ID_AUTOPILOT1

from companion.frames import Frame

STAMP_US: Final = 4
REBOOT_BACK_US: Final = 1_000_000  # a vehicle's clock further back than this has been started anew


class Clock(Protocol):
    """Where arrival stamps come from."""

    def now_us(self) -> int:
        """The present, a multiple of 4."""

    def advance_to(self, vehicle_us: int) -> None:
        """In lockstep: the vehicle has reached this time since its boot."""

    def wait_s(self, pause_s: float) -> float:
        """How long to wait for bytes if nothing is to be done for pause_s of the vehicle's time."""

    def arrival_us(self, looked_us: int, pause_s: float) -> int:
        """The stamp of bytes found now by a loop that has last looked at looked_us and looks every pause_s."""


def follow(clock: Clock, frame: Frame) -> None:
    """In lockstep the simulator tells by TIMESYNC how far it has come; whoever takes its frames passes them here first."""
    if frame.name == "TIMESYNC" and frame.compid == MAV_COMP_ID_AUTOPILOT1:
        fields = frame.fields()
        asked_ns = fields["ts1"]
        if fields["tc1"] == 0 and isinstance(asked_ns, int):
            clock.advance_to(asked_ns // 1000)


class WallClock:
    """Real time, or a multiple of it beside a simulator that flies faster."""

    def __init__(self, speedup: float = 1.0) -> None:
        self._speedup = speedup
        self._epoch_us = time.time_ns() // 1000
        self._start_ns = time.monotonic_ns()

    def now_us(self) -> int:
        passed_us = int((time.monotonic_ns() - self._start_ns) * self._speedup) // 1000
        return (self._epoch_us + passed_us) // STAMP_US * STAMP_US

    def advance_to(self, vehicle_us: int) -> None:
        """Real time does not wait for the vehicle."""

    def wait_s(self, pause_s: float) -> float:
        return pause_s / self._speedup

    def arrival_us(self, looked_us: int, pause_s: float) -> int:
        """Now, unless the loop was held up: the bytes then wait since soon after it looked, and are not late."""
        return min(self.now_us(), (looked_us + round(pause_s * 1e6)) // STAMP_US * STAMP_US)


class VehicleClock:
    """Lockstep: time passes when the simulator says so, which makes a run over real sockets reproducible to the bit."""

    def __init__(self, epoch_us: int | None = None) -> None:
        self._epoch_us = time.time_ns() // 1000 if epoch_us is None else epoch_us
        self._vehicle_us = 0

    def now_us(self) -> int:
        return (self._epoch_us + self._vehicle_us) // STAMP_US * STAMP_US

    def advance_to(self, vehicle_us: int) -> None:
        if vehicle_us < self._vehicle_us - REBOOT_BACK_US:  # stamps go on where the vehicle's clock began anew
            self._epoch_us += self._vehicle_us - vehicle_us
            self._vehicle_us = vehicle_us
        self._vehicle_us = max(self._vehicle_us, vehicle_us)

    def wait_s(self, pause_s: float) -> float:
        return pause_s

    def arrival_us(self, looked_us: int, pause_s: float) -> int:
        return self.now_us()
