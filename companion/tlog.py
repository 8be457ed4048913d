"""Telemetry logs: records of an 8 byte big-endian stamp (microseconds since 1970) and a raw frame.

The two lowest bits of a stamp are the link's number; OWN_LINK marks what we sent ourselves, as MAVProxy has it.  Reading
loses no good frame to damage: after a frame with a wrong CRC it looks for the next good one byte by byte.
"""

import gzip
import hashlib
import mmap
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Final, NamedTuple

from companion.dialect import MAGIC_V1, SIGNED, name_of, recognised
from companion.errors import UserError
from companion.events import Json
from companion.frames import Check, Frame, IncompleteError, Octets, candidate

STAMP_BYTES: Final = 8
LINK_MASK: Final = 3
OWN_LINK: Final = 3
PLAUSIBLE_US: Final = range(946_684_800_000_000, 4_102_444_800_000_000)  # years 2000 to 2099
FIRST_US, END_US = PLAUSIBLE_US.start, PLAUSIBLE_US.stop
WHOLE_BYTES: Final = 32 << 20
UNPACKED_BYTES: Final = 1 << 20
BATCH: Final = 4096


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
    last_seq: int = 0


class Tally:
    """Counts frames into a report, in the order of the log: all that does not need the bytes between them."""

    def __init__(self, report: Report) -> None:
        self.report = report
        self._hash = hashlib.sha256()
        self._sources: dict[int, Source] = {}
        self._previous_us: int | None = None

    def take(self, records: Sequence[Record]) -> None:
        """The next ones, the more at a time the better: half of the counters are written once a call."""
        report, sources = self.report, self._sources
        previous_us, max_gap_us = self._previous_us, report.max_gap_us
        version_1 = 0
        for stamp_us, (raw, message_id, sysid, compid, seq, message, _) in records:
            if raw[0] == MAGIC_V1:
                version_1 += 1
            elif raw[2] & SIGNED:
                report.signed += 1
            if stamp_us is None:
                report.unstamped += 1
            elif not FIRST_US <= stamp_us < END_US:
                report.stamps_implausible += 1
            else:
                if previous_us is None:
                    report.first_us = stamp_us
                elif stamp_us < previous_us:
                    report.stamps_backward += 1
                elif stamp_us - previous_us > max_gap_us:
                    max_gap_us = stamp_us - previous_us
                previous_us = stamp_us
            if message is None:
                report.unknown_frames += 1
                if (name := recognised(raw, message_id)) is not None:
                    report.recognised[name] += 1
                continue
            source = sources.get(sysid << 8 | compid)
            if source is None:
                source = sources[sysid << 8 | compid] = report.sources[sysid, compid] = Source(last_seq=(seq - 1) & 0xFF)
            source.frames += 1
            source.seq_lost += (seq - source.last_seq - 1) & 0xFF
            source.last_seq = seq
        report.frames_v1 += version_1
        report.frames_v2 += len(records) - version_1
        report.last_us = self._previous_us = previous_us
        report.max_gap_us = max_gap_us
        for message_id, count in Counter([frame.message_id for _, frame in records]).items():
            report.messages[name_of(message_id)] += count
        self._hash.update(b"".join([frame.raw for _, frame in records]))
        report.frames_sha256 = self._hash.hexdigest()


@dataclass(slots=True)
class Reader:
    """Walks one log.  Iterate it once; `report` is complete when the iteration is.

    Raises UserError for a file that cannot be read or holds no frame at all.
    """

    path: Path
    report: Report = field(default_factory=Report)

    def __iter__(self) -> Iterator[Record]:
        data = content(self.path)
        self.report.bytes = len(data)
        self.report.sha256 = hashlib.sha256(data).hexdigest()
        tally = Tally(self.report)
        batch: list[Record] = []
        position = 0
        while position < len(data):
            start = position + STAMP_BYTES
            stamped = _candidate(data, start)
            if stamped is not None and stamped[1] is Check.GOOD:
                # As in `frames.candidate`: past the named tuple's own constructor.
                record = tuple.__new__(Record, (int.from_bytes(data[position:start], "big"), stamped[0]))
                position = start + len(stamped[0].raw)
            else:
                found, position = self._next(data, position, stamped)
                if found is None:
                    break
                record = found
            batch.append(record)
            if len(batch) == BATCH:
                tally.take(batch)
                batch = []
            yield record
        tally.take(batch)
        if not self.report.frames_v1 + self.report.frames_v2:
            raise UserError(f"{self.path}: no MAVLink frame in {len(data)} bytes; is it a telemetry log?")

    def _next(self, data: Octets, position: int, stamped: tuple[Frame, Check] | None) -> tuple[Record | None, int]:
        """The frame at or behind `position`, where no good one stands one stamp on, and where the walk goes on."""
        start = position + STAMP_BYTES
        if stamped is not None and stamped[1] is Check.UNKNOWN and _confirmed(data, start):
            return Record(int.from_bytes(data[position:start], "big"), stamped[0]), start + len(stamped[0].raw)
        bare = _candidate(data, position)
        if bare is not None and bare[1] is Check.GOOD:
            return Record(None, bare[0]), position + len(bare[0].raw)
        if stamped is not None and stamped[1] is Check.BAD:
            self.report.crc_failures += 1
            self.report.crc_failure_ids[stamped[0].message_id] += 1
        return self._resynchronise(data, position)

    def _resynchronise(self, data: Octets, position: int) -> tuple[Record | None, int]:
        for start in range(position + 1, len(data)):
            if start == position + STAMP_BYTES:
                continue
            found = _candidate(data, start)
            if found is None or found[1] is not Check.GOOD:
                continue
            stamp = start - STAMP_BYTES
            stamp_us = int.from_bytes(data[stamp:start], "big") if stamp >= position else None
            skipped = start - position - (STAMP_BYTES if stamp_us is not None else 0)
            self.report.resyncs += skipped > 0
            self.report.resync_bytes += skipped
            return Record(stamp_us, found[0]), start + len(found[0].raw)
        self.report.tail_bytes = len(data) - position
        return None, len(data)


def content(path: Path) -> bytes | mmap.mmap:
    """The bytes of a log, unpacked if it is a `.gz`; more than WHOLE_BYTES of them are mapped, not held.

    What is unpacked goes block by block into a temporary file without a name.  Raises UserError for a file that cannot be
    read.
    """
    try:
        with path.open("rb") as file:
            if path.suffix != ".gz":
                size = os.fstat(file.fileno()).st_size
                return _mapped(file) if size > WHOLE_BYTES else file.read()
            with gzip.open(file) as unpacked:
                start = unpacked.read(WHOLE_BYTES)
                block = unpacked.read(UNPACKED_BYTES)
                if not block:
                    return start
                import tempfile  # for large logs alone: its own imports are many

                with tempfile.TemporaryFile() as whole:
                    whole.write(start)
                    while block:
                        whole.write(block)
                        block = unpacked.read(UNPACKED_BYTES)
                    whole.flush()
                    return _mapped(whole)
    except (OSError, EOFError, zlib.error) as error:
        raise UserError(f"{path}: cannot read the log: {error}") from None


def _mapped(file: IO[bytes]) -> mmap.mmap:
    return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def _candidate(data: Octets, start: int) -> tuple[Frame, Check] | None:
    if start >= len(data):
        return None
    try:
        return candidate(data, start)
    except IncompleteError:
        return None


def _confirmed(data: Octets, start: int) -> bool:
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
