"""Writing to disk without making the live loop wait: one thread, a bounded queue, counted drops.

An SD card stalls for seconds; the loop must not.  The exception is the record of a recovery under way: it is written and
synced before its action is sent, by the loop itself.
"""

import errno
import json
import os
import queue
import threading
from pathlib import Path
from typing import Final

from companion.errors import UserError
from companion.events import Json, encode
from companion.tlog import record

QUEUE: Final = 20_000  # frames and lines, some 20 s of a busy link
RECORD_NAME: Final = "recovery.json"


class Recorder:
    """The files of one run in a folder: flight.tlog, events.jsonl, summary.json.

    A folder that holds an earlier run keeps it: ours are then numbered, flight-2.tlog and so on.  Raises UserError where
    the folder cannot be written.  `dropped` counts what the disk was too slow for, `failed` says why writing stopped.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.dropped = 0
        self.failed = ""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.number = next(n for n in range(1, 1_000_000) if not any(path.exists() for path in self._paths(n)))
            self._tlog = self._path("flight", "tlog", self.number).open("xb", buffering=0)
            self._events = self._path("events", "jsonl", self.number).open("xb", buffering=0)
        except OSError as error:
            raise UserError(f"{folder}: cannot record here: {error.strerror or error}") from None
        self._queue: queue.Queue[tuple[bool, bytes] | None] = queue.Queue(QUEUE)
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._thread.start()

    def _paths(self, number: int) -> tuple[Path, ...]:
        return tuple(
            self._path(stem, ending, number)
            for stem, ending in (("flight", "tlog"), ("events", "jsonl"), ("summary", "json"))
        )

    @property
    def tlog_path(self) -> Path:
        return self._path("flight", "tlog", self.number)

    @property
    def events_path(self) -> Path:
        return self._path("events", "jsonl", self.number)

    def frame(self, stamp_us: int, link: int, raw: bytes) -> None:
        """One frame of either direction."""
        self._put(True, record(stamp_us, link, raw))

    def event(self, line: dict[str, Json]) -> None:
        """One event."""
        self._put(False, (encode(line) + "\n").encode())

    def summary(self, content: dict[str, Json]) -> Path:
        """The last word on the run; written at once, replacing nothing half."""
        path = self._path("summary", "json", self.number)
        _write_synced(path, json.dumps(json.loads(encode(content)), indent=2, ensure_ascii=False) + "\n")
        return path

    def save_record(self, text: str) -> None:
        """Keep (or, empty, forget) the record of a recovery, safe on disk when this returns."""
        save_record(self.folder, text)

    def close(self) -> None:
        """Write out what waits."""
        self._queue.put(None)
        self._thread.join()
        self._tlog.close()
        self._events.close()

    def _path(self, stem: str, ending: str, number: int) -> Path:
        return self.folder / (f"{stem}.{ending}" if number == 1 else f"{stem}-{number}.{ending}")

    def _put(self, is_frame: bool, data: bytes) -> None:
        try:
            self._queue.put_nowait((is_frame, data))
        except queue.Full:
            self.dropped += 1

    def _write(self) -> None:
        """One write a record, so that a kill leaves at most one record cut."""
        while (item := self._queue.get()) is not None:
            is_frame, data = item
            if self.failed:
                self.dropped += 1
                continue
            try:
                if (self._tlog if is_frame else self._events).write(data) != len(data):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # a disk that fills up takes what still fits
            except OSError as error:
                self.failed = error.strerror or str(error)
                self.dropped += 1


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
