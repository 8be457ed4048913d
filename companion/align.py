"""Samples onto the regular grid of the vehicle's clock, by stamps alone.

Row k of the grid stands at vehicle time k * period and holds for every channel the newest sample not newer than that.
It closes when a newer sample arrives, or when the arrival stamps say that it is one period overdue: never because a loop
happened to look.  Hence a live run, the replay of its log and any slicing of the bytes give the same rows.
"""

import math
from collections import Counter
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.decode import ClockKind, Sampled

OFFSET_HALF_WINDOW_US: Final = 5_000_000  # offset = smallest arrival - vehicle time over the last one to two of these
USEC_TOLERANCE_US: Final = 5_000_000  # a time_usec further from the boot clock than this is another clock (UNIX time)
REBOOT_BACK_US: Final = 2_000_000  # vehicle time running back by more is a reboot, by less a late message
JUMP_AHEAD_US: Final = 5_000_000  # and running ahead of the arrival stamps by more is a jump of its clock
BELIEVED_AFTER: Final = 3  # so many messages in a row must agree: one corrupt or late stamp restarts nothing
PAUSE_AFTER_US: Final = 10_000_000  # no rows are made for a vehicle that has been silent for longer
WRAP_MS: Final = 1 << 32
WRAP_US32: Final = 1 << 32


class Restart(Enum):
    """Why the grid began anew."""

    FIRST = "first"
    REBOOT = "reboot"  # the vehicle's clock ran back
    JUMP = "jump"  # it ran ahead
    SILENCE = "silence"  # samples came back after more than PAUSE_AFTER_US


@dataclass(frozen=True, slots=True)
class GridRow:
    """One closed row."""

    t_us: int  # vehicle time, since boot
    values: NDArray[np.float64]  # (1, channel): a batch of one flight; NaN where unknown
    age_s: NDArray[np.float64]  # (1, channel); NaN where unknown
    restart: Restart | None  # the reason, if the grid began anew with this row


@dataclass(slots=True)
class Aligner:
    """The grid of one vehicle.

    period_us: distance of the rows; maximal_age_us: (channel,) how long a value is held.  `counts` tells what was not
    used: stamps off the clock, samples before any clock was known.
    """

    period_us: int
    maximal_age_us: tuple[int, ...]
    counts: Counter[str] = field(default_factory=Counter)
    newest_us: int | None = None  # newest vehicle time heard
    offset_us: int | None = None  # arrival - vehicle time, at its smallest
    due_us: float = math.inf  # arrival stamp at which the open row is overdue; no row is before a clock is known
    _next_us: int = 0  # time of the open row
    _restart: Restart | None = None
    _half_windows: list[int | None] = field(default_factory=lambda: [None, None])
    _half_began_us: int = 0
    _last_stamped_arrival_us: int = 0
    _strange: int = 0  # how many messages in a row were off the clock, and agreed with each other
    _strange_offset_us: int = 0  # arrival - vehicle time of the last of them
    _stamps_us: list[int] = field(default_factory=list)
    _values: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._forget_samples()

    def _forget_samples(self) -> None:
        self._stamps_us = [0] * len(self.maximal_age_us)
        self._values = [math.nan] * len(self.maximal_age_us)

    def push(self, sampled: Sampled, arrival_us: int) -> list[GridRow]:
        """Take one message's samples; -> the rows that they close.  Call `due` with the same arrival stamp before."""
        t_us = self._unwrapped(sampled)
        if t_us is not None:
            if not self._follow(t_us, arrival_us, trusted=sampled.clock is ClockKind.BOOT_MS):
                return []
        elif self.newest_us is None:
            self.counts["before_clock"] += 1
            return []
        else:
            t_us = self._without_clock(arrival_us)
        rows: list[GridRow] = []
        while self._next_us < t_us:
            rows.append(self._close())
        for channel, value in sampled.values:
            if t_us >= self._stamps_us[channel] or math.isnan(self._values[channel]):
                self._stamps_us[channel] = t_us
                self._values[channel] = value
        return rows

    def due(self, arrival_us: int) -> list[GridRow]:
        """The rows that are overdue at this arrival stamp, oldest first."""
        rows: list[GridRow] = []
        if arrival_us < self.due_us:
            return rows  # asked at every frame, and nearly always so
        assert self.newest_us is not None  # else no row were due
        assert self.offset_us is not None
        last_us = min(arrival_us - self.offset_us - self.period_us - 1, self.newest_us + PAUSE_AFTER_US)
        while self._next_us <= last_us:
            rows.append(self._close())
        return rows

    def vehicle_time_us(self, arrival_us: int) -> int | None:
        """Vehicle time at an arrival stamp, as far as it is known: for events that no row brings."""
        if self.newest_us is None or self.offset_us is None:
            return None
        return max(self.newest_us, arrival_us - self.offset_us)

    def _unwrapped(self, sampled: Sampled) -> int | None:
        """The message's own time on the unwrapped boot clock, None if it has none that can be trusted."""
        if sampled.clock is ClockKind.NONE:
            return None
        if sampled.clock is ClockKind.BOOT_MS:
            if self.newest_us is None:
                return sampled.stamp * 1000
            turns = max(0, (self.newest_us // 1000 - sampled.stamp + WRAP_MS // 2) // WRAP_MS)  # the nearest
            return (turns * WRAP_MS + sampled.stamp) * 1000
        if self.newest_us is None:
            return None
        t_us = sampled.stamp
        if sampled.clock is ClockKind.USEC32:
            t_us += round((self.newest_us - t_us) / WRAP_US32) * WRAP_US32
        return t_us if abs(t_us - self.newest_us) <= USEC_TOLERANCE_US else None

    def _follow(self, t_us: int, arrival_us: int, *, trusted: bool) -> bool:
        """Move the clock with a stamped message; False if the message is off the clock and must not be used.

        trusted: its stamp alone may restart the clock.
        """
        if self.newest_us is None:
            self._begin(t_us, arrival_us, Restart.FIRST)
            return True
        silent_us = arrival_us - self._last_stamped_arrival_us
        ahead_us = t_us - self.newest_us
        if ahead_us < -REBOOT_BACK_US or ahead_us > max(silent_us, 0) + JUMP_AHEAD_US:
            self._strange = self._agreeing(arrival_us - t_us) if trusted else self._strange
            if not trusted or self._strange < BELIEVED_AFTER:
                self.counts["off_clock"] += 1
                return False
            self._begin(t_us, arrival_us, Restart.REBOOT if ahead_us < 0 else Restart.JUMP)
            return True
        self._strange = 0
        if ahead_us > PAUSE_AFTER_US:
            self._begin(t_us, arrival_us, Restart.SILENCE)
            return True
        self._learn_offset(arrival_us - t_us, arrival_us)
        if ahead_us >= 0:
            self.newest_us = t_us
            self._last_stamped_arrival_us = arrival_us
        return True

    def _agreeing(self, offset_us: int) -> int:
        """How many messages off the clock in a row tell one and the same other clock, this one included."""
        agrees = abs(offset_us - self._strange_offset_us) <= REBOOT_BACK_US
        self._strange_offset_us = offset_us
        return self._strange + 1 if agrees else 1

    def _begin(self, t_us: int, arrival_us: int, reason: Restart) -> None:
        self.newest_us = t_us
        self._last_stamped_arrival_us = arrival_us
        self._next_us = -(-t_us // self.period_us) * self.period_us
        self._restart = reason
        self._strange = 0
        self._forget_samples()
        self._half_windows = [None, None]
        self._half_began_us = arrival_us
        self._learn_offset(arrival_us - t_us, arrival_us)

    def _learn_offset(self, offset_us: int, arrival_us: int) -> None:
        if arrival_us - self._half_began_us >= OFFSET_HALF_WINDOW_US:
            self._half_windows = [self._half_windows[1], None]
            self._half_began_us = arrival_us
        newest = self._half_windows[1]
        self._half_windows[1] = offset_us if newest is None else min(newest, offset_us)
        self.offset_us = min(offset for offset in self._half_windows if offset is not None)
        self.due_us = self._next_us + self.offset_us + self.period_us + 1

    def _without_clock(self, arrival_us: int) -> int:
        """Time of a sample whose message carries none.

        While stamped messages flow it belongs to the newest of them: that depends on the order of the frames alone.  Where
        they have stopped, the arrival stamp less the offset and the patience of one period stands in.
        """
        assert self.newest_us is not None
        assert self.offset_us is not None
        return max(self.newest_us, arrival_us - self.offset_us - self.period_us)

    def _close(self) -> GridRow:
        t_us = self._next_us
        values, ages_s = [], []
        for stamp_us, value, maximal_us in zip(self._stamps_us, self._values, self.maximal_age_us, strict=True):
            age_us = t_us - stamp_us
            held = 0 <= age_us <= maximal_us and not math.isnan(value)
            values.append(value if held else math.nan)
            ages_s.append(age_us * 1e-6 if held else math.nan)
        row = GridRow(t_us, np.array([values], dtype=np.float64), np.array([ages_s], dtype=np.float64), self._restart)
        self._restart = None
        self._next_us = t_us + self.period_us
        self.due_us += self.period_us
        return row
