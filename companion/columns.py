"""A whole log at once: an index of its frames, and its messages as columns.  Needs the extra `analysis` (numba).

The index costs 27 bytes a frame beside the file itself; columns are made of what is asked for.  What `companion/tlog.py`
reads frame by frame comes out here the same, faster by two orders of magnitude.
"""

import gzip
import hashlib
import mmap
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion import walk
from companion.decode import WIRE_UNITS
from companion.dialect import Definition, by_name, definition, known_ids
from companion.errors import UserError
from companion.frames import Frame
from companion.tlog import LINK_MASK, PLAUSIBLE_US, Record, Report, Source

BLOCK: Final = 1 << 18  # frames a call of the walk; between two the caller's progress is told
KEPT: Final = 1 << 12  # failures and gaps noted a call
DTYPES: Final[Mapping[str, str]] = {
    "uint8_t": "u1",
    "uint8_t_mavlink_version": "u1",
    "int8_t": "i1",
    "uint16_t": "<u2",
    "int16_t": "<i2",
    "uint32_t": "<u4",
    "int32_t": "<i4",
    "uint64_t": "<u8",
    "int64_t": "<i8",
    "float": "<f4",
    "double": "<f8",
}

Column = NDArray[np.generic]


@dataclass(frozen=True, slots=True)
class Columns:
    """All messages of one type, in the order of the log; every array has the length of `frames`."""

    message: str
    frames: NDArray[np.int64]  # their numbers in the log
    stamp_us: NDArray[np.uint64]  # as they stand less the link's bits; 0 where there is none
    sysid: NDArray[np.uint8]
    compid: NDArray[np.uint8]
    fields: Mapping[str, Column]  # SI where MAVLink states a unit that `decode.WIRE_UNITS` knows; else as on the wire
    units: Mapping[str, str]  # SI unit's suffix by field ("m_s"), "1" for none


@dataclass(frozen=True, slots=True)
class Index:
    """Where the frames of a log are."""

    data: NDArray[np.uint8]
    starts: NDArray[np.int64]  # of the magic byte
    ends: NDArray[np.int64]
    flags: NDArray[np.uint8]  # walk.UNSTAMPED, IS_V2, IS_SIGNED, IS_UNKNOWN
    ids: NDArray[np.int32]
    sources: NDArray[np.uint16]  # sysid * 256 + compid
    seqs: NDArray[np.uint8]
    stamps_us: NDArray[np.uint64]  # with the link's bits; 0 where there is none
    report: Report
    gaps: tuple[tuple[int, int], ...]  # the first skipped stretches: offset, length

    def __len__(self) -> int:
        return len(self.starts)

    def hash(self) -> None:
        """Fill in the report's two digests; apart from the reading, since they take longer than it."""
        self.report.sha256 = hashlib.sha256(self.data.data).hexdigest()
        packed = np.empty(int((self.ends - self.starts).sum()), dtype=np.uint8)
        walk.pack(self.data, self.starts, self.ends, packed)
        self.report.frames_sha256 = hashlib.sha256(packed.data).hexdigest()

    def records(self) -> Iterator[Record]:
        """Frame by frame, as `tlog.Reader` gives them."""
        data = self.data.tobytes()
        for start, end, flag, message_id, source, seq, stamp_us in zip(
            self.starts.tolist(),
            self.ends.tolist(),
            self.flags.tolist(),
            self.ids.tolist(),
            self.sources.tolist(),
            self.seqs.tolist(),
            self.stamps_us.tolist(),
            strict=True,
        ):
            raw = data[start:end]
            body = 10 if flag & walk.IS_V2 else 6
            payload = raw[body : body + raw[1]]
            frame = Frame(raw, message_id, source >> 8, source & 0xFF, seq, definition(message_id), payload)
            yield Record(None if flag & walk.UNSTAMPED else stamp_us, frame)

    def columns(
        self,
        types: Collection[str] | None = None,
        *,
        systems: Collection[int] | None = None,
        from_us: int | None = None,
        to_us: int | None = None,
    ) -> dict[str, Columns]:
        """Messages by type name: all of them, or those of some types, systems, and stamps in [from_us, to_us).

        Raises UserError for a type that the dialect does not have.
        """
        chosen = (self.flags & walk.IS_UNKNOWN) == 0
        if types is not None:
            wanted = np.zeros(len(walk.seeds()), dtype=np.bool_)
            for name in types:
                try:
                    wanted[by_name(name).id] = True
                except KeyError:
                    raise UserError(f"{name!r} is no MAVLink message; names are written as in ATTITUDE") from None
            chosen &= wanted[np.where(chosen, self.ids, 0)]
        if systems is not None:
            chosen &= np.isin(self.sources >> 8, np.array(list(systems), dtype=np.uint16))
        if from_us is not None:
            chosen &= self.stamps_us >= from_us
        if to_us is not None:
            chosen &= self.stamps_us < to_us
        return self._columns(chosen)

    def _columns(self, chosen: NDArray[np.bool_]) -> dict[str, Columns]:
        counts = np.bincount(self.ids[chosen], minlength=len(walk.seeds()))
        sizes = payload_sizes()
        next_byte = np.concatenate(([0], np.cumsum(counts * sizes)))
        next_row = np.concatenate(([0], np.cumsum(counts)))
        first_byte, first_row = next_byte.copy(), next_row.copy()
        payloads = np.empty(int(next_byte[-1]), dtype=np.uint8)
        frames = np.empty(int(next_row[-1]), dtype=np.int64)
        walk.spread(self.data, self.starts, self.ids, chosen, sizes, next_byte, next_row, payloads, frames)
        out: dict[str, Columns] = {}
        for message_id in np.flatnonzero(counts).tolist():
            found = definition(message_id)
            assert found is not None  # unknown ids were not chosen
            rows = payloads[first_byte[message_id] : next_byte[message_id]].reshape(-1, int(sizes[message_id]))
            numbers = frames[first_row[message_id] : next_row[message_id]]
            out[found.name] = self._typed(found, numbers, rows)
        return out

    def _typed(self, message: Definition, frames: NDArray[np.int64], rows: NDArray[np.uint8]) -> Columns:
        structured = rows.view(row_dtype(message))[:, 0]
        fields: dict[str, Column] = {}
        units: dict[str, str] = {}
        for name in message.fields:
            units[name], factor = WIRE_UNITS.get(message.units.get(name, ""), ("1", 1.0))
            raw = structured[name]
            fields[name] = np.ascontiguousarray(raw) if factor == 1.0 else raw * factor
        sources = self.sources[frames]
        stamps_us = self.stamps_us[frames] & np.uint64(~LINK_MASK & 0xFFFF_FFFF_FFFF_FFFF)
        sysid, compid = (sources >> 8).astype(np.uint8), sources.astype(np.uint8)
        return Columns(message.name, frames, stamps_us, sysid, compid, fields, units)


def payload_sizes() -> NDArray[np.int64]:
    """By message id: bytes of the whole payload, extensions included."""
    sizes = np.zeros(len(walk.seeds()), dtype=np.int64)
    for message_id in known_ids():
        found = definition(message_id)
        assert found is not None  # the ids are the dialect's own
        sizes[message_id] = found.layout.size
    return sizes


def row_dtype(message: Definition) -> np.dtype[np.void]:
    """The payload as a packed record; char arrays as byte strings."""
    return np.dtype(
        [
            (name, f"S{max(count, 1)}") if kind == "char" else (name, DTYPES[kind], (count,) if count else ())
            for name, kind, count in zip(message.fields, message.types, message.counts, strict=True)
        ]
    )


def read(path: Path) -> Index:
    """Index a log, `.tlog` or `.tlog.gz`.  Raises UserError for a file that cannot be read or holds no frame."""
    data = _bytes(path)
    starts: list[NDArray[np.int64]] = []
    ends: list[NDArray[np.int64]] = []
    flags: list[NDArray[np.uint8]] = []
    block = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64), np.empty(BLOCK, np.uint8)
    counters = np.zeros(walk.COUNTERS, np.int64)
    failed_ids, skips = np.empty(KEPT, np.int64), np.empty(2 * KEPT, np.int64)
    report = Report(bytes=data.size)
    gaps: list[tuple[int, int]] = []
    position = 0
    while position < data.size:
        count, position, failures, gap_count = walk.walk(
            data, position, walk.seeds(), walk.crc_tables(), *block, counters, failed_ids, skips
        )
        starts.append(block[0][:count].copy())
        ends.append(block[1][:count].copy())
        flags.append(block[2][:count].copy())
        report.crc_failure_ids.update(failed_ids[:failures].tolist())
        gaps += [(int(at), int(size)) for at, size in skips[:gap_count].reshape(-1, 2)][: KEPT - len(gaps)]
    index = _described(data, np.concatenate(starts), np.concatenate(ends), np.concatenate(flags), report, tuple(gaps))
    report.resyncs, report.resync_bytes = int(counters[walk.RESYNCS]), int(counters[walk.RESYNC_BYTES])
    report.tail_bytes, report.crc_failures = int(counters[walk.TAIL_BYTES]), int(counters[walk.CRC_FAILURES])
    if not len(index):
        raise UserError(f"{path}: no MAVLink frame in {data.size} bytes; is it a telemetry log?")
    return index


def _bytes(path: Path) -> NDArray[np.uint8]:
    try:
        if path.suffix == ".gz":
            return np.frombuffer(gzip.decompress(path.read_bytes()), dtype=np.uint8)
        with path.open("rb") as file:
            if not path.stat().st_size:
                raise UserError(f"{path}: no MAVLink frame in 0 bytes; is it a telemetry log?")
            return np.frombuffer(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), dtype=np.uint8)
    except (OSError, EOFError) as error:
        raise UserError(f"{path}: cannot read the log: {error}") from None


def _described(
    data: NDArray[np.uint8],
    starts: NDArray[np.int64],
    ends: NDArray[np.int64],
    flags: NDArray[np.uint8],
    report: Report,
    gaps: tuple[tuple[int, int], ...],
) -> Index:
    count = len(starts)
    ids, sources = np.empty(count, np.int32), np.empty(count, np.uint16)
    seqs, stamps_us = np.empty(count, np.uint8), np.empty(count, np.uint64)
    walk.describe(data, starts, flags, ids, sources, seqs, stamps_us)
    index = Index(data, starts, ends, flags, ids, sources, seqs, stamps_us, report, gaps)
    _fill_report(index)
    return index


def _fill_report(index: Index) -> None:
    report, flags = index.report, index.flags
    report.frames_v2 = int(np.count_nonzero(flags & walk.IS_V2))
    report.frames_v1 = len(index) - report.frames_v2
    report.signed = int(np.count_nonzero(flags & walk.IS_SIGNED))
    report.unstamped = int(np.count_nonzero(flags & walk.UNSTAMPED))
    known = (flags & walk.IS_UNKNOWN) == 0
    report.unknown_frames = int(np.count_nonzero(~known))
    counts = np.bincount(index.ids[known], minlength=1)  # unknown ids may be as large as 24 bits: counted by themselves
    for message_id in np.flatnonzero(counts).tolist():
        found = definition(message_id)
        assert found is not None  # known
        report.messages[found.name] = int(counts[message_id])
    for message_id, count in zip(*np.unique(index.ids[~known], return_counts=True), strict=True):
        report.messages[f"UNKNOWN_{message_id}"] = int(count)
    report.sources = _sources(index.sources[known], index.seqs[known])
    stamped = index.stamps_us[(flags & walk.UNSTAMPED) == 0]
    plausible = stamped[(stamped >= PLAUSIBLE_US.start) & (stamped < PLAUSIBLE_US.stop)].astype(np.int64)
    report.stamps_implausible = len(stamped) - len(plausible)
    if len(plausible):
        report.first_us, report.last_us = int(plausible[0]), int(plausible[-1])
        steps = np.diff(plausible)
        report.stamps_backward = int(np.count_nonzero(steps < 0))
        report.max_gap_us = max(0, int(steps.max(initial=0)))


def _sources(sources: NDArray[np.uint16], seqs: NDArray[np.uint8]) -> dict[tuple[int, int], Source]:
    """Frames and losses by the sequence numbers, by first appearance."""
    found: dict[int, Source] = {}
    first: dict[int, int] = {}
    for source in np.flatnonzero(np.bincount(sources, minlength=1)).tolist():
        own = np.flatnonzero(sources == source)
        first[source] = int(own[0])
        numbers = seqs[own]
        lost = int((np.diff(numbers) - np.uint8(1)).astype(np.int64).sum()) if len(numbers) > 1 else 0
        found[source] = Source(len(numbers), lost, int(numbers[-1]))
    return {(source >> 8, source & 0xFF): found[source] for source in sorted(first, key=first.__getitem__)}
