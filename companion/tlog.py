"""Telemetry logs: records of an 8 byte big-endian stamp (microseconds since 1970) and a raw frame.

The two lowest bits of a stamp are the link's number; OWN_LINK marks what we sent ourselves, as MAVProxy has it.  Reading
loses no good frame to damage: after a frame with a wrong CRC it looks for the next good one byte by byte.
"""

import gzip
import hashlib
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from companion.dialect import MAGIC_V1, recognised
from companion.errors import UserError
from companion.events import Json
from companion.frames import Check, Frame, IncompleteError, candidate

STAMP_BYTES: Final = 8
LINK_MASK: Final = 3
OWN_LINK: Final = 3
PLAUSIBLE_US: Final = range(946_684_800_000_000, 4_102_444_800_000_000)  # years 2000 to 2099


class Record(NamedTuple):
    """One frame of a log; stamp_us is None where the frame stood without one."""

    stamp_us: int | None
    frame: Frame

    @property
    def link(self) -> int | None:
        return None if self.stamp_us is None else self.stamp_us & LINK_MASK


def record(stamp_us: int, link: int, raw: bytes) -> bytes:
    """The bytes of one record.  stamp_us: a multiple of 4, so that the link's number fits below it."""
    return struct.pack(">Q", stamp_us | link) + raw


@dataclass(slots=True)
class Report:
    """What a reader met; names and counting rules as in the field `reader` of an analysis (docs/logs.md)."""

    bytes: int = 0
    frames_v1: int = 0
    frames_v2: int = 0
    signed: int = 0
    unstamped: int = 0
    crc_failures: int = 0
    crc_failure_ids: Counter[int] = field(default_factory=Counter)
    resyncs: int = 0
    resync_bytes: int = 0
    tail_bytes: int = 0
    unknown_frames: int = 0
    recognised: Counter[str] = field(default_factory=Counter)  # of the unknown ones, by `dialect.recognised`
    messages: Counter[str] = field(default_factory=Counter)
    stamps_backward: int = 0
    stamps_implausible: int = 0
    max_gap_us: int = 0
    first_us: int | None = None
    last_us: int | None = None
    sources: dict[tuple[int, int], "Source"] = field(default_factory=dict)
    sha256: str = ""
    frames_sha256: str = ""

    def as_json(self) -> dict[str, Json]:
        return {
            "frames_v1": self.frames_v1,
            "frames_v2": self.frames_v2,
            "signed": self.signed,
            "unstamped": self.unstamped,
            "crc_failures": self.crc_failures,
            "crc_failure_ids": {str(key): count for key, count in sorted(self.crc_failure_ids.items())},
            "resyncs": self.resyncs,
            "resync_bytes": self.resync_bytes,
            "tail_bytes": self.tail_bytes,
            "unknown_frames": self.unknown_frames,
            "recognised": dict(sorted(self.recognised.items())),
            "messages": dict(sorted(self.messages.items())),
            "sources": [
                {"sysid": sysid, "compid": compid, "frames": source.frames, "seq_lost": source.seq_lost}
                for (sysid, compid), source in self.sources.items()
            ],
            "stamps_backward": self.stamps_backward,
            "stamps_implausible": self.stamps_implausible,
            "max_gap_us": self.max_gap_us,
            "first_us": self.first_us,
            "last_us": self.last_us,
            "frames_sha256": self.frames_sha256,
        }


@dataclass(slots=True)
class Source:
    """One system and component of a log."""

    frames: int = 0
    seq_lost: int = 0
    last_seq: int | None = None


@dataclass(slots=True)
class Reader:
    """Walks one log.  Iterate it once; `report` is complete when the iteration is.

    Raises UserError for a file that cannot be read or holds no frame at all.
    """

    path: Path
    report: Report = field(default_factory=Report)

    def __iter__(self) -> Iterator[Record]:
        data = self._bytes()
        self.report.bytes = len(data)
        self.report.sha256 = hashlib.sha256(data).hexdigest()
        frames = hashlib.sha256()
        previous_us: int | None = None
        position = 0
        while position < len(data):
            found, position = self._next(data, position)
            if found is None:
                break
            frames.update(found.frame.raw)
            self._count(found.frame)
            if found.stamp_us is not None:
                previous_us = self._count_stamp(found.stamp_us, previous_us)
            yield found
        self.report.frames_sha256 = frames.hexdigest()
        if not self.report.frames_v1 + self.report.frames_v2:
            raise UserError(f"{self.path}: no MAVLink frame in {len(data)} bytes; is it a telemetry log?")

    def _bytes(self) -> bytes:
        try:
            data = self.path.read_bytes()
            return gzip.decompress(data) if self.path.suffix == ".gz" else data
        except (OSError, EOFError, zlib.error) as error:
            raise UserError(f"{self.path}: cannot read the log: {error}") from None

    def _next(self, data: bytes, position: int) -> tuple[Record | None, int]:
        """The frame at or behind `position`, and where the walk goes on."""
        stamped = _candidate(data, position + STAMP_BYTES)
        if stamped is not None and (stamped[1] is Check.GOOD or _confirmed(data, position + STAMP_BYTES)):
            return Record(_stamp(data, position), stamped[0]), position + STAMP_BYTES + len(stamped[0].raw)
        bare = _candidate(data, position)
        if bare is not None and bare[1] is Check.GOOD:
            self.report.unstamped += 1
            return Record(None, bare[0]), position + len(bare[0].raw)
        if stamped is not None and stamped[1] is Check.BAD:
            self.report.crc_failures += 1
            self.report.crc_failure_ids[stamped[0].message_id] += 1
        return self._resynchronise(data, position)

    def _resynchronise(self, data: bytes, position: int) -> tuple[Record | None, int]:
        for start in range(position + 1, len(data)):
            if start == position + STAMP_BYTES:
                continue
            found = _candidate(data, start)
            if found is None or found[1] is not Check.GOOD:
                continue
            stamp_us = _stamp(data, start - STAMP_BYTES) if start - STAMP_BYTES >= position else None
            skipped = start - position - (STAMP_BYTES if stamp_us is not None else 0)
            self.report.unstamped += stamp_us is None
            self.report.resyncs += skipped > 0
            self.report.resync_bytes += skipped
            return Record(stamp_us, found[0]), start + len(found[0].raw)
        self.report.tail_bytes = len(data) - position
        return None, len(data)

    def _count(self, frame: Frame) -> None:
        report = self.report
        if frame.raw[0] == MAGIC_V1:
            report.frames_v1 += 1
        else:
            report.frames_v2 += 1
            report.signed += frame.signed
        report.messages[frame.name] += 1
        if frame.definition is None:
            report.unknown_frames += 1
            if (name := recognised(frame.raw, frame.message_id)) is not None:
                report.recognised[name] += 1
            return
        source = report.sources.get((frame.sysid, frame.compid))
        if source is None:
            source = report.sources[frame.sysid, frame.compid] = Source()
        source.frames += 1
        if source.last_seq is not None:
            source.seq_lost += (frame.seq - source.last_seq - 1) % 256
        source.last_seq = frame.seq

    def _count_stamp(self, stamp_us: int, previous_us: int | None) -> int | None:
        report = self.report
        if stamp_us not in PLAUSIBLE_US:
            report.stamps_implausible += 1
            return previous_us
        if report.first_us is None:
            report.first_us = stamp_us
        report.last_us = stamp_us
        if previous_us is not None:
            report.stamps_backward += stamp_us < previous_us
            report.max_gap_us = max(report.max_gap_us, stamp_us - previous_us)
        return stamp_us


def _stamp(data: bytes, start: int) -> int:
    return int.from_bytes(data[start : start + STAMP_BYTES], "big")


def _candidate(data: bytes, start: int) -> tuple[Frame, Check] | None:
    if start >= len(data):
        return None
    try:
        return candidate(data, start)
    except IncompleteError:
        return None


def _confirmed(data: bytes, start: int) -> bool:
    """Is the unknown candidate at `start` followed, one stamp on, by a good frame, a confirmed one, or the end?"""
    while True:
        found = _candidate(data, start)
        if found is None or found[1] is Check.BAD:
            return False
        if found[1] is Check.GOOD:
            return True
        end = start + len(found[0].raw)
        if end == len(data):
            return True
        start = end + STAMP_BYTES
