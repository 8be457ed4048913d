"""Functions that are worked flight by flight, in plain Python or as machine code, with the same bits.

A live monitor judges one vehicle ten times a second: plain Python is fast enough, and costs a small board neither the
memory nor the start of a compiler.  Thousands of simulated flights, or a log of an hour, want machine code.  So a kernel
is written once, in the part of Python that a compiler such as numba takes, and whoever has much to do hands the compiler
in; nothing here imports one.
"""

from collections.abc import Callable
from types import FunctionType
from typing import Any, Final, ParamSpec, TypeVar, cast

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Compiler = Callable[[Callable[..., Any]], Callable[..., Any]]  # such as numba.njit

_KERNELS: Final[set[Callable[..., Any]]] = set()


def kernel(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Mark a function of numbers and arrays that calls nothing but `math` and other kernels; it stays as it is.

    For the same bits on both ways it uses math.sqrt, x * x and sums written out: no numpy, no x ** 2.
    """
    _KERNELS.add(function)
    return function


def compiled(function: Callable[Arguments, Result], compiler: Compiler) -> Callable[Arguments, Result]:
    """Machine code of a kernel and of all kernels that it calls.  Raises ValueError for a function that is none."""
    return cast("Callable[Arguments, Result]", _compiled(function, compiler, {}))


def _compiled(
    function: Callable[..., Any], compiler: Compiler, done: dict[Callable[..., Any], Callable[..., Any]]
) -> Callable[..., Any]:
    if function not in _KERNELS:
        raise ValueError(f"{function.__name__} is no kernel")
    if function not in done:
        assert isinstance(function, FunctionType)
        names = dict(function.__globals__)
        for name in function.__code__.co_names:
            called = names.get(name)
            if isinstance(called, FunctionType) and called in _KERNELS:
                names[name] = _compiled(called, compiler, done)
        copy = FunctionType(function.__code__, names, function.__name__, function.__defaults__)
        copy.__doc__, copy.__module__, copy.__qualname__ = function.__doc__, function.__module__, function.__qualname__
        done[function] = compiler(copy)
    return done[function]
