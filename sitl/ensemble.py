"""Thousands of flights of one airframe, in batches: faults drawn by each flight's seed, rows as a companion would take them.

Knows no airframe and no monitor: it is handed a fleet, and gives the rows of a grid.  A row depends on the flight's seed
alone, neither on its company in the batch nor on who flies it.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.random import PCG64, Generator
from numpy.typing import NDArray

from sitl.link import Link, Listener
from sitl.vehicle import Fleet, Injected, Vehicle

RELEASE_US: Final = 5_000_000  # boot time at which the vehicle arms and releases itself, as the autopilot's does
LAST_ONSET_S: Final = 500
AFTER_ONSET_S: Final = 100  # is flown after the onset, where the flight is long enough
HEALTHY: Final = "none"  # among the faults to draw from
ARMED: Final = "armed"  # the channel that no fleet has: the vehicle's heartbeat says it
_FAULT_STREAM: Final = 1  # second word of the seeds: these draws are nobody else's

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Grid:
    """The rows that are wanted."""

    channels: tuple[str, ...]
    period_us: int
    maximal_age_us: tuple[int, ...]  # by channel: an older value is unknown


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the grid for every flight of the batch."""

    t_us: int  # since release; before it the vehicle stands and says what its sensors say then
    values: FloatArray  # (flight, channel), NaN where unknown
    age_s: FloatArray  # (flight, channel), NaN where unknown
    flying: BoolArray  # (flight,), released and not yet down


class _Line(Protocol):
    """What stands between the fleet and the rows."""

    @property
    def row(self) -> tuple[FloatArray, FloatArray]: ...

    def take(self, now_us: int, values: FloatArray, age_s: FloatArray, armed: BoolArray) -> None: ...


class Direct:
    """No line at all: rows are the fleet's own channels at the instants of the grid, unrounded, none missing.

    Arming is heard of a step before the row at which it happens, for a heartbeat has no time of its own and belongs to the
    newest stamp before it.
    """

    def __init__(self, channels: Sequence[str], grid: Grid) -> None:
        """channels: of the fleet.  Raises ValueError for a channel of the grid that neither it nor the heartbeat has."""
        if missing := set(grid.channels) - {*channels, ARMED}:
            raise ValueError(f"the simulator does not give the channel {', '.join(sorted(missing))}")
        self._taken = [c for c, name in enumerate(grid.channels) if name != ARMED]
        self._columns = [channels.index(grid.channels[c]) for c in self._taken]
        self._armed_column = [c for c, name in enumerate(grid.channels) if name == ARMED]
        self._maximal_age_s = np.array(grid.maximal_age_us)[self._taken] * 1e-6 + 5e-7  # half the resolution of a stamp
        self._period_us = grid.period_us
        self._width = len(grid.channels)
        self._next: tuple[FloatArray, FloatArray] = np.zeros((0, 0)), np.zeros((0, 0))
        self._row = self._next
        self._is_new = False

    @property
    def row(self) -> tuple[FloatArray, FloatArray]:
        """(values, age_s), (flight, channel), of the row one period before the last step on the grid."""
        return self._row

    def take(self, now_us: int, values: FloatArray, age_s: FloatArray, armed: BoolArray) -> None:
        """As `Link.take`."""
        if self._is_new:
            self._next[0][:, self._armed_column] = armed[:, None]
            self._is_new = False
        if now_us % self._period_us:
            return
        self._row = self._next
        shape = (values.shape[0], self._width)
        taken, age = values[:, self._columns], age_s[:, self._columns]
        unknown = np.isnan(taken) | ~(age <= self._maximal_age_s)
        taken[unknown] = math.nan
        age[unknown] = math.nan
        self._next = np.empty(shape), np.zeros(shape)
        self._next[0][:, self._taken], self._next[1][:, self._taken] = taken, age
        self._is_new = True


class Ensemble:
    """One batch under way: a fleet just built, and how its rows are taken."""

    def __init__(
        self, vehicle: Vehicle, fleet: Fleet, seeds: Sequence[int], grid: Grid, listener: Listener | None = None
    ) -> None:
        """listener: takes the rows behind a line that rounds, loses and delays; None: `Direct`.

        Raises ValueError if the simulator has a channel too few, or no step that fits into the grid's period.
        """
        self.fleet = fleet
        self.touchdown_us = np.full(len(seeds), -1, dtype=np.int64)  # since release, -1: not yet down
        self._grid = grid
        self._step_s = step_s(vehicle, grid.period_us)
        self._line: _Line = (
            Direct(fleet.channels, grid) if listener is None else Link(vehicle, fleet.channels, listener, seeds)
        )

    def rows(self, duration_s: float) -> Iterator[Row]:
        """Fly; every row, from the first one on the ground to the last before touchdown or duration_s after release.

        To be called once.  Ends early when all flights are down.
        """
        period_us, dt_us = self._grid.period_us, round(self._step_s * 1e6)
        values, age_s = self.fleet.observe()
        armed = np.zeros(self.touchdown_us.size, dtype=np.bool_)
        flying = armed
        for now_us in range(dt_us, RELEASE_US + round(duration_s * 1e6) + 1, dt_us):
            if now_us > RELEASE_US:
                values, age_s = self.fleet.step(self._step_s)
                landed = self.fleet.landed
                self.touchdown_us[landed & (self.touchdown_us < 0)] = now_us - RELEASE_US
                armed = ~landed
            elif now_us == RELEASE_US:
                armed = np.ones_like(armed)
            self._line.take(now_us, values, age_s, armed)
            if (now_us - dt_us) % period_us == 0:
                flying = armed
            if now_us % period_us == 0 and now_us > period_us:
                t_us = now_us - period_us - RELEASE_US
                yield Row(t_us, *self._line.row, flying if t_us >= 0 else np.zeros_like(flying))
                if t_us >= 0 and not flying.any():
                    return


def step_s(vehicle: Vehicle, period_us: int) -> float:
    """The step that the fleet makes for rows of this period: the first of its own of which it is a whole multiple."""
    for candidate_s in vehicle.steps_s:
        if period_us % round(candidate_s * 1e6) == 0:
            return candidate_s
    raise ValueError(f"no step of the simulator ({vehicle.steps_s} s) fits into rows of {period_us / 1e6:g} s")


def last_onset_s(duration_s: float) -> int:
    """The latest onset that is drawn in flights of this duration, a whole second."""
    return max(0, min(LAST_ONSET_S, int(duration_s) - AFTER_ONSET_S))


def draw_faults(
    seeds: Sequence[int], choices: Sequence[str], known: Sequence[str], duration_s: float
) -> list[Injected | None]:
    """What happens to each flight: one of choices with even chance, at a whole second, and a place where it is left open.

    choices: ids CLASS[:PLACE][/KIND], or "none"; known: CLASS[:PLACE] of every fault of the airframe.  What is drawn
    depends on the flight's seed and the arguments alone.  A kind or value left open is drawn by the fleet.  Raises
    ValueError for a choice that the airframe does not know.
    """
    places: dict[str, list[str]] = {}
    for choice in choices:
        name, slash, kind = choice.partition("/")
        places[choice] = [each + slash + kind for each in known if each == name or each.startswith(f"{name}:")]
        if choice != HEALTHY and not places[choice]:
            raise ValueError(f"unknown fault {choice!r}; this airframe knows {', '.join(known)}, and {HEALTHY}")
    drawn: list[Injected | None] = []
    for seed in seeds:
        chance = Generator(PCG64([seed, _FAULT_STREAM]))
        choice = choices[int(chance.integers(len(choices)))]
        onset_s = float(chance.integers(last_onset_s(duration_s) + 1))
        where = places[choice]
        place = int(chance.random() * len(where))
        drawn.append(None if choice == HEALTHY else Injected(where[place], onset_s))
    return drawn
