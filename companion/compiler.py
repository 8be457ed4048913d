"""The compiler of kernels (fdi/kernel.py): numba, where it is installed and the work is long enough for it."""

import os
from functools import cache
from pathlib import Path

import fdi
from fdi.kernel import Compiler


@cache
def compiler() -> Compiler | None:
    """What makes machine code of a kernel and keeps it for later starts; None where numba is not installed.

    The code kept does not notice a change in a kernel of another file: after such an edit delete
    fdi/**/__pycache__/*.nb[ci].
    """
    try:
        from numba import njit
    except ModuleNotFoundError as error:
        if error.name != "numba":
            raise
        return None
    # No test for a division by zero, which no kernel does; no counting of references to arrays, which no kernel makes or
    # keeps, and which takes three quarters of the time.
    made: Compiler = njit(cache=True, error_model="numpy", _nrt=False)
    return made


def is_kept() -> bool:
    """Has an earlier start left a compiled monitor on disk?  Else the first long log takes a quarter of a minute more.

    The kernel that a monitor compiles is called step_flights.
    """
    folders = [os.environ["NUMBA_CACHE_DIR"]] if "NUMBA_CACHE_DIR" in os.environ else fdi.__path__
    return any(any(Path(folder).glob("**/*.step_flights-*.nbi")) for folder in folders)
