"""Says why the first log takes long: the reader of large logs is compiled once, and kept for all later starts."""

import sys
from collections.abc import Iterable
from pathlib import Path

from companion.analysis import compiled_reader, is_large


def announce(logs: Iterable[Path], *, always: bool = False) -> None:
    """One line on standard error, on a terminal only, where reading one of these logs will compile.

    always: the logs are read compiled whatever their size.
    """
    if not sys.stderr.isatty() or not (always or any(map(is_large, logs))):
        return
    reader = compiled_reader()
    if reader is not None and not reader.is_compiled():
        print("compiling the log reader, once; later starts have it ready ...", file=sys.stderr, flush=True)
