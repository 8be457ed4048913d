"""What is kept of a campaign: its rows as Parquet, every batch whole or not at all, so that nothing is flown twice."""

import contextlib
import fcntl
import os
import re
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.campaign.rows import Columns, table
from companion.campaign.settings import Settings, settings_of
from companion.errors import UserError

FILE_NAME: Final = "flights.parquet"
PARTS_NAME: Final = "parts"
PART: Final = re.compile(r"([0-9]+)-([0-9]+)\.parquet")  # first seed, flights
NEW: Final = ".new"  # behind the name of a file that is still being written


class Store:
    """The folder of one campaign: whole batches in `parts`, joined into one table when all are there.

    One process at a time holds it; `close` lets go.
    """

    def __init__(self, folder: Path, wanted: Settings) -> None:
        """Raises UserError if the folder holds a campaign of other settings, is held by another process, or unwritable."""
        self.folder = folder
        self.settings = wanted
        self._parts = folder / PARTS_NAME
        self._path = folder / FILE_NAME
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(folder, os.O_RDONLY)
        except OSError as error:
            raise UserError(f"{folder}: cannot write here: {error.strerror or error}") from None
        try:
            self._hold()
            for path in self._kept():
                check_same(path, kept_settings(path), wanted)
            self._parts.mkdir(exist_ok=True)
            for leftover in [*self._parts.glob(f"*{NEW}"), *folder.glob(f"*{NEW}")]:
                leftover.unlink()
        except OSError as error:
            self.close()
            raise UserError(f"{folder}: cannot write here: {error.strerror or error}") from None
        except UserError:
            self.close()
            raise

    def _hold(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(f"{self.folder}: another campaign is writing here; wait for it or give another --out") from None
        except OSError:
            return  # a network's file system may know no locks

    def close(self) -> None:
        os.close(self._lock)

    def _kept(self) -> list[Path]:
        return [path for path in (self._path, *self._flown()) if path.exists()]

    def _flown(self) -> list[Path]:
        """The parts, by seed."""
        return sorted((path for path in self._parts.glob("*") if PART.fullmatch(path.name)), key=_span)

    @property
    def missing(self) -> list[range]:
        """Seeds that have not been flown, in runs of consecutive ones."""
        whole = range(self.settings.first_seed, self.settings.first_seed + self.settings.flights)
        if self._path.exists():
            return []
        runs, begin = [], whole.start
        for first, flights in map(_span, self._flown()):
            if first > begin:
                runs.append(range(begin, first))
            begin = max(begin, first + flights)
        return [*runs, range(begin, whole.stop)] if begin < whole.stop else runs

    def keep(self, columns: Columns) -> None:
        """Write a batch's rows, whole or not at all.  Raises UserError if the disk does not take them."""
        seeds = np.asarray(columns["seed"])
        path = self._parts / f"{seeds[0]}-{seeds.size}.parquet"
        self._write(path, table(columns))

    def join(self) -> Path:
        """One table of all parts, sorted by seed; the parts are removed.  -> its path."""
        import pyarrow
        from pyarrow import parquet

        parts = self._flown()
        if not self._path.exists():
            whole = pyarrow.concat_tables([parquet.read_table(path) for path in parts])
            self._write(self._path, whole.sort_by("seed"))
        for path in parts:
            path.unlink()
        with contextlib.suppress(OSError):  # somebody keeps something else in it
            self._parts.rmdir()
        return self._path

    def _write(self, path: Path, content: Any) -> None:
        from pyarrow import parquet

        new = path.with_name(path.name + NEW)
        try:
            with new.open("wb") as file:
                parquet.write_table(content.replace_schema_metadata(self.settings.as_metadata()), file)
                file.flush()
                os.fsync(file.fileno())
            new.rename(path)
        except OSError as error:
            raise UserError(f"{path}: cannot be written: {error.strerror or error}") from None


def _span(path: Path) -> tuple[int, int]:
    """(first seed, flights) of a part, from its name."""
    first, _, flights = path.stem.partition("-")
    return int(first), int(flights)


def kept_settings(path: Path) -> Settings:
    """Under which settings a file of rows was flown.  Raises UserError if it is none of ours."""
    import pyarrow
    from pyarrow import parquet

    try:
        metadata = parquet.read_schema(path).metadata or {}
        return settings_of({name.decode(): value.decode() for name, value in metadata.items() if b"ARROW" not in name})
    except (OSError, KeyError, ValueError, pyarrow.ArrowException):
        raise UserError(f"{path}: not a table of flights; move it away or give another --out") from None


def check_same(path: Path, kept: Settings, wanted: Settings) -> None:
    """Raise UserError, naming every difference, if rows of other settings lie there."""
    differing = [name for name in Settings.__slots__ if getattr(kept, name) != getattr(wanted, name)]
    if differing:
        told = ", ".join(f"{name} {_told(kept, name)} (now {_told(wanted, name)})" for name in differing)
        raise UserError(f"{path}: flown with other settings: {told}; give the same ones or another --out")


def _told(kept: Settings, name: str) -> str:
    value = getattr(kept, name)
    return ",".join(value) if isinstance(value, tuple) else str(value)[:12] if name == "config_sha256" else str(value)
