"""Writing to disk without making the live loop wait: one thread, a bounded queue, counted drops.

An SD card stalls for seconds; the loop must not.  The exception is the record of a recovery under way: it is written and
synced before its action is sent, by the loop itself.
"""

import contextlib
import errno
import fcntl
import json
import os
import re
import stat
import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Final

from companion.errors import UserError
from companion.events import Json, Severity, encode
from companion.tlog import record

QUEUE: Final = 20_000  # frames and lines, some 20 s of a busy link
RECORD_NAME: Final = "recovery.json"
ARMED: Final = "the vehicle is armed"  # reason of the news that a log begins
MEGABYTE: Final = 1_000_000
CHECK_BYTES: Final = 4 * MEGABYTE  # written between two looks at the free space
BEFORE_US: Final = (
    10_000_000  # of arrival stamps that a flight's file begins before the arming: a replay must find the vehicle
)
BEFORE_BYTES: Final = 4 * MEGABYTE  # and no more than this: memory stays flat on the busiest link

# Our files, and which of them are logs that may be removed: exact names, so that what an owner has renamed is kept.
OURS: Final = re.compile(r"(?:flight|events|summary)(?:-([2-9]|[1-9][0-9]+))?\.(?:tlog|tlog\.gz|jsonl|json)")
LOGS: Final = re.compile(r"flight(?:-([2-9]|[1-9][0-9]+))?\.tlog(?:\.gz)?")


class When(StrEnum):
    """Which frames are kept."""

    ALWAYS = "always"
    WHILE_ARMED = "while-armed"
    OFF = "off"


@dataclass(frozen=True, slots=True)
class Rules:
    """When frames are kept, and the room they may take."""

    when: When = When.ALWAYS
    file_bytes: int = 256 * MEGABYTE  # a tlog that would grow beyond it is followed by another one
    free_bytes: int = 200 * MEGABYTE  # the disk keeps so much free: the oldest logs of the folder go first


@dataclass(frozen=True, slots=True)
class News:
    """What happened to the files, for the loop to tell: the parts of an event of the kind `log`."""

    name: str  # opened, rotated, closed, removed, full
    severity: Severity
    text: str
    reason: str = ""
    details: dict[str, Json] = field(default_factory=dict)  # file and bytes; next: the file that follows


class RecordFile:
    """A new file that grows by whole records, one write each, so that a kill leaves at most one of them cut.

    What does not fit on the disk is cut off again.  Raises OSError, FileExistsError for a file that is there already.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.bytes = 0
        self._file = path.open("xb", buffering=0)
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(self._file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)  # marks it as in use until we end, however

    def write(self, data: bytes) -> None:
        """One record.  Raises OSError if it did not go out whole; the file then ends behind the record before."""
        try:
            if self._file.write(data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # a disk that fills up takes what still fits
        except OSError:
            with contextlib.suppress(OSError):
                self._file.truncate(self.bytes)
            raise
        self.bytes += len(data)

    def close(self) -> None:
        """Safe on disk, where the disk still answers."""
        with contextlib.suppress(OSError):
            os.fsync(self._file.fileno())
        with contextlib.suppress(OSError):
            self._file.close()


class FlightLog:
    """The tlogs of one run: flight.tlog, flight-2.tlog and so on; when one begins, when it ends, the room they take.

    A file that holds a flight is followed by another one when the vehicle is armed again: one flight, one file.  That one
    begins with what arrived in the ten seconds before, so that each can be replayed by itself.  Belongs to one thread and
    never raises: `failed` says why nothing is written any more, the next arming tries again.
    """

    def __init__(self, folder: Path, number: int, rules: Rules, tell: Callable[[News], None]) -> None:
        self.failed = ""
        self.dropped = 0  # frames that should have been written
        self._folder = folder
        self._number = number  # of the next file; 0: the one above all that are there
        self._rules = rules
        self._tell = tell
        self._file: RecordFile | None = None
        self._armed = False
        self._flown = False  # does the file in hand hold a flight, or a part of one?
        self._unchecked_bytes = 0
        self._before: deque[tuple[int, bytes]] = deque()  # (stamp, record) of the last BEFORE_US
        self._before_bytes = 0
        if rules.when is When.ALWAYS:
            self._begin("")

    def frame(self, stamp_us: int, data: bytes) -> None:
        """One record; stamp_us: its arrival stamp."""
        if self._rules.when is When.OFF:
            return
        self._before.append((stamp_us, data))
        self._before_bytes += len(data)
        while self._before[0][0] < stamp_us - BEFORE_US or self._before_bytes > BEFORE_BYTES:
            self._before_bytes -= len(self._before.popleft()[1])
        if self._file is not None or self._rules.when is When.ALWAYS or self._armed:
            self._write(data)

    def arm(self) -> None:
        """The vehicle is armed; the heartbeat that said so has been handed over."""
        self._armed = True
        if self._rules.when is When.OFF:
            return
        if self._file is not None and not self._flown and self._file.bytes <= self._rules.file_bytes // 2:
            self._flown = True  # the file's first flight, and room for it
            return
        self._begin(ARMED, [data for _, data in self._before])

    def disarm(self) -> None:
        """The vehicle is disarmed; the heartbeat that said so has been handed over."""
        self._armed = False
        if self._file is not None and self._rules.when is When.WHILE_ARMED:
            name, size = self._file.path.name, self._file.bytes
            self.close()
            text, details = f"{name} is complete ({megabytes(size)})", _details(name, size)
            self._tell(News("closed", Severity.INFO, text, "the vehicle is disarmed", details))

    def close(self) -> None:
        """Nothing more will come for the file in hand."""
        if self._file is not None:
            self._file.close()
        self._file = None

    def _write(self, data: bytes) -> None:
        if self._file is not None and self._file.bytes and self._file.bytes + len(data) > self._rules.file_bytes:
            self._begin(f"{megabytes(self._rules.file_bytes)} is the most for a file")
        if self._file is None:
            self.dropped += 1
            return
        try:
            self._file.write(data)
        except OSError as error:
            self.dropped += 1
            self._fail(error)
            return
        self._unchecked_bytes += len(data)
        if self._unchecked_bytes >= CHECK_BYTES:
            try:
                self._make_room()
            except OSError as error:
                self._fail(error)

    def _begin(self, because: str, first: Iterable[bytes] = ()) -> None:
        """The next file, beginning with these records; none is written any more if there can be no next one."""
        before = self._file
        try:
            self._make_room()
            self._file = self._open()
        except OSError as error:
            self._fail(error)
            return
        self.failed = ""
        self._flown = self._armed
        name = self._file.path.name
        if before is None:
            self._tell(News("opened", Severity.INFO, f"recording to {name}", because, {"file": name}))
        else:
            text = f"{before.path.name} is complete ({megabytes(before.bytes)}), recording to {name}"
            details = _details(before.path.name, before.bytes) | {"next": name}
            self._tell(News("rotated", Severity.INFO, text, because, details))
        for data in first:
            self._write(data)
        if before is not None:
            before.close()

    def _open(self) -> RecordFile:
        while True:
            number, self._number = self._number or highest_number(self._folder) + 1, 0
            with contextlib.suppress(FileExistsError):  # somebody else's, who was quicker
                return RecordFile(self._folder / numbered("flight", "tlog", number))

    def _fail(self, error: OSError) -> None:
        self.failed = error.strerror or str(error)
        self.close()
        self._tell(News("full", Severity.ERROR, f"recording stopped: {self.failed}; monitoring goes on"))

    def _make_room(self) -> None:
        """Remove the oldest logs until enough is free.  Raises OSError, nothing removed, where all of them would not do."""
        self._unchecked_bytes = 0
        floor = self._rules.free_bytes
        missing = floor - free_bytes(self._folder)
        if missing <= 0:
            return
        too_little = OSError(errno.ENOSPC, f"less than {megabytes(floor)} free on the disk")
        logs = removable(self._folder, self._file.path if self._file is not None else None)
        if sum(freed for _, _, freed in logs) < missing:
            raise too_little
        for path, size, _ in logs:
            try:
                path.unlink()
            except OSError:  # not ours to remove; the next one may be
                continue
            text = f"{path.name} ({megabytes(size)}) is removed to keep {megabytes(floor)} free"
            self._tell(News("removed", Severity.NOTICE, text, details=_details(path.name, size)))
            if free_bytes(self._folder) >= floor:
                return
        raise too_little


class Recorder:
    """The files of one run in a folder: flight.tlog and those that follow it, events.jsonl, summary.json.

    A folder that holds an earlier run keeps it: ours are then numbered, flight-2.tlog and so on.  Raises UserError where
    the folder cannot be written.  `dropped` counts what the disk was too slow or too small for, `failed` says why frames
    are not written any more; what happened to the files is waiting in `news`.
    """

    def __init__(self, folder: Path, rules: Rules | None = None) -> None:
        self.folder = folder
        self.rules = rules or Rules()
        self._overflowed = 0  # counted by the loop
        self._unwritten = 0  # events, counted by the thread
        self._news: SimpleQueue[News] = SimpleQueue()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.number = highest_number(folder) + 1
            self._events = RecordFile(self.events_path)
        except OSError as error:
            raise UserError(f"{folder}: cannot record here: {error.strerror or error}") from None
        self._flights = FlightLog(folder, self.number, self.rules, self._news.put)
        # Unbounded itself: an arming must not be lost.  Frames and events are only put while fewer than QUEUE wait.
        self._queue: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    @property
    def tlog_path(self) -> Path:
        """Of the run's first log."""
        return self.folder / numbered("flight", "tlog", self.number)

    @property
    def events_path(self) -> Path:
        return self.folder / numbered("events", "jsonl", self.number)

    @property
    def failed(self) -> str:
        return self._flights.failed

    @property
    def dropped(self) -> int:
        return self._overflowed + self._unwritten + self._flights.dropped

    def frame(self, stamp_us: int, link: int, raw: bytes) -> None:
        """One frame of either direction."""
        self._put(partial(self._flights.frame, stamp_us, record(stamp_us, link, raw)))

    def event(self, line: dict[str, Json]) -> None:
        """One event."""
        self._put(partial(self._event, (encode(line) + "\n").encode()))

    def armed(self, armed: bool) -> None:
        """The vehicle was armed, or disarmed, by the frame handed over last."""
        self._queue.put(self._flights.arm if armed else self._flights.disarm)

    def news(self) -> list[News]:
        """What has happened to the files since the last call."""
        return [self._news.get() for _ in range(self._news.qsize())]

    def settle(self) -> None:
        """Wait until everything handed over so far is written or counted as lost."""
        done = threading.Event()
        self._queue.put(done.set)
        done.wait()

    def summary(self, content: dict[str, Json]) -> Path:
        """The last word on the run; written at once, replacing nothing half."""
        path = self.folder / numbered("summary", "json", self.number)
        _write_synced(path, json.dumps(json.loads(encode(content)), indent=2, ensure_ascii=False) + "\n")
        return path

    def save_record(self, text: str) -> None:
        """Keep (or, empty, forget) the record of a recovery, safe on disk when this returns."""
        save_record(self.folder, text)

    def close(self) -> None:
        """Write out what waits."""
        self._queue.put(None)
        self._thread.join()
        self._flights.close()
        self._events.close()

    def _put(self, work: Callable[[], None]) -> None:
        if self._queue.qsize() < QUEUE:
            self._queue.put(work)
        else:
            self._overflowed += 1

    def _work(self) -> None:
        while (work := self._queue.get()) is not None:
            work()

    def _event(self, data: bytes) -> None:
        """Events are small and go on below the floor of free space; one that does not fit is tried no second time."""
        try:
            self._events.write(data)
        except OSError as error:
            if not self._unwritten:
                text = f"events are not recorded: {error.strerror or error}; monitoring goes on"
                self._news.put(News("full", Severity.ERROR, text))
            self._unwritten += 1


def numbered(stem: str, ending: str, number: int) -> str:
    """A file's name; the first one of a folder has no number."""
    return f"{stem}.{ending}" if number == 1 else f"{stem}-{number}.{ending}"


def highest_number(folder: Path) -> int:
    """The highest number that a file of a run in this folder has; 0 if there is none.  Raises OSError."""
    found = (OURS.fullmatch(name) for name in os.listdir(folder))
    return max((int(match[1] or 1) for match in found if match), default=0)


def removable(folder: Path, in_hand: Path | None) -> list[tuple[Path, int, int]]:
    """(path, bytes, bytes of disk) of the logs that nobody writes, oldest first.  Raises OSError.

    By number, which is the order they were made in: a board that boots without a clock gives files any date.
    """
    found: list[tuple[int, Path, int, int]] = []
    for name in os.listdir(folder):
        match, path = LOGS.fullmatch(name), folder / name
        if match is None or path == in_hand:
            continue
        with contextlib.suppress(FileNotFoundError):  # gone meanwhile
            facts = path.lstat()
            if stat.S_ISREG(facts.st_mode) and not _in_use(path):
                freed = facts.st_blocks * 512 if facts.st_nlink == 1 else 0  # st_blocks: POSIX has them in 512 bytes
                found.append((int(match[1] or 1), path, facts.st_size, freed))
    return [(path, size, freed) for _, path, size, freed in sorted(found)]


def _in_use(path: Path) -> bool:
    """Is somebody writing this file, another run perhaps?"""
    try:
        with path.open("rb") as file:
            fcntl.flock(file.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # no lock can be had here at all
        return False
    return False


def free_bytes(folder: Path) -> int:
    """Room on the folder's disk for whoever is not root.  Raises OSError."""
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize


def megabytes(size_bytes: int) -> str:
    """For people; a megabyte is a million bytes."""
    return f"{size_bytes / MEGABYTE:.4g} MB"


def _details(name: str, size_bytes: int) -> dict[str, Json]:
    return {"file": name, "bytes": size_bytes}


def load_record(folder: Path) -> str:
    """The record that a killed run left in this folder; empty if there is none.  Raises UserError if it cannot be read."""
    path = folder / RECORD_NAME
    try:
        return path.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        return ""
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot read it: {error}; check the vehicle's outputs, then remove it") from None


def save_record(folder: Path, text: str) -> None:
    """Write and sync the record, or remove it where text is empty."""
    path = folder / RECORD_NAME
    if text:
        _write_synced(path, text)
    else:
        path.unlink(missing_ok=True)
        _sync_folder(folder)


def _write_synced(path: Path, text: str) -> None:
    temporary = path.with_name(path.name + ".new")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """A rename is safe only once the folder's own entry is on the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
