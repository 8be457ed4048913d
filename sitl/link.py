"""What a radio or a loaded serial line leaves of a fleet's channels, in batch: rounding, losses, lateness, held values.

The rows are those that a companion in lockstep would take from the real bytes of an autopilot behind such a line
(`Pipe` spoils those bytes with the same draws, one flight at a time).  What the listener makes of a field is its own
table (`Reading`), handed in: the simulator's tables and the listener's stay apart, so that a wrong sign cannot cancel.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.random import PCG64, Generator
from numpy.typing import NDArray

from sitl.autopilot.frames import MARKER_V2, layout
from sitl.autopilot.streams import LONGEST_AGE_S, UNKNOWN
from sitl.kernel import kernel
from sitl.vehicle import Stream, Vehicle
from sitl.wire import INTEGER_TYPES, field_type

LOST: Final = 0.02  # share of messages that never arrive
LATE: Final = 0.10  # share that arrives with the next sample, of messages as frequent as the rows
NEVER_LATE: Final = frozenset({"GLOBAL_POSITION_INT", "GPS_RAW_INT", "GPS2_RAW"})  # a receiver's own line loses, no more
HEARTBEAT: Final = "HEARTBEAT"
HEARTBEAT_US: Final = 1_000_000
CHANGED, REGULAR, STREAMS = 0, 1, 2  # slots of messages: a heartbeat that tells of arming, a regular one, the streams
BLOCK_STEPS: Final = 100  # draws are made for so many steps at once
_LINK_STREAM: Final = 2  # second word of the seeds: these draws are nobody else's

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Reading:
    """What a listener takes from one field of a message: wire value * factor, into one channel of its row."""

    message: str
    field: str
    channel: int  # column of the listener's row
    factor: float
    unknown: float = math.nan  # wire value that says nothing; NaN: there is none
    limit: float = math.inf  # a larger magnitude is no measurement: as if it had not come


@dataclass(frozen=True, slots=True)
class Listener:
    """Who takes rows from the line, how long a value is held for each column of a row, and how bad the line is."""

    readings: tuple[Reading, ...]
    rates_hz: Mapping[str, float]  # of the messages that were asked for; others come at their stock rate
    period_us: int  # of the rows
    maximal_age_us: tuple[int, ...]  # by channel
    lost: float = LOST  # share of the messages, 0..1
    late: float = LATE


@dataclass(frozen=True, slots=True)
class _Field:
    """One reading, with what the autopilot does to it before."""

    column: int  # of the fleet, -1: a constant
    constant: float
    scale: float
    offset: float
    integer: bool
    double: bool
    low: float
    high: float
    nothing: float  # what an integer field carries for NaN; NaN: the whole message stays away
    reading: Reading


@dataclass(frozen=True, slots=True)
class _Message:
    """One slot: a message that the listener reads."""

    name: str
    interval_us: int
    tick_us: int  # resolution of its own time; 0: it has none
    leading: int  # column of the fleet whose age puts the stamp back
    needed: tuple[int, ...]  # columns of the fleet without which it stays away
    fields: tuple[_Field, ...]


def _ends(kind: str, nothing: float) -> tuple[float, float]:
    """What an integer field holds; the value that means "unknown" is not given to a known quantity at the edge."""
    if kind not in INTEGER_TYPES:
        return -math.inf, math.inf
    ends = np.iinfo(kind.removesuffix("_t"))
    low, high = float(ends.min), float(ends.max)
    if high > ends.max:  # beyond 2**53 a float64 does not hold every integer
        high = math.nextafter(high, 0.0)
    return low, high - 1.0 if nothing == high else high


def _field(stream: Stream, reading: Reading, channels: Sequence[str]) -> _Field:
    kind = field_type(stream.message, reading.field)
    integer = kind in INTEGER_TYPES
    nothing = float(UNKNOWN.get((stream.message, reading.field), math.nan)) if integer else math.nan
    low, high = _ends(kind, nothing)
    carried = next((field for field in stream.fields if field.name == reading.field), None)
    if carried is None:
        constant = float(stream.constants.get(reading.field, UNKNOWN.get((stream.message, reading.field), 0.0)))
        if kind == "float":
            constant = float(np.float32(constant))
        return _Field(-1, constant, 1.0, 0.0, integer, kind == "double", low, high, nothing, reading)
    column = channels.index(carried.channel)
    return _Field(column, 0.0, carried.scale, carried.offset, integer, kind == "double", low, high, nothing, reading)


def _message(stream: Stream, listener: Listener, channels: Sequence[str]) -> _Message:
    fields = layout(stream.message).first_slot
    rate_hz = listener.rates_hz.get(stream.message, stream.stock_hz)
    needed = (
        channels.index(field.channel)
        for field in stream.fields
        if field_type(stream.message, field.name) in INTEGER_TYPES and (stream.message, field.name) not in UNKNOWN
    )
    return _Message(
        stream.message,
        round(1e6 / rate_hz) if rate_hz > 0.0 else 0,
        1000 if "time_boot_ms" in fields else 1 if "time_usec" in fields else 0,
        channels.index(stream.fields[0].channel) if stream.fields else -1,
        tuple(dict.fromkeys(needed)),
        tuple(_field(stream, reading, channels) for reading in listener.readings if reading.message == stream.message),
    )


def _messages(vehicle: Vehicle, channels: Sequence[str], listener: Listener) -> tuple[_Message, ...]:
    """The slots, in the order in which the autopilot sends within one step."""
    read = {reading.message for reading in listener.readings}
    beat = _Message(HEARTBEAT, HEARTBEAT_US, 0, -1, (), ())
    return (beat, beat, *(_message(each, listener, channels) for each in vehicle.streams if each.message in read))


def _delayable(message: _Message, listener: Listener) -> bool:
    return message.interval_us == listener.period_us and message.name not in NEVER_LATE


class _Chances:
    """One uniform number for each flight, step and message, from the flight's own seed; drawn whether needed or not."""

    def __init__(self, seeds: Sequence[int], messages: int) -> None:
        self._sources = tuple(Generator(PCG64([seed, _LINK_STREAM])) for seed in seeds)
        self.values: FloatArray = np.empty((len(self._sources), BLOCK_STEPS, messages))
        self._row = BLOCK_STEPS - 1

    def next_row(self) -> int:
        """Index of this step's row in `values`, (flight, BLOCK_STEPS, message)."""
        self._row += 1
        if self._row == BLOCK_STEPS:
            self._row = 0
            for source, block in zip(self._sources, self.values, strict=True):
                source.random(out=block)
        return self._row


@kernel
def _close(
    row_us: int, maximal_age_us: IntArray, held: FloatArray, held_us: IntArray, values: FloatArray, age_s: FloatArray
) -> None:
    """One flight's row from its held samples, all (channel,): NaN where there is none, or too old a one."""
    for c in range(held.size):
        age_us = row_us - held_us[c]
        known = held[c] == held[c] and 0 <= age_us <= maximal_age_us[c]
        values[c] = held[c] if known else math.nan
        age_s[c] = age_us * 1e-6 if known else math.nan


@kernel
def _hold(
    stamp_us: int, received: FloatArray, first: int, last: int, columns: IntArray, held: FloatArray, held_us: IntArray
) -> None:
    """The samples of one message, received[first:last], into one flight's held ones, unless these are newer."""
    for r in range(first, last):
        c = columns[r]
        if received[r] == received[r] and (stamp_us >= held_us[c] or held[c] != held[c]):
            held[c] = received[r]
            held_us[c] = stamp_us


@kernel
def _listen(
    now_us: int,
    row_us: int,
    period_us: int,
    row_ends: bool,
    chances: FloatArray,
    shares: FloatArray,
    present: BoolArray,
    stamped: BoolArray,
    delayable: BoolArray,
    stamps_us: IntArray,
    received: FloatArray,
    first: IntArray,
    columns: IntArray,
    maximal_age_us: IntArray,
    newest_us: IntArray,
    held: FloatArray,
    held_us: IntArray,
    late_due_us: IntArray,
    late_stamps_us: IntArray,
    late: FloatArray,
    is_open: BoolArray,
    values: FloatArray,
    age_s: FloatArray,
) -> None:
    """One step of every flight: what was sent in it, then what was late, close the row at row_us and are held.

    chances, present, stamps_us: (flight, message); shares: lost, late; received: (flight, reading), those of message m
    from first[m] to first[m + 1]; late_*: (flight, message, 2), the two slots in turn; the rest as `Link` keeps it.
    """
    flights, messages = present.shape
    slot = now_us // period_us % 2
    for f in range(flights):
        for arriving_late in range(2):
            for m in range(messages):
                sent_us = stamps_us[f, m]
                if arriving_late == 0:
                    chance = chances[f, m]
                    if not present[f, m] or chance < shares[0]:
                        continue
                    if delayable[m] and chance < shares[0] + shares[1]:
                        late_due_us[f, m, slot] = now_us + period_us
                        late_stamps_us[f, m, slot] = sent_us
                        late[f, slot, first[m] : first[m + 1]] = received[f, first[m] : first[m + 1]]
                        continue
                else:
                    if late_due_us[f, m, 1 - slot] != now_us:
                        continue
                    sent_us = late_stamps_us[f, m, 1 - slot]
                if stamped[m]:
                    stamp_us = sent_us
                    newest_us[f] = max(newest_us[f], stamp_us)
                elif newest_us[f] < 0:
                    continue  # no clock is known yet
                else:
                    stamp_us = max(newest_us[f], now_us - period_us)
                if is_open[f] and stamp_us > row_us:
                    is_open[f] = False
                    _close(row_us, maximal_age_us, held[f], held_us[f], values[f], age_s[f])
                taken = received[f] if arriving_late == 0 else late[f, 1 - slot]
                _hold(stamp_us, taken, first[m], first[m + 1], columns, held[f], held_us[f])
        if row_ends:
            if is_open[f]:
                _close(row_us, maximal_age_us, held[f], held_us[f], values[f], age_s[f])
            is_open[f] = True


class Link:
    """The line of every flight of a batch, and what the listener behind it knows.

    Feed `take` with every step of the boot clock, from the first on; after a step that ends on the grid, `row` holds what
    the listener knows of the row one period before: by then it is complete.
    """

    def __init__(self, vehicle: Vehicle, channels: Sequence[str], listener: Listener, seeds: Sequence[int]) -> None:
        """channels: of the fleet.  Raises KeyError or ValueError for a message, field or channel that does not exist."""
        n, width = len(seeds), len(listener.maximal_age_us)
        self._messages = _messages(vehicle, channels, listener)
        self._fields = tuple(field for message in self._messages for field in message.fields)
        beats = [reading for reading in listener.readings if reading.message == HEARTBEAT]
        self._beats = len(beats)  # readings of a heartbeat, all of them of arming; both slots carry them
        sizes = [self._beats, self._beats, *(len(message.fields) for message in self._messages[STREAMS:])]
        self._first = np.concatenate(([0], np.cumsum(sizes))).astype(np.int64)
        columns = [reading.channel for reading in [*beats, *beats, *(field.reading for field in self._fields)]]
        self._columns = np.array(columns, dtype=np.int64)
        self._period_us = listener.period_us
        self._maximal_age_us = np.array(listener.maximal_age_us, dtype=np.int64)
        self._chances = _Chances(seeds, len(self._messages))
        self._shares = np.array([listener.lost, listener.late])
        self._stamped = np.array([message.tick_us > 0 for message in self._messages])
        self._delayable = np.array([_delayable(message, listener) for message in self._messages])
        self._armed = np.zeros(n, dtype=np.bool_)
        self._before_us = 0  # the step before
        self._newest_us = np.full(n, -1, dtype=np.int64)
        self._held, self._held_us = np.full((n, width), math.nan), np.zeros((n, width), dtype=np.int64)
        shape = (n, len(self._messages), 2)
        self._late_due_us, self._late_stamps_us = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
        self._late = np.zeros((n, 2, len(columns)))
        self._open = np.ones(n, dtype=np.bool_)
        self._row = np.full((n, width), math.nan), np.full((n, width), math.nan)
        self._round = _rounding(self._fields)
        self._received = np.empty((n, len(columns)))

    @property
    def row(self) -> tuple[FloatArray, FloatArray]:
        """(values, age_s), (flight, channel), new arrays, of the row that the last step on the grid has completed."""
        values, age_s = self._row
        return values.copy(), age_s.copy()

    def take(self, now_us: int, values: FloatArray, age_s: FloatArray, armed: BoolArray) -> None:
        """One step at boot time now_us: (flight, channel) values and ages as `Fleet.observe`, (flight,) armed."""
        received = self._received
        received[:, : 2 * self._beats] = armed[:, None]
        received[:, 2 * self._beats :] = self._round(values)
        ends = now_us % self._period_us == 0
        _listen(
            now_us,
            (now_us - 1) // self._period_us * self._period_us,
            self._period_us,
            ends,
            self._chances.values[:, self._chances.next_row()],
            self._shares,
            self._present(now_us, values, armed),
            self._stamped,
            self._delayable,
            self._stamps_us(now_us, values, age_s),
            received,
            self._first,
            self._columns,
            self._maximal_age_us,
            self._newest_us,
            self._held,
            self._held_us,
            self._late_due_us,
            self._late_stamps_us,
            self._late,
            self._open,
            *self._row,
        )
        self._armed = armed.copy()
        self._before_us = now_us

    def _present(self, now_us: int, values: FloatArray, armed: BoolArray) -> BoolArray:
        """Which messages are sent in this step, (flight, message)."""
        due = [
            message.interval_us > 0 and now_us // message.interval_us > self._before_us // message.interval_us
            for message in self._messages
        ]
        present = np.empty((armed.size, len(due)), dtype=np.bool_)
        present[:] = due
        present[:, CHANGED] = armed != self._armed
        if np.isnan(values).any():
            for m, message in enumerate(self._messages):
                if message.needed:
                    present[:, m] &= ~np.isnan(values[:, message.needed]).any(axis=1)
        return present

    def _stamps_us(self, now_us: int, values: FloatArray, age_s: FloatArray) -> IntArray:
        """The time that each message of this step carries, (flight, message); now_us where it has none."""
        stamps_us = np.full((values.shape[0], len(self._messages)), now_us, dtype=np.int64)
        for m, message in enumerate(self._messages):
            if message.tick_us and message.leading >= 0:
                known = ~np.isnan(values[:, message.leading])
                back_s = np.where(known, np.minimum(age_s[:, message.leading], LONGEST_AGE_S), 0.0)
                stamp_us = np.maximum(now_us - np.rint(back_s * 1e6).astype(np.int64), 0)
                stamps_us[:, m] = stamp_us // message.tick_us * message.tick_us
        return stamps_us


def _rounding(fields: Sequence[_Field]) -> Callable[[FloatArray], FloatArray]:
    """A function from (flight, channel) values of the fleet to what the listener reads, (flight, reading); NaN: nothing."""
    columns = np.array([max(field.column, 0) for field in fields], dtype=np.intp)
    constant = np.array([field.column < 0 for field in fields], dtype=np.bool_)
    constants = np.array([field.constant for field in fields])
    scale, offset = np.array([field.scale for field in fields]), np.array([field.offset for field in fields])
    integer = np.array([field.integer for field in fields], dtype=np.bool_)
    single = ~integer & ~np.array([field.double for field in fields], dtype=np.bool_)
    low, high = np.array([field.low for field in fields]), np.array([field.high for field in fields])
    nothing = np.array([field.nothing for field in fields])
    factor = np.array([field.reading.factor for field in fields])
    unknown = np.array([field.reading.unknown for field in fields])
    limit = np.array([field.reading.limit for field in fields])

    def read(values: FloatArray) -> FloatArray:
        wire: FloatArray = values[:, columns] * scale + offset
        np.copyto(wire, np.minimum(np.maximum(np.rint(wire), low), high), where=integer)
        with np.errstate(over="ignore"):  # what a float32 cannot carry becomes infinite on the wire
            np.copyto(wire, wire.astype(np.float32), where=single)
        np.copyto(wire, nothing, where=np.isnan(wire))
        wire[:, constant] = constants[constant]
        taken: FloatArray = wire * factor
        said_nothing = (wire == unknown) | ~(np.abs(taken) <= limit)
        taken[said_nothing] = math.nan
        return taken

    return read


class Pipe:
    """The line of one flight for the real frames of an autopilot, with the draws that `Link` makes for the same seed.

    Frames of messages that the listener does not read pass undisturbed.
    """

    def __init__(self, vehicle: Vehicle, channels: Sequence[str], listener: Listener, seed: int) -> None:
        """As `Link`."""
        messages = _messages(vehicle, channels, listener)
        self._slots = {layout(message.name).id: m for m, message in enumerate(messages)}
        self._delayable = [_delayable(message, listener) for message in messages]
        self._period_us = listener.period_us
        self._chances = _Chances([seed], len(messages))
        self._lost, self._late = listener.lost, listener.lost + listener.late
        self._now_us = 0  # what is said at boot comes before the first draw
        self._armed = False
        self._chance: FloatArray = np.ones(len(messages))
        self._changed = False
        self._waiting: list[tuple[int, int, bytes]] = []  # due, slot, frame

    def carry(self, frames: Iterable[bytes], now_us: int, armed: bool) -> list[bytes]:
        """What arrives of these frames (MAVLink 2), sent at boot time now_us by an autopilot that is armed or not."""
        if now_us != self._now_us:
            self._now_us = now_us
            self._chance = self._chances.values[0, self._chances.next_row()].copy()
            self._changed, self._armed = armed != self._armed, armed
        arriving: list[bytes] = []
        for frame in frames:
            slot = self._slots.get(int.from_bytes(frame[7:10], "little")) if frame[0] == MARKER_V2 else None
            if slot is None:
                arriving.append(frame)
                continue
            if slot == REGULAR and self._changed:
                slot, self._changed = CHANGED, False
            if self._chance[slot] < self._lost:
                continue
            if self._delayable[slot] and self._chance[slot] < self._late:
                self._waiting.append((now_us + self._period_us, slot, frame))
                continue
            arriving.append(frame)
        due = sorted((slot, frame) for due_us, slot, frame in self._waiting if due_us <= now_us)
        self._waiting = [each for each in self._waiting if each[0] > now_us]
        return arriving + [frame for _, frame in due]
