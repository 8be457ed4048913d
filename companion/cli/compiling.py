"""Says why the first log takes long: reader and monitors are compiled once, and kept for all later starts."""

import sys
from collections.abc import Iterable
from pathlib import Path

from companion.analysis import COMPILED_FROM_FRAMES, compiled_reader, is_large
from companion.compiler import compiler, is_kept

LEAST_FRAME_BYTES = 40  # on average, in a log: so that no log with frames enough for a compiled monitor is overlooked


def announce(logs: Iterable[Path], *, always: bool = False) -> None:
    """One line on standard error, on a terminal only, where reading or judging one of these logs will compile.

    always: the logs are read compiled whatever their size.
    """
    if not sys.stderr.isatty():
        return
    paths = list(logs)
    waiting = []
    reader = compiled_reader() if always or any(map(is_large, paths)) else None
    if reader is not None and not reader.is_compiled():
        waiting.append("the log reader")
    long_ones = any(path.is_file() and path.stat().st_size >= COMPILED_FROM_FRAMES * LEAST_FRAME_BYTES for path in paths)
    if long_ones and compiler() is not None and not is_kept():
        waiting.append("the monitor")
    if waiting:
        print(f"compiling {' and '.join(waiting)}, once; later starts have it ready ...", file=sys.stderr, flush=True)
