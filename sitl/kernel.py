"""How the plants' kernels are compiled: two decorators, so that all of a kind are compiled alike."""

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


def plant_kernel(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """As `kernel`, three times as fast, for a function that makes, returns and keeps no array: a plant is made of these.

    The caller owns all arrays while it runs, so references to them are not counted; one that makes an array or copies a
    slice does not compile.  Division by zero is not looked for: it gives an infinity or NaN, where the plain Python
    function raises ZeroDivisionError.
    """
    # Of a step's time the tests for a division by zero were a quarter, and counting references, atomic, nearly a half:
    # each row of an array handed on is an array of its own.
    compiled = njit(cache=True, error_model="numpy", forceinline=True, _nrt=False)(function)
    return cast("Callable[Arguments, Result]", compiled)
