"""The vehicle's clock, as its messages tell it, and two checks on it: reboots and other jumps.

`time_boot_ms` is believed; messages without it get the newest boot time plus what has passed on the arrival clock since.  A
clock that jumps is believed only when a second message says the same, so that one stray stamp moves nothing.
"""

import math
from dataclasses import dataclass, field
from typing import Final

from companion.checks.finding import BACK_S, Check, Result, absent, fine, found
from companion.checks.flight import Flight
from companion.dialect import Fields
from companion.frames import Frame

AHEAD_S: Final = 5.0  # a clock further ahead than arrivals explain has jumped
CARRY_S: Final = 30.0  # for so long the arrival clock carries the vehicle's on
NEAR_S: Final = 10.0  # `time_usec` counts from boot only while it is so near (else it counts from 1970)
EARLY_S: Final = 60.0  # a clock that ran back to less has started anew
STRAYS: Final = 0.01  # part of all stamps that may be of another clock: two late messages in a hundred are none


@dataclass(frozen=True, slots=True)
class Jump:
    """The clock went from before_s to after_s while elapsed_s passed on the arrival clock (NaN: unknown)."""

    before_s: float
    after_s: float
    elapsed_s: float
    armed: bool

    @property
    def reboot(self) -> bool:
        """Did it start anew, or just run differently?"""
        return self.after_s < self.before_s and (self.after_s < EARLY_S or self.after_s <= self.elapsed_s + AHEAD_S)


@dataclass(slots=True)
class BootClock:
    """`arrive`, then `read` or `now_s` -> seconds since boot; before the first stamp, seconds since the first arrival."""

    jumps: list[Jump] = field(default_factory=list)
    stamps: int = 0
    strays: int = 0
    backward: int = 0  # arrival stamps before the one before
    started: bool = False
    first_s: float = 0.0
    run_s: float = 0.0  # of the vehicle's clock, over all boots
    arrived_s: float = 0.0  # of the arrival clock, forward steps only, while the vehicle's ran
    _begin_s: float = 0.0  # of the first arrival
    _boot_s: float = 0.0
    _boot_arrival_s: float = math.nan
    _first_arrival_s: float = math.nan
    _arrival_s: float = math.nan
    _suspect_s: float = math.nan

    def expect(self, boot_s: float, after_s: float) -> None:
        """The first stamp, boot_s, is known to come after_s behind the first arrival: earlier frames count back from it."""
        self._begin_s = max(0.0, boot_s - after_s)

    def arrive(self, arrival_s: float) -> None:
        """Any frame, before it is read.  arrival_s: NaN where it was not stamped."""
        if math.isfinite(arrival_s):
            if arrival_s < self._arrival_s - 1e-3:
                self.backward += 1
            self._arrival_s = arrival_s
            if math.isnan(self._first_arrival_s):
                self._first_arrival_s = arrival_s

    def read(self, fields: Fields, armed: bool) -> float:
        """The time of a message of the vehicle: its own where it tells one, else `now_s`."""
        stamp = fields.get("time_boot_ms")
        if isinstance(stamp, int) and stamp > 0:
            return self._stamped(stamp / 1e3, armed)
        stamp = fields.get("time_usec")
        if self.started and isinstance(stamp, int) and abs(stamp / 1e6 - self._boot_s) < NEAR_S:
            return stamp / 1e6
        return self.now_s()

    def now_s(self) -> float:
        """The newest time known, carried on by arrivals."""
        if not self.started:
            passed_s = self._arrival_s - self._first_arrival_s
            return max(0.0, self._begin_s + (passed_s if math.isfinite(passed_s) else 0.0))
        passed_s = self._arrival_s - self._boot_arrival_s
        if 0.0 <= passed_s <= CARRY_S:
            return self._boot_s + passed_s
        return self._boot_s + (CARRY_S if passed_s > CARRY_S else 0.0)

    def _stamped(self, boot_s: float, armed: bool) -> float:
        self.stamps += 1
        if not self.started:
            self.started, self.first_s = True, boot_s
            return self._accept(boot_s)
        passed_s = self._arrival_s - self._boot_arrival_s
        passed_s = passed_s if math.isfinite(passed_s) and passed_s >= 0.0 else 0.0
        step_s = boot_s - self._boot_s
        if -BACK_S < step_s <= passed_s + AHEAD_S:
            self._suspect_s = math.nan
            if step_s > 0.0:
                self.run_s += step_s
                self.arrived_s += passed_s if passed_s < CARRY_S else step_s  # a silence is no clock
                self._accept(boot_s)
            return boot_s
        if -BACK_S < boot_s - self._suspect_s < AHEAD_S:
            self.jumps.append(Jump(self._boot_s, boot_s, passed_s if math.isfinite(self._arrival_s) else math.nan, armed))
            self._suspect_s = math.nan
            return self._accept(boot_s)
        self._suspect_s = boot_s
        self.strays += 1
        return self.now_s()

    def _accept(self, boot_s: float) -> float:
        self._boot_s, self._boot_arrival_s = boot_s, self._arrival_s
        return boot_s


@dataclass(slots=True)
class Reboots:
    """Check `reboot`: the boot clock started anew within the log."""

    check: Check
    flight: Flight
    clock: BootClock

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None: ...

    def finish(self) -> Result:
        if not self.clock.started:
            return absent("no message with time since boot")
        reboots = [jump for jump in self.clock.jumps if jump.reboot]
        if not reboots:
            return fine("no reboot")
        armed = sum(jump.armed for jump in reboots)
        told = ", ".join(f"after {jump.before_s:.0f} s" for jump in reboots[:5]) + (" ..." if len(reboots) > 5 else "")
        return found(
            self.check,
            f"{len(reboots)} time(s), {armed} while armed ({told})",
            tuple((jump.before_s, jump.before_s) for jump in reboots),
        )


@dataclass(slots=True)
class Clocks:
    """Check `clock`: the boot clock against arrival stamps."""

    check: Check
    flight: Flight
    clock: BootClock

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None: ...

    def finish(self) -> Result:
        clock = self.clock
        if not clock.started:
            return absent("no message with time since boot")
        wrong: list[str] = []
        jumps = [jump for jump in clock.jumps if not jump.reboot]
        if jumps:
            first = jumps[0]
            wrong.append(
                f"vehicle clock jumped {len(jumps)} time(s), first from {first.before_s:.0f} to {first.after_s:.0f} s"
            )
        strays = clock.strays - len(clock.jumps)
        if strays > max(2.0, STRAYS * clock.stamps):
            wrong.append(f"{strays} of {clock.stamps} stamps are of another clock (two vehicles under one id?)")
        if clock.backward:
            wrong.append(f"arrival stamps ran backwards {clock.backward} time(s)")
        if clock.run_s > AHEAD_S and clock.arrived_s > 0.0:
            ratio = clock.run_s / clock.arrived_s
            if not 1.0 / self.check.limit < ratio < self.check.limit:
                wrong.append(f"{clock.run_s:.0f} s of the vehicle came in {clock.arrived_s:.0f} s of arrival stamps")
        if not wrong:
            return fine(f"{clock.run_s:.0f} s of vehicle time, steady")
        return found(
            self.check,
            "; ".join(wrong),
            tuple((jump.before_s, jump.after_s) for jump in jumps if jump.after_s > jump.before_s),
        )
