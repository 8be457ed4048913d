"""The walk over a log's bytes, compiled: where the frames are, and whether they may be believed.

The rules are those of docs/logs.md.  `companion/tlog.py` walks by the same rules in plain Python, frame by frame, where
numba is not installed; the tests hold the two against each other.  Kernels take bare arrays; names and units are one layer
up, in `companion/columns.py`.
"""

from functools import cache
from typing import Final

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
def crc16(data: Bytes, start: int, end: int, seed: np.uint64, tables: NDArray[np.uint16]) -> np.uint64:
    """CRC-16/MCRF4XX over data[start:end] and the seed byte behind it: eight bytes at a time, then four, two, one.

    Unsigned all through: a signed index would cost a test for negative ones at each look-up.
    """
    eight, low = np.uint64(8), np.uint64(0xFF)
    crc = np.uint64(0xFFFF)
    at = start
    while end - at >= 8:
        first, second = np.uint64(data[at]) ^ (crc & low), np.uint64(data[at + 1]) ^ (crc >> eight)
        crc = np.uint64(
            tables[1792 + first]
            ^ tables[1536 + second]
            ^ tables[1280 + data[at + 2]]
            ^ tables[1024 + data[at + 3]]
            ^ tables[768 + data[at + 4]]
            ^ tables[512 + data[at + 5]]
            ^ tables[256 + data[at + 6]]
            ^ tables[data[at + 7]]
        )
        at += 8
    if end - at >= 4:
        first, second = np.uint64(data[at]) ^ (crc & low), np.uint64(data[at + 1]) ^ (crc >> eight)
        crc = np.uint64(tables[768 + first] ^ tables[512 + second] ^ tables[256 + data[at + 2]] ^ tables[data[at + 3]])
        at += 4
    if end - at >= 2:
        first, second = np.uint64(data[at]) ^ (crc & low), np.uint64(data[at + 1]) ^ (crc >> eight)
        crc = np.uint64(tables[256 + first] ^ tables[second])
        at += 2
    if at < end:
        crc = (crc >> eight) ^ np.uint64(tables[(crc ^ np.uint64(data[at])) & low])
    return (crc >> eight) ^ np.uint64(tables[(crc ^ seed) & low])


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


# The walk's first look at each place is nearly every look: a copy of its own, so that it is compiled into the loop.
first_candidate = njit(inline="always")(candidate.py_func)


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
def walk(
    data: Bytes,
    position: int,
    extras: NDArray[np.int16],
    tables: NDArray[np.uint16],
    starts: NDArray[np.int64],
    sizes: NDArray[np.uint16],
    flags: NDArray[np.uint8],
    ids: NDArray[np.int32],
    sources: NDArray[np.uint16],
    seqs: NDArray[np.uint8],
    stamps_us: NDArray[np.uint64],
    counters: NDArray[np.int64],
    failed_ids: NDArray[np.int64],
    skips: NDArray[np.int64],
) -> tuple[int, int]:
    """Frames from `position` on, as many as the arrays hold: (frames, position to go on from).

    starts to stamps_us: (frame,), filled; see `columns.Index`.  counters: (COUNTERS,), added to.  failed_ids, skips: ids of
    CRC failures, and (offset, length) in turn of skipped bytes, from the first of the log on, as many as fit.
    """
    n = data.shape[0]
    count, room = 0, starts.shape[0]
    while position >= 0 and position < n and count < room:  # said to be positive: spares a test at each look-up
        start = position + 8
        flag = 0
        status, end = first_candidate(data, start, n, extras, tables)
        if status != GOOD:
            if status == UNKNOWN and confirmed(data, end, n, extras, tables):
                flag = IS_UNKNOWN
            else:
                start, end, flag = find_again(data, position, n, extras, tables, counters, failed_ids, skips)
                if start >= n:
                    position = n
                    break
        if data[start] == 0xFD:
            flag |= IS_V2
            if data[start + 2] & 1:
                flag |= IS_SIGNED
            seqs[count] = data[start + 4]
            sources[count] = np.uint16(data[start + 5]) << np.uint16(8) | np.uint16(data[start + 6])
        else:
            seqs[count] = data[start + 2]
            sources[count] = np.uint16(data[start + 3]) << np.uint16(8) | np.uint16(data[start + 4])
        stamp = np.uint64(0)
        if not flag & UNSTAMPED:
            for k in range(start - 8, start):
                stamp = stamp << np.uint64(8) | np.uint64(data[k])
        starts[count] = start
        sizes[count] = end - start
        flags[count] = flag
        ids[count] = message_id_at(data, start)
        stamps_us[count] = stamp
        count += 1
        position = end
    return count, position


@njit(cache=True)
def spread(
    data: Bytes,
    first: int,
    starts: NDArray[np.int64],
    ids: NDArray[np.int32],
    sources: NDArray[np.uint16],
    stamps_us: NDArray[np.uint64],
    chosen: NDArray[np.bool_],
    sizes: NDArray[np.int64],
    next_byte: NDArray[np.int64],
    next_row: NDArray[np.int64],
    payloads: Bytes,
    row_frames: NDArray[np.int64],
    row_stamps_us: NDArray[np.uint64],
    row_sysids: NDArray[np.uint8],
    row_compids: NDArray[np.uint8],
) -> None:
    """Payloads of the chosen frames, type by type, cut or filled with zeros to the size of the definition.

    first: number of the first frame given.  starts to chosen: (frame,).  sizes: by message id; next_byte, next_row: by
    message id, where its next payload and its next row go, both moved on.  payloads: flat bytes, row_*: flat by row, all
    filled; stamps without the link's bits.  One pass in the order of the file: gathering type by type goes through memory
    once a type, and takes ten times as long.
    """
    for f in range(starts.shape[0]):
        if not chosen[f]:
            continue
        q = starts[f]
        body = q + 10 if data[q] == 0xFD else q + 6
        message_id = ids[f]
        size = sizes[message_id]
        length = min(np.int64(data[q + 1]), size)
        to = next_byte[message_id]
        next_byte[message_id] = to + size
        row = next_row[message_id]
        next_row[message_id] = row + 1
        row_frames[row] = first + f
        row_stamps_us[row] = stamps_us[f] & ~np.uint64(3)
        row_sysids[row] = sources[f] >> np.uint16(8)
        row_compids[row] = sources[f] & np.uint16(0xFF)
        source, target = data[body : body + length], payloads[to : to + length]
        for k in range(length):
            target[k] = source[k]
        for k in range(to + length, to + size):
            payloads[k] = 0


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
