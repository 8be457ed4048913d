"""The shape of most checks: one value of one message against its limit, while armed."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from companion.checks.finding import HOLD_S, Check, Excess, Result
from companion.checks.flight import Flight
from companion.dialect import Fields
from companion.frames import Frame


@dataclass(slots=True)
class Level:
    """A value that must not stand beyond its limit for hold_s while armed.

    read: the value, in the limit's unit, NaN while nothing can be judged.  nothing, beyond, within, below: see `Excess`.
    """

    check: Check
    flight: Flight
    read: Callable[[Fields], float]
    nothing: str
    beyond: str
    within: str
    below: bool = False
    hold_s: float = HOLD_S
    _excess: Excess = field(init=False)

    def __post_init__(self) -> None:
        self._excess = Excess(self.check.limit, self.hold_s, self.below)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        self._excess.take(t_s, self.read(fields) if self.flight.armed else math.nan)

    def finish(self) -> Result:
        return self._excess.result(self.check, self.nothing, self.beyond, self.within)
