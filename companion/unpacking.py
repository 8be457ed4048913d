"""The payloads of a log's frames unpacked into rows and columns, type by type; compiled.

Kernels take bare arrays; names, units and the room for the columns are one layer up, in `companion/columns.py`.  Where the
frames are is what `companion/walk.py` finds.
"""

from typing import NamedTuple, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.walk import Bytes, Frames, word

Column = NDArray[np.generic]


class Values(NamedTuple):
    """The same bytes as numbers of every kind that MAVLink has."""

    u1: NDArray[np.uint8]
    i1: NDArray[np.int8]
    u2: NDArray[np.uint16]
    i2: NDArray[np.int16]
    u4: NDArray[np.uint32]
    i4: NDArray[np.int32]
    u8: NDArray[np.uint64]
    i8: NDArray[np.int64]
    f4: NDArray[np.float32]
    f8: NDArray[np.float64]


def values(data: Bytes) -> Values:
    """data, (byte,), as numbers one behind the other."""
    kinds = (np.dtype(f"<{kind}") for kind in Values._fields)
    return Values(*(data[: len(data) // kind.itemsize * kind.itemsize].view(kind) for kind in kinds))


def values_at_every_byte(data: Bytes) -> Values:
    """data, (byte,), eight at least, as numbers that overlap: number k is the one that begins at byte k."""
    kinds = (np.dtype(f"<{kind}") for kind in Values._fields)
    return Values(*(np.ndarray(len(data) - kind.itemsize + 1, kind, data, strides=(1,)) for kind in kinds))


class Fields(NamedTuple):
    """What is to become of the fields of some message types; those of type t stand at first[t] to first[t + 1]."""

    first: NDArray[np.int64]  # (type + 1,)
    offset: NDArray[np.uint64]  # (field,), and so all below: byte in the payload
    kind: NDArray[np.int64]  # place in `Values`
    elements: NDArray[np.uint64]  # 1 for a single number
    factor: NDArray[np.float64]  # to SI; 1 leaves the bytes alone
    column: NDArray[np.uint64]  # where the column begins, in numbers of the kind that is written


@njit(cache=True)
def count_ids(ids: NDArray[np.int32], chosen: NDArray[np.bool_], counts: NDArray[np.int64]) -> None:
    """Chosen frames by message id, added to counts."""
    for f in range(ids.shape[0]):
        if chosen[f]:
            counts[np.uint64(ids[f])] += 1


class Rows(NamedTuple):
    """What is kept of a frame beside its fields, type by type; each (row,)."""

    frames: NDArray[np.int64]  # their numbers in the log
    stamps_us: NDArray[np.uint64]  # without the link's bits
    sysids: NDArray[np.uint8]
    compids: NDArray[np.uint8]

    @classmethod
    def empty(cls, count: int) -> Self:
        """Room for so many."""
        return cls(
            frames=np.empty(count, np.int64),
            stamps_us=np.empty(count, np.uint64),
            sysids=np.empty(count, np.uint8),
            compids=np.empty(count, np.uint8),
        )

    def part(self, piece: slice) -> Self:
        """Some of them, in the same memory."""
        return type(self)._make(column[piece] for column in self)


@njit(cache=True)
def spread(
    data: Bytes,
    frames: Frames,
    chosen: NDArray[np.bool_],
    types: NDArray[np.int16],
    sizes: NDArray[np.uint64],
    next_place: NDArray[np.uint64],
    next_word: NDArray[np.uint64],
    order: NDArray[np.uint32],
    payloads: NDArray[np.uint64],
) -> None:
    """The chosen frames type by type: their numbers, and their payloads, cut or filled with zeros to the definition's size.

    chosen: (frame,).  types, sizes: see `fill`.  next_place, next_word: (type,), where the next number goes in order,
    (frame,), and the next payload in payloads, (word,), both moved on.  One pass in the order of the file: gathering type by
    type goes through memory once a type, and takes four times as long.
    """
    n = np.uint64(data.shape[0])
    for f in range(frames.starts.shape[0]):
        if not chosen[f]:
            continue
        q = np.uint64(frames.starts[f])
        body = q + (np.uint64(10) if data[q] == 0xFD else np.uint64(6))
        t = np.uint64(types[np.uint64(frames.ids[f])])
        length = min(np.uint64(data[q + np.uint64(1)]), sizes[t])
        order[next_place[t]] = f
        next_place[t] += np.uint64(1)
        to = next_word[t]
        stop = to + (sizes[t] + np.uint64(7) >> np.uint64(3))
        next_word[t] = stop
        whole_end = to + (length >> np.uint64(3))
        while to < whole_end:
            payloads[to] = word(data, body)
            body += np.uint64(8)
            to += np.uint64(1)
        rest = length & np.uint64(7)
        if rest:
            last = np.uint64(0)
            if body + np.uint64(8) <= n:
                empty = np.uint64(8) * (np.uint64(8) - rest)
                last = word(data, body) << empty >> empty
            else:
                for k in range(rest):
                    last |= np.uint64(data[body + k]) << np.uint64(8) * k
            payloads[to] = last
            to += np.uint64(1)
        while to < stop:
            payloads[to] = 0
            to += np.uint64(1)


@njit(cache=True)
def fill_rows(frames: Frames, first: int, order: NDArray[np.uint32], rows: Rows, row: np.uint64) -> None:
    """The frames whose numbers are in order, counted from the log's frame `first`, into the rows from `row` on.

    Array by array: written while the frames are gone through, four streams for each type, they take twice as long.
    """
    count = np.uint64(order.shape[0])
    for k in range(count):
        rows.frames[row + k] = first + order[k]
    for k in range(count):
        rows.stamps_us[row + k] = frames.stamps_us[np.uint64(order[k])] & ~np.uint64(3)
    for k in range(count):
        source = frames.sources[np.uint64(order[k])]
        rows.sysids[row + k] = source >> np.uint16(8)
        rows.compids[row + k] = source & np.uint16(0xFF)


@njit(cache=True, inline="always")
def copy_field(
    wire: Column,
    at: np.uint64,
    row_bytes: np.uint64,
    width: np.uint64,
    rows: np.uint64,
    count: np.uint64,
    out: Column,
    to: np.uint64,
) -> None:
    """`count` numbers of each row as they are, from wire, first row at byte `at`, to out, first number at `to`."""
    if count == np.uint64(1):
        for r in range(rows):
            out[to + r] = wire[at + r * row_bytes]
    else:
        for r in range(rows):
            for k in range(count):
                out[to + r * count + k] = wire[at + r * row_bytes + k * width]


@njit(cache=True, inline="always")
def scale_field(
    wire: Column,
    factor: np.float64,
    at: np.uint64,
    row_bytes: np.uint64,
    width: np.uint64,
    rows: np.uint64,
    count: np.uint64,
    out: NDArray[np.float64],
    to: np.uint64,
) -> None:
    """As `copy_field`, times the factor: in double precision from any kind, which gives the bits of `decode.Decoder`."""
    if count == np.uint64(1):
        for r in range(rows):
            out[to + r] = wire[at + r * row_bytes] * factor
    else:
        for r in range(rows):
            for k in range(count):
                out[to + r * count + k] = wire[at + r * row_bytes + k * width] * factor


@njit(cache=True, inline="always")
def convert(
    fields: Fields, i: int, wire: Values, at: np.uint64, row_bytes: np.uint64, rows: np.uint64, done: np.uint64, out: Values
) -> None:
    """Field i of some payloads, the first at byte `at`, into its column behind the `done` rows it has.

    wire: `values_at_every_byte`, since fields appended to a message begin anywhere.
    """
    kind, count, factor = fields.kind[i], fields.elements[i], fields.factor[i]
    start, to = at + fields.offset[i], fields.column[i] + done * count
    one, two, four, eight = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(8)
    if factor == 1.0:
        if kind < 2:
            copy_field(wire.u1, start, row_bytes, one, rows, count, out.u1, to)
        elif kind < 4:
            copy_field(wire.u2, start, row_bytes, two, rows, count, out.u2, to)
        elif kind == 4 or kind == 5 or kind == 8:
            copy_field(wire.u4, start, row_bytes, four, rows, count, out.u4, to)
        else:
            copy_field(wire.u8, start, row_bytes, eight, rows, count, out.u8, to)
    elif kind == 0:
        scale_field(wire.u1, factor, start, row_bytes, one, rows, count, out.f8, to)
    elif kind == 1:
        scale_field(wire.i1, factor, start, row_bytes, one, rows, count, out.f8, to)
    elif kind == 2:
        scale_field(wire.u2, factor, start, row_bytes, two, rows, count, out.f8, to)
    elif kind == 3:
        scale_field(wire.i2, factor, start, row_bytes, two, rows, count, out.f8, to)
    elif kind == 4:
        scale_field(wire.u4, factor, start, row_bytes, four, rows, count, out.f8, to)
    elif kind == 5:
        scale_field(wire.i4, factor, start, row_bytes, four, rows, count, out.f8, to)
    elif kind == 6:
        scale_field(wire.u8, factor, start, row_bytes, eight, rows, count, out.f8, to)
    elif kind == 7:
        scale_field(wire.i8, factor, start, row_bytes, eight, rows, count, out.f8, to)
    elif kind == 8:
        scale_field(wire.f4, factor, start, row_bytes, four, rows, count, out.f8, to)
    else:
        scale_field(wire.f8, factor, start, row_bytes, eight, rows, count, out.f8, to)


@njit(cache=True)
def fill(
    data: Bytes,
    first: int,
    frames: Frames,
    chosen: NDArray[np.bool_],
    types: NDArray[np.int16],
    sizes: NDArray[np.uint64],
    first_row: NDArray[np.uint64],
    next_row: NDArray[np.uint64],
    fields: Fields,
    order: NDArray[np.uint32],
    payloads: NDArray[np.uint64],
    wire: Values,
    rows: Rows,
    out: Values,
) -> None:
    """The chosen frames into rows and columns, type by type.

    first: number of the first frame given.  chosen: (frame,).  types: by message id, the number of its type among those
    chosen.  sizes: (type,), bytes of the definition; first_row, next_row: (type,), its first row and its next one, moved on.
    order, payloads: room to work in, (frame,) and (word,); wire: payloads, at every byte.  out: all columns.
    """
    counts = np.zeros(sizes.shape[0], np.int64)
    for f in range(frames.ids.shape[0]):
        if chosen[f]:
            counts[types[frames.ids[f]]] += 1
    next_place, next_word = np.zeros_like(sizes), np.zeros_like(sizes)
    for t in range(1, sizes.shape[0]):
        before = np.uint64(counts[t - 1])
        next_place[t] = next_place[t - 1] + before
        next_word[t] = next_word[t - 1] + before * (sizes[t - 1] + np.uint64(7) >> np.uint64(3))
    spread(data, frames, chosen, types, sizes, next_place, next_word, order, payloads)
    for t in range(sizes.shape[0]):
        if counts[t]:
            count, row_bytes = np.uint64(counts[t]), sizes[t] + np.uint64(7) & ~np.uint64(7)
            fill_rows(frames, first, order[next_place[t] - count : next_place[t]], rows, next_row[t])
            at, done = np.uint64(8) * next_word[t] - count * row_bytes, next_row[t] - first_row[t]
            for i in range(fields.first[t], fields.first[t + 1]):
                convert(fields, i, wire, at, row_bytes, count, done, out)
            next_row[t] += count
