"""Bytes of one peer in, MAVLink frames out: CRC always checked, resynchronised byte by byte after damage.

Pure: no socket, no clock.  A frame with a wrong CRC is never given out.  A frame whose message id is not known cannot be
checked; it is given out marked as such (to be recorded and forwarded, never believed) where the bytes behind it fit.
"""

from collections import Counter
from dataclasses import dataclass, field
from enum import Enum
from struct import Struct
from typing import Final, NamedTuple, Protocol, overload

from fastcrc.crc16 import mcrf4xx

from companion.dialect import (
    CRC_BYTES,
    LONGEST_FRAME_BYTES,
    MAGIC_V1,
    MAGIC_V2,
    SIGNATURE_BYTES,
    SIGNED,
    Definition,
    Value,
    decode_fields,
    definition,
    name_of,
)

_HEADER_V2: Final = Struct("<BBBBBBHB").unpack  # behind the magic byte


class Frame(NamedTuple):
    """One frame as it stood on the wire.

    A named tuple, as one is made for every frame: a frozen dataclass of seven fields takes three times as long.
    """

    raw: bytes
    message_id: int
    sysid: int
    compid: int
    seq: int
    definition: Definition | None  # None: an id we do not know, whose CRC could not be checked
    payload: bytes

    @property
    def name(self) -> str:
        return self.definition.name if self.definition else name_of(self.message_id)

    @property
    def signed(self) -> bool:
        return self.raw[0] == MAGIC_V2 and bool(self.raw[2] & SIGNED)

    def fields(self) -> dict[str, Value]:
        """All fields by name; nothing of an unknown message."""
        return decode_fields(self.definition, self.payload) if self.definition else {}


class IncompleteError(Exception):
    """The candidate at this place ends behind the bytes at hand."""


class Check(Enum):
    """What the CRC says of a candidate."""

    GOOD = "good"
    BAD = "bad"
    UNKNOWN = "unknown"  # an id whose seed we do not know: it cannot be checked


class Octets(Protocol):
    """Bytes at hand: `bytes`, or a file that is mapped."""

    @overload
    def __getitem__(self, place: int, /) -> int: ...
    @overload
    def __getitem__(self, place: slice, /) -> bytes: ...
    def __len__(self) -> int: ...


def candidate(data: Octets, start: int) -> tuple[Frame, Check] | None:
    """Look for a frame at `start`; None where none can begin.

    Raises IncompleteError if the bytes at hand end before the frame does.
    """
    magic = data[start]
    if magic == MAGIC_V2:
        body = start + 10
        if len(data) < body:
            raise IncompleteError
        length, flags, _, seq, sysid, compid, low, high = _HEADER_V2(data[start + 1 : body])
        if flags & ~SIGNED:
            return None
        message_id = low | high << 16
        stop = body + length
        end = stop + CRC_BYTES + (SIGNATURE_BYTES if flags else 0)
    elif magic == MAGIC_V1:
        body = start + 6
        if len(data) < body:
            raise IncompleteError
        length, seq, sysid, compid, message_id = data[start + 1 : body]
        stop = body + length
        end = stop + CRC_BYTES
    else:
        return None
    if len(data) < end:
        raise IncompleteError
    message = definition(message_id)
    check = Check.UNKNOWN
    if message is not None:
        crc = data[stop] | data[stop + 1] << 8
        check = Check.GOOD if mcrf4xx(data[start + 1 : stop] + message.seed) == crc else Check.BAD
    # Past the named tuple's own constructor, which takes half the time of all this again.
    return tuple.__new__(Frame, (data[start:end], message_id, sysid, compid, seq, message, data[body:stop])), check


@dataclass(slots=True)
class Splitter:
    """The byte stream of one peer.  What it met is counted in `counts`."""

    counts: Counter[str] = field(default_factory=Counter)
    _pending: bytes = b""

    def feed(self, data: bytes) -> list[Frame]:
        """Take what arrived, give out the frames that are complete.  Any slicing of the bytes gives the same frames."""
        data = self._pending + data if self._pending else data
        frames: list[Frame] = []
        start = 0
        while start < len(data):
            try:
                found = candidate(data, start)
                # An unknown id is a frame only if another one begins right behind it: one byte decides, and where it
                # has not arrived yet we wait for it, so that the answer does not depend on how the bytes were sliced.
                if found is not None and found[1] is Check.UNKNOWN:
                    behind = start + len(found[0].raw)
                    if behind == len(data):
                        raise IncompleteError
                    if data[behind] not in (MAGIC_V1, MAGIC_V2):
                        found = None
            except IncompleteError:
                break
            if found is None or found[1] is Check.BAD:
                self.counts["bad_crc"] += found is not None
                self.counts["skipped_bytes"] += 1
                start += 1
                continue
            frame, check = found
            self.counts["frames" if check is Check.GOOD else "unknown_frames"] += 1
            frames.append(frame)
            start += len(frame.raw)
        self._pending = data[start:]
        assert len(self._pending) <= LONGEST_FRAME_BYTES  # IncompleteError is raised for less than one longest frame
        return frames
