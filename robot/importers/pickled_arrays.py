"""NumPy arrays out of pickle files, without unpickling: the opcodes are read, and nothing but arrays is made of them.

A pickle is a program. `read_array` walks through its opcodes (`pickletools.genops`), knows the dozen that NumPy writes
for an array (protocols 3 to 5), and refuses every other one. No name in the file is imported and nothing is called:
"numpy.ndarray" is a word that tells what the next tuple means.
"""

import math
import pickletools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot.errors import ImporterError

MAX_BYTES = 64 * 2**20
"""Of a file. What is read from it takes a small multiple of that."""
MAX_OPCODES = 200
"""NumPy writes about 40 for an array."""
_MAX_DIMENSIONS = 4
_ARRAY_MODULES = ("numpy.core.multiarray", "numpy._core.multiarray")
_BUFFER_MODULES = ("numpy.core.numeric", "numpy._core.numeric")
_RECONSTRUCT, _FROM_BUFFER = "_reconstruct", "_frombuffer"
_NAMES = {
    ("numpy", "ndarray"): "ndarray",
    ("numpy", "dtype"): "dtype",
    **{(module, _RECONSTRUCT): _RECONSTRUCT for module in _ARRAY_MODULES},
    **{(module, _FROM_BUFFER): _FROM_BUFFER for module in _BUFFER_MODULES},
}
_TYPES = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1")

_IGNORED = {"PROTO", "FRAME"}
_VALUES = {
    *("BININT", "BININT1", "BININT2", "LONG1"),
    *("SHORT_BINUNICODE", "BINUNICODE", "SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8"),
}
_CONSTANTS: dict[str, Any] = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_PUTS, _GETS = {"BINPUT", "LONG_BINPUT"}, {"BINGET", "LONG_BINGET"}


@dataclass(frozen=True)
class _Name:
    """A name that the pickle would import; here a word."""

    word: str


class _Mark:
    """Where a tuple begins."""


@dataclass(eq=False)
class _Dtype:
    """A type of numbers: "f8", and the order of its bytes once BUILD says it."""

    text: str
    order: str | None = None

    def numpy(self) -> np.dtype[Any]:
        return np.dtype(("" if self.order in (None, "|") else self.order) + self.text)


@dataclass(eq=False)
class _PickledArray:
    """An array, empty until BUILD fills it."""

    value: NDArray[Any] | None = None


def read_array(data: bytes) -> NDArray[Any]:
    """Return the array that a pickle holds, which must be one array of numbers and nothing else.

    Args:
        data: The content of the file, at most 64 MiB.

    Returns:
        The array, of up to 4 dimensions: floating, integer or boolean numbers. It cannot be written to.

    Raises:
        ImporterError: For anything else, in one line.
    """
    if len(data) > MAX_BYTES:
        raise _refusal(f"it has {len(data):,} bytes, more than {MAX_BYTES:,}")
    reader = _Reader()
    for count, (name, argument) in enumerate(_opcodes(data)):
        if count >= MAX_OPCODES:
            raise _refusal(f"it has more than {MAX_OPCODES} opcodes")
        if name == "STOP":
            return reader.result()
        try:
            reader.take(name, argument)
        except (IndexError, KeyError) as error:
            raise ImporterError(f"it is not a pickled NumPy array: {name} refers to nothing") from error
    raise _refusal("it has no end")


def _opcodes(data: bytes) -> Iterator[tuple[str, Any]]:
    """The opcodes and their arguments. Raises ImporterError for bytes that are none."""
    try:
        for opcode, argument, _ in pickletools.genops(data):
            yield opcode.name, argument
    except (ValueError, OverflowError, IndexError) as error:
        raise ImporterError("it is not a pickled NumPy array: its bytes are damaged or cut off") from error


def _refusal(why: str) -> ImporterError:
    return ImporterError(f"it is not a pickled NumPy array: {why}")


class _Reader:
    """The stack and the memo of a pickle, on which nothing but arrays and their parts can lie."""

    def __init__(self) -> None:
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def result(self) -> NDArray[Any]:
        found = self._stack[0].value if len(self._stack) == 1 and isinstance(self._stack[0], _PickledArray) else None
        if found is None:
            raise _refusal("it holds something else")
        return found

    def take(self, name: str, argument: Any) -> None:
        """Do what one opcode says. Raises ImporterError, IndexError, KeyError."""
        stack = self._stack
        if name in _IGNORED:
            return
        if name in _VALUES:
            stack.append(argument)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name == "MARK":
            stack.append(_Mark())
        elif name == "TUPLE":
            marks = [place for place, each in enumerate(stack) if isinstance(each, _Mark)]
            stack[marks[-1] :] = [tuple(stack[marks[-1] + 1 :])]
        elif name in _TUPLES:
            parts = self._pop(_TUPLES[name])
            stack.append(tuple(parts))
        elif name == "MEMOIZE":
            self._memo[len(self._memo)] = stack[-1]
        elif name in _PUTS:
            self._memo[argument] = stack[-1]
        elif name in _GETS:
            stack.append(self._memo[argument])
        elif name == "GLOBAL":
            stack.append(_checked_name(*argument.partition(" ")[::2]))
        elif name == "STACK_GLOBAL":
            stack.append(_checked_name(*self._pop(2)))
        elif name == "REDUCE":
            what, arguments = self._pop(2)
            stack.append(_call_result(what, arguments))
        elif name == "BUILD":
            (state,) = self._pop(1)
            _fill(stack[-1], state)
        else:
            raise _refusal(f"an array has no opcode {name}")

    def _pop(self, count: int) -> list[Any]:
        if len(self._stack) < count:
            raise _refusal("its stack is empty")
        found = self._stack[-count:]
        del self._stack[-count:]
        return found


def _checked_name(module: Any, name: Any) -> _Name:
    if not (isinstance(module, str) and isinstance(name, str)) or (module, name) not in _NAMES:
        raise _refusal(f"it asks for {_word(module)} {_word(name)}")
    return _Name(_NAMES[module, name])


def _word(part: Any) -> str:
    """A part of a pickle for an error. Of a tuple only its kind: written out, one that holds another twice, and so on,
    has no end.
    """
    return repr(part[:40]) if isinstance(part, str) else f"a {type(part).__name__}"


def _call_result(what: Any, arguments: Any) -> _Dtype | _PickledArray:
    """What NumPy would make by calling a name."""
    word = what.word if isinstance(what, _Name) else None
    if not isinstance(arguments, tuple):
        raise _refusal("a call has no arguments")
    if word == "dtype" and len(arguments) == 3:
        if arguments[0] not in _TYPES:
            raise _refusal(f"its numbers are of the type {_word(arguments[0])}")
        return _Dtype(arguments[0])
    if word == _RECONSTRUCT and len(arguments) == 3 and arguments[0] == _Name("ndarray"):
        return _PickledArray()
    if word == _FROM_BUFFER and len(arguments) == 4:
        data, dtype, shape, order = arguments
        return _PickledArray(_array(shape, dtype, order == "F", data))
    raise _refusal("it calls something else than what makes an array")


def _fill(what: Any, state: Any) -> None:
    """BUILD: the order of a type's bytes, or the content of an array."""
    if not isinstance(state, tuple):
        raise _refusal("a state is no tuple")
    if isinstance(what, _Dtype) and what.order is None and len(state) in (8, 9):
        if state[1] not in ("<", ">", "=", "|") or any(part is not None for part in state[2:5]):
            raise _refusal("its numbers have fields, or no order of bytes")
        what.order = state[1]
    elif isinstance(what, _PickledArray) and what.value is None and len(state) == 5:
        _, shape, dtype, is_fortran, data = state
        what.value = _array(shape, dtype, is_fortran is True, data)
    else:
        raise _refusal("a state is of something else, or given twice")


def _array(shape: Any, dtype: Any, is_fortran: bool, data: Any) -> NDArray[Any]:
    sizes = isinstance(shape, tuple) and all(type(size) is int and 0 < size <= MAX_BYTES for size in shape)
    if not sizes or not 0 < len(shape) <= _MAX_DIMENSIONS:
        raise _refusal(f"its shape must be 1 to {_MAX_DIMENSIONS} sizes above 0")
    if not isinstance(dtype, _Dtype) or not isinstance(data, bytes | bytearray):
        raise _refusal("it lacks the type or the bytes of its numbers")
    kind = dtype.numpy()
    if (wanted := math.prod(shape) * kind.itemsize) != len(data):
        raise _refusal(f"its shape asks for {wanted:,} bytes, and there are {len(data):,}")
    found = np.frombuffer(bytes(data), kind).reshape(shape, order="F" if is_fortran else "C")
    return found.astype(kind.newbyteorder("="), copy=False)
