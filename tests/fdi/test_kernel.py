"""A kernel stays plain Python until a compiler is handed in; the stand-in compilers here only note what they are given."""

import math
import subprocess
import sys

import pytest

from companion.compiler import compiler
from fdi.kernel import compiled, kernel

OFFSET = 0.25


@kernel
def halved(x: float) -> float:
    """Half of it."""
    return 0.5 * x


@kernel
def shifted(x: float, by: float = OFFSET) -> float:
    return halved(x) + by


@kernel
def summed(x: float) -> float:
    return shifted(x) + halved(x) + math.sin(x)


def plain(x):
    return x


@kernel
def with_a_plain_function(x):
    return plain(x)


class Notes:
    """A compiler that returns what it is given, and notes the names."""

    def __init__(self):
        self.names = []

    def __call__(self, function):
        self.names.append(function.__name__)
        return function


def test_a_kernel_stays_the_function_that_it_is():
    def function(x):
        return x

    assert kernel(function) is function


def test_a_kernel_and_all_that_it_calls_are_compiled_once_each_callees_first():
    notes = Notes()
    made = compiled(summed, notes)
    assert notes.names == ["halved", "shifted", "summed"]
    assert made(0.7) == summed(0.7)


def test_the_compiled_copy_calls_compiled_copies_and_the_kernel_itself_is_untouched():
    def doubling(function):
        return lambda *arguments: 2.0 * function(*arguments)

    made = compiled(shifted, doubling)
    assert made(1.0) == 2.0 * (2.0 * 0.5 + OFFSET)
    assert shifted(1.0) == 0.5 + OFFSET
    assert halved(1.0) == 0.5


def test_the_copy_keeps_name_module_text_and_defaults():
    made = compiled(shifted, lambda function: function)
    assert made is not shifted
    assert (made.__name__, made.__qualname__, made.__module__) == ("shifted", "shifted", __name__)
    assert made(1.0) == shifted(1.0) == 0.75
    assert compiled(halved, lambda function: function).__doc__ == "Half of it."


@pytest.mark.parametrize("function", [plain, Notes, len])
def test_what_is_no_kernel_is_refused_by_name(function):
    with pytest.raises(ValueError, match=f"{function.__name__} is no kernel"):
        compiled(function, Notes())


def test_a_plain_function_that_a_kernel_calls_is_handed_to_no_compiler():
    notes = Notes()
    assert compiled(with_a_plain_function, notes)(3.0) == 3.0
    assert notes.names == ["with_a_plain_function"]


def test_machine_code_of_a_kernel_has_the_bits_of_plain_python():
    made = compiled(summed, compiler())
    for x in (0.0, -0.0, 1e-300, 0.1, -3.7, 1e6, math.nan):
        assert made(x).hex() == summed(x).hex()


def test_marking_kernels_imports_no_compiler():
    code = "import sys, fdi.kernel, fdi.reach, fdi.parafoil; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "False"
