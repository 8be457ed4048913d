"""Bytes of one peer in, MAVLink frames out: CRC always checked, resynchronised byte by byte after damage.

Pure: no socket, no clock.  A frame with a wrong CRC is never given out.  A frame whose message id is not known cannot be
checked; it is given out marked as such (to be recorded and forwarded, never believed) where the bytes behind it fit.
"""

from collections import Counter
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

from fastcrc.crc16 import mcrf4xx

from companion.dialect import (
    CRC_BYTES,
    HEADER_BYTES,
    LONGEST_FRAME_BYTES,
    MAGIC_V1,
    MAGIC_V2,
    SIGNATURE_BYTES,
    SIGNED,
    Definition,
    Value,
    decode_fields,
    definition,
)


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
        return self.definition.name if self.definition else f"UNKNOWN_{self.message_id}"

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


def candidate(data: bytes, start: int) -> tuple[Frame, Check] | None:
    """Look for a frame at `start`; None where none can begin.

    Raises IncompleteError if the bytes at hand end before the frame does.
    """
    magic = data[start]
    if magic not in HEADER_BYTES:
        return None
    header = HEADER_BYTES[magic]
    if len(data) < start + header:
        raise IncompleteError
    length = data[start + 1]
    end = start + header + length + CRC_BYTES
    if magic == MAGIC_V2:
        flags = data[start + 2]
        if flags & ~SIGNED:
            return None
        seq, sysid, compid = data[start + 4], data[start + 5], data[start + 6]
        message_id = data[start + 7] | data[start + 8] << 8 | data[start + 9] << 16
        if flags & SIGNED:
            end += SIGNATURE_BYTES
    else:
        seq, sysid, compid, message_id = data[start + 2], data[start + 3], data[start + 4], data[start + 5]
    if len(data) < end:
        raise IncompleteError
    body = start + header
    message = definition(message_id)
    payload = data[body : body + length]
    check = Check.UNKNOWN
    if message is not None:
        crc = data[body + length] | data[body + length + 1] << 8
        fits = mcrf4xx(data[start + 1 : body + length] + bytes((message.crc_extra,))) == crc
        check = Check.GOOD if fits else Check.BAD
    return Frame(data[start:end], message_id, sysid, compid, seq, message, payload), check


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
