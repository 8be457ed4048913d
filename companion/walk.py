"""The walk over a log's bytes, compiled: where the frames are, and whether they may be believed.

The rules of the walk are those of docs/logs.md.  `companion/tlog.py` walks by the same rules in plain Python, frame by
frame, where numba is not installed; the tests hold the two against each other.  What is in the frames is the subject of
`companion/unpacking.py`.
"""

from functools import cache
from typing import Final, NamedTuple, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.dialect import known_ids

GOOD: Final = 1
BAD: Final = 2
UNKNOWN: Final = 3
STAMP_BYTES: Final = 8
UNSTAMPED: Final = 1  # flags of a frame
IS_V2: Final = 2
IS_SIGNED: Final = 4
IS_UNKNOWN: Final = 8

# columns of the counters that the walk keeps
RESYNCS, RESYNC_BYTES, TAIL_BYTES, CRC_FAILURES, GAPS, COUNTERS = 0, 1, 2, 3, 4, 5

Bytes = NDArray[np.uint8]


class Frames(NamedTuple):
    """Where the frames of a log are, and what their headers say; each (frame,)."""

    starts: NDArray[np.int64]  # of the magic byte
    sizes: NDArray[np.uint16]  # of the whole frame, signature included
    flags: NDArray[np.uint8]  # UNSTAMPED, IS_V2, IS_SIGNED, IS_UNKNOWN
    ids: NDArray[np.int32]
    sources: NDArray[np.uint16]  # sysid * 256 + compid
    seqs: NDArray[np.uint8]
    stamps_us: NDArray[np.uint64]  # with the link's bits; 0 where there is none

    @classmethod
    def empty(cls, count: int) -> Self:
        """Room for so many."""
        return cls(
            starts=np.empty(count, np.int64),
            sizes=np.empty(count, np.uint16),
            flags=np.empty(count, np.uint8),
            ids=np.empty(count, np.int32),
            sources=np.empty(count, np.uint16),
            seqs=np.empty(count, np.uint8),
            stamps_us=np.empty(count, np.uint64),
        )

    def part(self, piece: slice) -> Self:
        """Some of them, in the same memory."""
        return type(self)._make(column[piece] for column in self)


@cache
def crc_tables() -> NDArray[np.uint16]:
    """(8 * 256,): CRC-16/MCRF4XX of a byte followed by 0, 1, ... 7 zero bytes, one table of 256 behind the other."""
    tables = np.zeros((8, 256), dtype=np.uint16)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ 0x8408 if crc & 1 else crc >> 1
        tables[0, byte] = crc
    for more in range(1, 8):
        below = tables[more - 1]
        tables[more] = below >> 8 ^ tables[0][below & 0xFF]
    return tables.ravel()


@cache
def seeds() -> NDArray[np.int16]:
    """By message id: CRC_EXTRA, or -1 for an id that the dialect does not know."""
    known = known_ids()
    table = np.full(max(known) + 1, -1, dtype=np.int16)
    for message_id, seed in known.items():
        table[message_id] = seed
    return table


@njit(cache=True, inline="always")
def word(data: Bytes, at: np.uint64) -> np.uint64:
    """The eight bytes at `at`, the first lowest: one load, since the index is unsigned."""
    found = np.uint64(0)
    for k in range(8):
        found |= np.uint64(data[at + np.uint64(k)]) << np.uint64(8 * k)
    return found


@njit(cache=True, inline="always")
def stamp_at(data: Bytes, at: np.uint64) -> np.uint64:
    """The eight bytes at `at`, the first highest."""
    found = np.uint64(0)
    for k in range(8):
        found = found << np.uint64(8) | np.uint64(data[at + np.uint64(k)])
    return found


@njit(cache=True, inline="always")
def crc_step(state: np.uint64, eight: np.uint64, tables: NDArray[np.uint16]) -> np.uint64:
    """The CRC state behind eight more bytes, the first lowest."""
    mixed, crc = state ^ eight, np.uint16(0)
    for k in range(8):
        crc ^= tables[np.uint64(1792 - 256 * k) + (mixed >> np.uint64(8 * k) & np.uint64(0xFF))]
    return np.uint64(crc)


@njit(cache=True, inline="always")
def crc_byte(state: np.uint64, byte: np.uint64, tables: NDArray[np.uint16]) -> np.uint64:
    """The CRC state behind one more byte."""
    return state >> np.uint64(8) ^ np.uint64(tables[(state ^ byte) & np.uint64(0xFF)])


@njit(cache=True, inline="always")
def crc_begun(odd: np.uint64, eight: np.uint64, tables: NDArray[np.uint16]) -> np.uint64:
    """The CRC state behind the first `odd` bytes, 1 to 7, the last of the eight; what stands before them does not matter.

    They are put behind zeros, which leave a state of zero alone.  The state at the begin, 0xFFFF, is then the same as their
    first two bytes turned over; where there is one byte alone, the other half stays in the state.
    """
    zeros = np.uint64(8) * (np.uint64(8) - odd)
    crc = crc_step(np.uint64(0), eight >> zeros << zeros ^ np.uint64(0xFFFF) << zeros, tables)
    return np.uint64(crc ^ np.uint64(0xFF) if odd == np.uint64(1) else crc)


@njit(cache=True, inline="always")
def crc_words(crc: np.uint64, data: Bytes, at: np.uint64, stop: np.uint64, tables: NDArray[np.uint16]) -> np.uint64:
    """The CRC state behind data[at:stop], whole words of eight bytes."""
    while at < stop:
        crc = crc_step(crc, word(data, at), tables)
        at += np.uint64(8)
    return crc


@njit(cache=True)
def crc16(data: Bytes, start: int, end: int, seed: np.uint64, tables: NDArray[np.uint16]) -> np.uint64:
    """CRC-16/MCRF4XX over data[start:end] and the seed byte behind it: the odd bytes first, then eight at a time.

    Unsigned all through: a signed index would cost a test for negative ones at each look-up.
    """
    crc, at, stop = np.uint64(0xFFFF), np.uint64(start), np.uint64(end)
    odd = (stop - at) & np.uint64(7)
    if odd and at >= np.uint64(8):
        crc = crc_begun(odd, word(data, at + odd - np.uint64(8)), tables)
        at += odd
    while (stop - at) & np.uint64(7):
        crc = crc_byte(crc, np.uint64(data[at]), tables)
        at += np.uint64(1)
    return np.uint64(crc_byte(crc_words(crc, data, at, stop, tables), seed, tables))


@njit(cache=True)
def candidate(data: Bytes, q: int, n: int, extras: NDArray[np.int16], tables: NDArray[np.uint16]) -> tuple[int, int]:
    """A frame at q: (0, 0) none can be, else (GOOD, BAD or UNKNOWN, where it ends)."""
    if q + 8 > n:
        return 0, 0
    magic = data[q]
    length = int(np.int64(data[q + 1]))
    if magic == 0xFD:
        if q + 12 > n or data[q + 2] & 0xFE:
            return 0, 0
        body = q + 10
        message_id = np.int64(data[q + 7]) | np.int64(data[q + 8]) << 8 | np.int64(data[q + 9]) << 16
        end = body + length + 2
        if data[q + 2] & 1:
            end += 13
    elif magic == 0xFE:
        body = q + 6
        message_id = np.int64(data[q + 5])
        end = body + length + 2
    else:
        return 0, 0
    if end > n:
        return 0, 0
    if message_id >= extras.shape[0] or extras[message_id] < 0:
        return UNKNOWN, end
    crc = crc16(data, q + 1, body + length, np.uint64(extras[message_id]), tables)
    if np.int64(crc) == np.int64(data[body + length]) | np.int64(data[body + length + 1]) << 8:
        return GOOD, end
    return BAD, end


@njit(cache=True)
def confirmed(data: Bytes, end: int, n: int, extras: NDArray[np.int16], tables: NDArray[np.uint16]) -> bool:
    """Is an unknown candidate that ends here followed by a good one, a chain of unknown ones to a good one, or the end?"""
    while end != n:
        status, end = candidate(data, end + 8, n, extras, tables)
        if status == GOOD:
            return True
        if status != UNKNOWN:
            return False
    return True


@njit(cache=True, inline="always")
def message_id_at(data: Bytes, q: int) -> int:
    if data[q] == 0xFD:
        return int(np.int64(data[q + 7]) | np.int64(data[q + 8]) << 8 | np.int64(data[q + 9]) << 16)
    return int(np.int64(data[q + 5]))


@njit(cache=True)
def find_again(
    data: Bytes,
    position: int,
    n: int,
    extras: NDArray[np.int16],
    tables: NDArray[np.uint16],
    counters: NDArray[np.int64],
    failed_ids: NDArray[np.int64],
    skips: NDArray[np.int64],
) -> tuple[int, int, int]:
    """The next frame where none stands one stamp behind `position`: (start, end, flags); start is n where there is none."""
    end, flag = n, 0
    found, bare_end = candidate(data, position, n, extras, tables)
    if found == GOOD:
        return position, bare_end, UNSTAMPED
    status, _ = candidate(data, position + 8, n, extras, tables)
    if status == BAD:
        if counters[CRC_FAILURES] < failed_ids.shape[0]:
            failed_ids[counters[CRC_FAILURES]] = message_id_at(data, position + 8)
        counters[CRC_FAILURES] += 1
    start, found = position, 0
    while found != GOOD:
        start += 1
        if start >= n:
            break
        magic = data[start]
        if (magic == 0xFD or magic == 0xFE) and start != position + 8:
            found, end = candidate(data, start, n, extras, tables)
    if found != GOOD:
        start, skipped = n, n - position
        counters[TAIL_BYTES] = skipped
    elif start - 8 >= position:
        skipped = start - 8 - position
    else:
        skipped, flag = start - position, UNSTAMPED
    if skipped > 0:
        gap = 2 * counters[GAPS]
        if gap + 1 < skips.shape[0]:
            skips[gap], skips[gap + 1] = position, skipped
        counters[GAPS] += 1
        if start < n:
            counters[RESYNCS] += 1
            counters[RESYNC_BYTES] += skipped
    return start, end, flag


@njit(cache=True)
def good_frames(
    data: Bytes,
    position: int,
    count: int,
    extras: NDArray[np.int16],
    tables: NDArray[np.uint16],
    frames: Frames,
) -> tuple[int, int]:
    """Stamped good frames, one behind the other, up to the first place that is anything else: (frames, position there).

    count: frames that `frames` holds already.  What stops here is judged by `walk`.  Nearly all of a log is good
    frames, and with the other cases in the same loop they take four times as long.  The CRC takes whole words of eight
    bytes, since steps of four, two and one are branches that no processor foresees; those before the odd ones at its begin
    are the stamp's.
    """
    one, eight = np.uint64(1), np.uint64(8)
    n, known = np.uint64(data.shape[0]), np.uint64(extras.shape[0])
    at, f, room = np.uint64(position), np.uint64(count), np.uint64(frames.starts.shape[0])
    while at + np.uint64(20) <= n and f < room:
        q = at + eight
        magic = data[q]
        length = np.uint64(data[q + one])
        flag, signature = np.uint8(0), np.uint64(0)
        if magic == 0xFD:
            flag = np.uint8(IS_V2)
            if data[q + np.uint64(2)]:
                if data[q + np.uint64(2)] != 1:
                    break
                flag, signature = np.uint8(IS_V2 | IS_SIGNED), np.uint64(13)
            message_id = np.uint64(data[q + np.uint64(7)])
            message_id |= np.uint64(data[q + eight]) << eight | np.uint64(data[q + np.uint64(9)]) << np.uint64(16)
            checked = length + np.uint64(9)
            sender = q + np.uint64(4)
        elif magic == 0xFE:
            message_id = np.uint64(data[q + np.uint64(5)])
            checked = length + np.uint64(5)
            sender = q + np.uint64(2)
        else:
            break
        body_end = q + one + checked
        end = body_end + np.uint64(2) + signature
        if end > n or message_id >= known or extras[message_id] < 0:
            break
        odd = checked & np.uint64(7)
        whole = q + one + odd
        crc = np.uint64(0xFFFF)
        if odd:
            crc = crc_begun(odd, word(data, whole - eight), tables)
        crc = crc_byte(crc_words(crc, data, whole, body_end, tables), np.uint64(extras[message_id]), tables)
        if crc != np.uint64(data[body_end]) | np.uint64(data[body_end + one]) << eight:
            break
        frames.starts[f] = q
        frames.sizes[f] = end - q
        frames.flags[f] = flag
        frames.ids[f] = message_id
        frames.sources[f] = np.uint16(data[sender + one]) << np.uint16(8) | np.uint16(data[sender + np.uint64(2)])
        frames.seqs[f] = data[sender]
        frames.stamps_us[f] = stamp_at(data, at)
        f += one
        at = end
    return int(np.int64(f)), int(np.int64(at))


@njit(cache=True)
def walk(
    data: Bytes,
    position: int,
    extras: NDArray[np.int16],
    tables: NDArray[np.uint16],
    frames: Frames,
    counters: NDArray[np.int64],
    failed_ids: NDArray[np.int64],
    skips: NDArray[np.int64],
) -> tuple[int, int]:
    """Frames from `position` on, as many as the arrays hold: (frames, position to go on from).

    frames: filled.  counters: (COUNTERS,), added to.  failed_ids, skips: ids of CRC failures, and
    (offset, length) in turn of skipped bytes, from the first of the log on, as many as fit.
    """
    n = data.shape[0]
    count, room = 0, frames.starts.shape[0]
    good = True  # so was the last frame, and stamped; behind any other the call would not pay: some logs have no stamps
    while True:
        if good:
            count, position = good_frames(data, position, count, extras, tables, frames)
        if position >= n or count >= room:
            break
        start = position + 8
        flag = 0
        status, end = candidate(data, start, n, extras, tables)
        good = status == GOOD
        if not good:
            if status == UNKNOWN and confirmed(data, end, n, extras, tables):
                flag = IS_UNKNOWN
            else:
                start, end, flag = find_again(data, position, n, extras, tables, counters, failed_ids, skips)
                if start >= n:
                    position = n
                    break
        sender = start + 2
        if data[start] == 0xFD:
            sender = start + 4
            flag |= IS_V2
            if data[start + 2] & 1:
                flag |= IS_SIGNED
        frames.starts[count] = start
        frames.sizes[count] = end - start
        frames.flags[count] = flag
        frames.ids[count] = message_id_at(data, start)
        frames.sources[count] = np.uint16(data[sender + 1]) << np.uint16(8) | np.uint16(data[sender + 2])
        frames.seqs[count] = data[sender]
        frames.stamps_us[count] = np.uint64(0) if flag & UNSTAMPED else stamp_at(data, np.uint64(start - 8))
        count += 1
        position = end
    return count, position


@njit(cache=True)
def pack(data: Bytes, starts: NDArray[np.int64], sizes: NDArray[np.uint16], packed: Bytes) -> None:
    """The bytes of all frames, one behind the other."""
    to = 0
    for f in range(starts.shape[0]):
        size = int(sizes[f])
        source, target = data[starts[f] : starts[f] + size], packed[to : to + size]
        for k in range(size):
            target[k] = source[k]
        to += size
