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
RESYNCS, RESYNC_BYTES, TAIL_BYTES, CRC_FAILURES, COUNTERS = 0, 1, 2, 3, 4

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


@njit(cache=True)
def message_id_at(data: Bytes, q: int) -> int:
    if data[q] == 0xFD:
        return int(np.int64(data[q + 7]) | np.int64(data[q + 8]) << 8 | np.int64(data[q + 9]) << 16)
    return int(np.int64(data[q + 5]))


@njit(cache=True)
def walk(
    data: Bytes,
    position: int,
    extras: NDArray[np.int16],
    tables: NDArray[np.uint16],
    starts: NDArray[np.int64],
    ends: NDArray[np.int64],
    flags: NDArray[np.uint8],
    counters: NDArray[np.int64],
    failed_ids: NDArray[np.int64],
    skips: NDArray[np.int64],
) -> tuple[int, int, int, int]:
    """Frames from `position` on, as many as the arrays hold.

    starts, ends, flags: (frame,), filled; a stamp is the 8 bytes before the start unless UNSTAMPED.  counters: (COUNTERS,),
    added to.  failed_ids, skips: ids of CRC failures, and (offset, length) in turn of skipped bytes, as far as they fit.
    -> (frames, position to go on from, failed ids, skips).
    """
    n = data.shape[0]
    count, failures, gaps = 0, 0, 0
    while position < n and count < starts.shape[0]:
        status, end = first_candidate(data, position + 8, n, extras, tables)
        if status == GOOD or (status == UNKNOWN and confirmed(data, end, n, extras, tables)):
            start, flag = position + 8, 0
            if status == UNKNOWN:
                flag = IS_UNKNOWN
        else:
            bare, bare_end = candidate(data, position, n, extras, tables)
            if bare == GOOD:
                start, end, flag = position, bare_end, UNSTAMPED
            else:
                if status == BAD:
                    counters[CRC_FAILURES] += 1
                    if failures < failed_ids.shape[0]:
                        failed_ids[failures] = message_id_at(data, position + 8)
                        failures += 1
                start = position
                found = 0
                while found != GOOD:
                    start += 1
                    if start >= n:
                        break
                    magic = data[start]
                    if (magic == 0xFD or magic == 0xFE) and start != position + 8:
                        found, end = candidate(data, start, n, extras, tables)
                if found != GOOD:
                    counters[TAIL_BYTES] = n - position
                    if gaps + 1 < skips.shape[0]:
                        skips[gaps], skips[gaps + 1] = position, n - position
                        gaps += 2
                    position = n
                    break
                if start - 8 >= position:
                    skipped, flag = start - 8 - position, 0
                else:
                    skipped, flag = start - position, UNSTAMPED
                if skipped > 0:
                    counters[RESYNCS] += 1
                    counters[RESYNC_BYTES] += skipped
                    if gaps + 1 < skips.shape[0]:
                        skips[gaps], skips[gaps + 1] = position, skipped
                        gaps += 2
        if data[start] == 0xFD:
            flag |= IS_V2
            if data[start + 2] & 1:
                flag |= IS_SIGNED
        starts[count] = start
        ends[count] = end
        flags[count] = flag
        count += 1
        position = end
    return count, position, failures, gaps


@njit(cache=True)
def describe(
    data: Bytes,
    starts: NDArray[np.int64],
    flags: NDArray[np.uint8],
    ids: NDArray[np.int32],
    sources: NDArray[np.uint16],
    seqs: NDArray[np.uint8],
    stamps_us: NDArray[np.uint64],
) -> None:
    """Per frame: message id, sysid * 256 + compid, sequence number, stamp as it stands (0 where there is none)."""
    for f in range(starts.shape[0]):
        q = starts[f]
        ids[f] = message_id_at(data, q)
        if data[q] == 0xFD:
            seqs[f] = data[q + 4]
            sources[f] = np.uint16(data[q + 5]) * np.uint16(256) + np.uint16(data[q + 6])
        else:
            seqs[f] = data[q + 2]
            sources[f] = np.uint16(data[q + 3]) * np.uint16(256) + np.uint16(data[q + 4])
        stamp = np.uint64(0)
        if not flags[f] & UNSTAMPED:
            for k in range(q - 8, q):
                stamp = stamp << np.uint64(8) | np.uint64(data[k])
        stamps_us[f] = stamp


@njit(cache=True)
def spread(
    data: Bytes,
    starts: NDArray[np.int64],
    ids: NDArray[np.int32],
    chosen: NDArray[np.bool_],
    sizes: NDArray[np.int64],
    next_byte: NDArray[np.int64],
    next_row: NDArray[np.int64],
    payloads: Bytes,
    frames: NDArray[np.int64],
) -> None:
    """Payloads of the chosen frames, type by type, cut or filled with zeros to the size of the definition.

    chosen: (frame,).  sizes: by message id; next_byte, next_row: by message id, where its next payload and its next frame
    number go, both moved on.  payloads: flat bytes, frames: flat numbers, both filled.  One pass in the order of the file:
    gathering type by type goes through memory once a type, and takes ten times as long.
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
        frames[next_row[message_id]] = f
        next_row[message_id] += 1
        source, target = data[body : body + length], payloads[to : to + length]
        for k in range(length):
            target[k] = source[k]
        for k in range(to + length, to + size):
            payloads[k] = 0


@njit(cache=True)
def pack(data: Bytes, starts: NDArray[np.int64], ends: NDArray[np.int64], packed: Bytes) -> None:
    """The bytes of all frames, one behind the other."""
    to = 0
    for f in range(starts.shape[0]):
        source, target = data[starts[f] : ends[f]], packed[to : to + ends[f] - starts[f]]
        for k in range(source.shape[0]):
            target[k] = source[k]
        to += source.shape[0]
