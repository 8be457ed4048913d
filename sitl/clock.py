"""How fast simulated time passes: as real time, a multiple of it, as fast as it goes, or in lockstep with a listener."""

import math
import time
from collections.abc import Callable

LARGEST_LAG_S = 0.5  # of wall time that is caught up in one go; beyond it the simulation slips instead of hurrying


class Clock:
    """Says when the simulated vehicle is due for its next step.

    speedup: simulated seconds per real second, inf for as fast as it goes.  lockstep: a step is due when the one listener
    has answered for the last one; the clock itself then never asks to wait.  monotonic_s: the wall clock, replaced in tests.
    Raises ValueError for a speedup that is no positive number.
    """

    def __init__(
        self, speedup: float = 1.0, *, lockstep: bool = False, monotonic_s: Callable[[], float] = time.monotonic
    ) -> None:
        if not speedup > 0.0:
            raise ValueError(f"speedup {speedup:g} is no factor; give a number > 0 or max")
        self.speedup = math.inf if lockstep else speedup
        self.lockstep = lockstep
        self._monotonic_s = monotonic_s
        self._wall_s = math.nan  # wall time at which the vehicle stood at `_simulated_us`
        self._simulated_us = 0

    @classmethod
    def parse(cls, text: str) -> "Clock":
        """Clock of `--speedup TEXT`: a factor, "max" or "lockstep".  Raises ValueError with a sentence for the user."""
        if text == "lockstep":
            return cls(lockstep=True)
        try:
            return cls(math.inf if text == "max" else float(text))
        except ValueError:
            raise ValueError(f"speedup {text!r} is no factor; give a number > 0, max or lockstep") from None

    def now_us(self) -> int:
        """Wall time from an arbitrary origin; never runs back."""
        return int(self._monotonic_s() * 1e6)

    def wait_s(self, simulated_us: int) -> float:
        """Real seconds to wait before the vehicle may stand at this time of the simulation; 0 when it is due."""
        if math.isinf(self.speedup):
            return 0.0
        now_s = self._monotonic_s()
        if math.isnan(self._wall_s):
            self._wall_s, self._simulated_us = now_s, simulated_us
        due_s = self._wall_s + (simulated_us - self._simulated_us) * 1e-6 / self.speedup
        if now_s - due_s > LARGEST_LAG_S:
            # A machine that slept or is too slow: what is lost is lost, rushing would starve whoever listens.
            self._wall_s, self._simulated_us = now_s, simulated_us
            return 0.0
        return max(0.0, due_s - now_s)
