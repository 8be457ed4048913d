"""How the plants' kernels are compiled: one decorator, so that all of them are compiled alike."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

from numba import njit

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def kernel(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Compile a function of floats and arrays; machine code is kept in __pycache__ for the next process.

    No fastmath: a kernel then gives the same bits as the plain Python function, which tests call as `.py_func`.  The
    cache does not notice a change in a kernel of another file that this one calls: after such an edit delete
    sitl/**/__pycache__/*.nb[ci].
    """
    return cast("Callable[Arguments, Result]", njit(cache=True)(function))
