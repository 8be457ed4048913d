"""A whole log at once: an index of its frames, and its messages as columns.  Needs the extra `analysis` (numba).

The index costs 27 bytes a frame beside the file itself; columns are made of what is asked for.  What `companion/tlog.py`
reads frame by frame comes out here the same, faster by two orders of magnitude.
"""

import hashlib
import math
import mmap
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion import unpacking, walk
from companion.decode import WIRE_UNITS
from companion.dialect import Definition, by_name, definition, known_ids, recognised
from companion.errors import UserError
from companion.frames import Frame
from companion.tlog import PLAUSIBLE_US, Record, Report, Source, content

BLOCK: Final = 1 << 18  # frames between two moments in which memory is given back
CACHED: Final = 1 << 16  # frames turned into columns at once: few enough for the cache, many of each type
SMALLEST: Final = 8  # bytes of the smallest frame, without a stamp
NOTED: Final = 1 << 16  # failures and gaps that are remembered one by one
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
    # SI where MAVLink states a unit that `decode.WIRE_UNITS` knows: float64, the bits of the live path's samples; where the
    # unit is SI already, or is not known, as on the wire, in the wire's kind of number.
    fields: Mapping[str, Column]
    units: Mapping[str, str]  # SI unit's suffix by field ("m_s"), "1" for none


@dataclass(frozen=True)
class Index:
    """Where the frames of a log are.  `report` is made when it is first asked for."""

    data: NDArray[np.uint8]
    starts: NDArray[np.int64]  # of the magic byte
    sizes: NDArray[np.uint16]  # of the whole frame, signature included
    flags: NDArray[np.uint8]  # walk.UNSTAMPED, IS_V2, IS_SIGNED, IS_UNKNOWN
    ids: NDArray[np.int32]
    sources: NDArray[np.uint16]  # sysid * 256 + compid
    seqs: NDArray[np.uint8]
    stamps_us: NDArray[np.uint64]  # with the link's bits; 0 where there is none
    damage: Report  # what the walk alone can count
    gaps: tuple[tuple[int, int], ...]  # the first skipped stretches: offset, length

    def __len__(self) -> int:
        return len(self.starts)

    @cached_property
    def report(self) -> Report:
        """Everything that `tlog.Reader` counts, but for the two digests of `hash`."""
        report = replace(self.damage, crc_failure_ids=self.damage.crc_failure_ids.copy())
        _fill_report(self, report)
        return report

    def hash(self) -> None:
        """Fill in the report's two digests; apart from the reading, since they take longer than it."""
        self.report.sha256 = hashlib.sha256(self.data.data).hexdigest()
        packed = np.empty(int(self.sizes.sum(dtype=np.int64)), dtype=np.uint8)
        walk.pack(self.data, self.starts, self.sizes, packed)
        self.report.frames_sha256 = hashlib.sha256(packed.data).hexdigest()

    def records(self) -> Iterator[Record]:
        """Frame by frame, as `tlog.Reader` gives them."""
        data = self.data.tobytes()
        for start, size, flag, message_id, source, seq, stamp_us in zip(
            self.starts.tolist(),
            self.sizes.tolist(),
            self.flags.tolist(),
            self.ids.tolist(),
            self.sources.tolist(),
            self.seqs.tolist(),
            self.stamps_us.tolist(),
            strict=True,
        ):
            raw = data[start : start + size]
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

        What one call gives lies in one stretch of memory, and stays as long as any of it: copy the little that you keep.
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
        by_id = np.zeros(len(walk.seeds()), dtype=np.int64)
        unpacking.count_ids(self.ids, chosen, by_id)
        ids = np.flatnonzero(by_id)
        counts = by_id[ids]
        types = np.zeros(len(by_id), dtype=np.int16)
        types[ids] = np.arange(len(ids))
        sizes = payload_sizes()[ids].astype(np.uint64)
        row_ends = np.cumsum(counts)
        first_row = (row_ends - counts).astype(np.uint64)
        next_row = first_row.copy()
        rows = unpacking.Rows.empty(int(counts.sum()))
        messages = [_known(message_id) for message_id in ids.tolist()]
        memory, columns, fields = _room(messages, counts.tolist())
        out = unpacking.values(memory)
        order = np.empty(CACHED, dtype=np.uint32)
        payloads = np.empty(CACHED * ((int(sizes.max(initial=8)) + 7) // 8), dtype=np.uint64)
        wire = unpacking.values_at_every_byte(payloads.view(np.uint8))
        frames = walk.Frames(self.starts, self.sizes, self.flags, self.ids, self.sources, self.seqs, self.stamps_us)
        for first in range(0, len(self), CACHED):
            part = slice(first, first + CACHED)
            unpacking.fill(
                *(self.data, first, frames.part(part), chosen[part], types, sizes, first_row, next_row, fields),
                *(order, payloads, wire, rows, out),
            )
            _let_go(self.data)
        found: dict[str, Columns] = {}
        for message, end, count, own in zip(messages, row_ends.tolist(), counts.tolist(), columns, strict=True):
            kept = rows.part(slice(end - count, end))
            units = {name: _unit(message, name)[0] for name in message.fields}
            found[message.name] = Columns(message.name, kept.frames, kept.stamps_us, kept.sysids, kept.compids, own, units)
        return found


@dataclass(frozen=True, slots=True)
class _Field:
    """One field of a message type, on the wire and as a column."""

    name: str
    offset: int  # bytes from the payload's begin
    number: np.dtype[np.generic]  # as which it is read; characters one by one
    elements: int
    factor: float
    shape: tuple[int, ...]  # of a row of the column
    kept: np.dtype[np.generic]

    def place(self, byte: int) -> int:
        """Where a column that begins at this byte does so, in numbers of the kind that are written to it."""
        return byte // (self.kept if self.factor != 1.0 else self.number).itemsize


def _fields(message: Definition) -> Iterator[_Field]:
    for name, (dtype, offset, *_) in (row_dtype(message).fields or {}).items():
        factor, element = _unit(message, name)[1], dtype.base
        number = np.dtype(np.uint8) if element.kind == "S" else element
        kept = np.dtype(np.float64) if factor != 1.0 else element
        yield _Field(name, offset, number, dtype.itemsize // number.itemsize, factor, dtype.shape, kept)


def _room(
    messages: list[Definition], counts: list[int]
) -> tuple[NDArray[np.uint8], list[dict[str, Column]], unpacking.Fields]:
    """The memory of all columns, the columns in it by type and field, and the table by which they are filled.

    One stretch of memory: the system gives a large one in large pages, and columns one by one in small pages, which take
    longer to come by than the numbers that are put into them.
    """
    fields, begins, first, size = [], [], [0], 0
    for message, count in zip(messages, counts, strict=True):
        for field in _fields(message):
            fields.append(field)
            begins.append(size)
            row_bytes = math.prod(field.shape) * field.kept.itemsize
            size += -(-count * row_bytes // 8) * 8  # so that each begins at a whole number of any kind
        first.append(len(fields))
    memory = np.empty(size, dtype=np.uint8)
    columns: list[dict[str, Column]] = []
    for count, begin, end in zip(counts, first[:-1], first[1:], strict=True):
        own = zip(fields[begin:end], begins[begin:end], strict=True)
        columns.append({field.name: np.ndarray((count, *field.shape), field.kept, memory, at) for field, at in own})
    table = unpacking.Fields(
        np.array(first, np.int64),
        np.array([field.offset for field in fields], np.uint64),
        np.array([unpacking.Values._fields.index(field.number.str[1:]) for field in fields], np.int64),
        np.array([field.elements for field in fields], np.uint64),
        np.array([field.factor for field in fields], np.float64),
        np.array([field.place(at) for field, at in zip(fields, begins, strict=True)], np.uint64),
    )
    return memory, columns, table


def _unit(message: Definition, name: str) -> tuple[str, float]:
    """The suffix of a field's SI unit, and the factor to it."""
    return WIRE_UNITS.get(message.units.get(name, ""), ("1", 1.0))


def _known(message_id: int) -> Definition:
    found = definition(message_id)
    assert found is not None  # the id is the dialect's own
    return found


def payload_sizes() -> NDArray[np.int64]:
    """By message id: bytes of the whole payload, extensions included."""
    sizes = np.zeros(len(walk.seeds()), dtype=np.int64)
    for message_id in known_ids():
        sizes[message_id] = _known(message_id).layout.size
    return sizes


def row_dtype(message: Definition) -> np.dtype[np.void]:
    """The payload as a packed record; char arrays as byte strings."""
    return np.dtype(
        [
            (name, f"S{max(count, 1)}") if kind == "char" else (name, DTYPES[kind], (count,) if count else ())
            for name, kind, count in zip(message.fields, message.types, message.counts, strict=True)
        ]
    )


def is_compiled() -> bool:
    """Has an earlier start left the compiled walk on disk?  Else the first log takes seconds longer."""
    return any(Path(walk.walk.stats.cache_path).glob("walk.walk-*.nbi"))


def read(path: Path) -> Index:
    """Index a log, `.tlog` or `.tlog.gz`.  Raises UserError for a file that cannot be read or holds no frame."""
    data = np.frombuffer(content(path), dtype=np.uint8)
    if not data.size:
        raise UserError(f"{path}: no MAVLink frame in 0 bytes; is it a telemetry log?")
    counters = np.zeros(walk.COUNTERS, np.int64)
    failed_ids, skips = np.empty(NOTED, np.int64), np.empty(2 * NOTED, np.int64)
    # Room for as many frames as there can be: memory that is never touched is never taken.
    room = data.size // SMALLEST + 1
    frames = walk.Frames.empty(room)
    count, position = 0, 0
    while position < data.size:
        rest = slice(count, count + BLOCK)
        more, position = walk.walk(
            *(data, position, walk.seeds(), walk.crc_tables()),
            *(frames.part(rest), counters, failed_ids, skips),
        )
        count += more
        _let_go(data)
    if not count:
        raise UserError(f"{path}: no MAVLink frame in {data.size} bytes; is it a telemetry log?")
    gaps = skips[: 2 * min(NOTED, int(counters[walk.GAPS]))].reshape(-1, 2)
    damage = Report(
        bytes=data.size,
        resyncs=int(counters[walk.RESYNCS]),
        resync_bytes=int(counters[walk.RESYNC_BYTES]),
        tail_bytes=int(counters[walk.TAIL_BYTES]),
        crc_failures=int(counters[walk.CRC_FAILURES]),
        crc_failure_ids=Counter(failed_ids[: int(counters[walk.CRC_FAILURES])].tolist()),
    )
    found = frames.part(slice(count))
    return Index(
        data,
        found.starts,
        found.sizes,
        found.flags,
        found.ids,
        found.sources,
        found.seqs,
        found.stamps_us,
        damage,
        tuple((int(at), int(size)) for at, size in gaps),
    )


def _let_go(data: NDArray[np.uint8]) -> None:
    """Pages of the file that were looked at need not stay ours: the system keeps them, and gives them again."""
    view: object = data.base
    mapping = view.obj if isinstance(view, memoryview) else None
    if isinstance(mapping, mmap.mmap):
        mapping.madvise(mmap.MADV_DONTNEED)


def _fill_report(index: Index, report: Report) -> None:
    flags = index.flags
    report.frames_v2 = int(np.count_nonzero(flags & walk.IS_V2))
    report.frames_v1 = len(index) - report.frames_v2
    report.signed = int(np.count_nonzero(flags & walk.IS_SIGNED))
    report.unstamped = int(np.count_nonzero(flags & walk.UNSTAMPED))
    known = (flags & walk.IS_UNKNOWN) == 0
    report.unknown_frames = int(np.count_nonzero(~known))
    counts = np.bincount(index.ids[known], minlength=1)  # unknown ids may be as large as 24 bits: counted by themselves
    for message_id in np.flatnonzero(counts).tolist():
        report.messages[_known(message_id).name] = int(counts[message_id])
    for message_id, count in zip(*np.unique(index.ids[~known], return_counts=True), strict=True):
        report.messages[f"UNKNOWN_{message_id}"] = int(count)
    for number in np.flatnonzero(~known).tolist():
        start = int(index.starts[number])
        raw = index.data[start : start + int(index.sizes[number])].tobytes()
        if (name := recognised(raw, int(index.ids[number]))) is not None:
            report.recognised[name] += 1
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
