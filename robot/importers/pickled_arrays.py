"""NumPy arrays from pickle files, without unpickling: the opcodes are parsed, and only arrays are created.

A pickle is a program. `read_array` goes through its opcodes (`pickletools.genops`), accepts the dozen that NumPy writes
for an array (protocols 3 to 5), and rejects every other one. No name in the file is imported and nothing is called:
"numpy.ndarray" is a string that defines the meaning of the next tuple.
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
"""Maximum size of a file. Reading it takes a small multiple of that memory."""
MAX_OPCODES = 200
"""Maximum number of opcodes; NumPy writes about 40 for an array."""
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
    """A name that unpickling would import; here only a string."""

    word: str


class _Mark:
    """The start of a tuple on the stack."""


@dataclass(eq=False)
class _Dtype:
    """A number type such as "f8", with its byte order after BUILD."""

    text: str
    order: str | None = None

    def numpy(self) -> np.dtype[Any]:
        return np.dtype(("" if self.order in (None, "|") else self.order) + self.text)


@dataclass(eq=False)
class _PickledArray:
    """An array, None until BUILD fills it."""

    value: NDArray[Any] | None = None


def read_array(data: bytes) -> NDArray[Any]:
    """Return the array in a pickle, which must contain one array of numbers and nothing else.

    Args:
        data: The content of the file, at most 64 MiB.

    Returns:
        The array, with up to 4 dimensions: floating, integer or boolean numbers. It is read-only.

    Raises:
        ImporterError: The pickle contains anything else; a message of one line.
    """
    if len(data) > MAX_BYTES:
        raise _invalid(f"it has {len(data):,} bytes, more than {MAX_BYTES:,}")
    reader = _Reader()
    for count, (name, argument) in enumerate(_opcodes(data)):
        if count >= MAX_OPCODES:
            raise _invalid(f"it has more than {MAX_OPCODES} opcodes")
        if name == "STOP":
            return reader.result()
        try:
            reader.execute(name, argument)
        except (IndexError, KeyError) as error:
            raise ImporterError(f"it is not a pickled NumPy array: {name} refers to nothing") from error
    raise _invalid("it has no end")


def _opcodes(data: bytes) -> Iterator[tuple[str, Any]]:
    """Yield the opcodes with their arguments. Raises ImporterError for invalid bytes."""
    try:
        for opcode, argument, _ in pickletools.genops(data):
            yield opcode.name, argument
    except (ValueError, OverflowError, IndexError) as error:
        raise ImporterError("it is not a pickled NumPy array: its bytes are damaged or cut off") from error


def _invalid(reason: str) -> ImporterError:
    return ImporterError(f"it is not a pickled NumPy array: {reason}")


class _Reader:
    """The stack and the memo of a pickle, which can contain only arrays and their parts."""

    def __init__(self) -> None:
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def result(self) -> NDArray[Any]:
        """Return the array on the stack. Raises ImporterError if there is none."""
        found = self._stack[0].value if len(self._stack) == 1 and isinstance(self._stack[0], _PickledArray) else None
        if found is None:
            raise _invalid("it contains something else")
        return found

    def execute(self, name: str, argument: Any) -> None:
        """Execute one opcode.

        Raises:
            ImporterError: An array does not have this opcode or argument.
            IndexError: The stack is empty.
            KeyError: The memo has no such entry.
        """
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
            marks = [position for position, value in enumerate(stack) if isinstance(value, _Mark)]
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
            function, arguments = self._pop(2)
            stack.append(_call_result(function, arguments))
        elif name == "BUILD":
            (state,) = self._pop(1)
            _fill(stack[-1], state)
        else:
            raise _invalid(f"an array does not have the opcode {name}")

    def _pop(self, count: int) -> list[Any]:
        if len(self._stack) < count:
            raise _invalid("its stack is empty")
        found = self._stack[-count:]
        del self._stack[-count:]
        return found


def _checked_name(module: Any, name: Any) -> _Name:
    if not (isinstance(module, str) and isinstance(name, str)) or (module, name) not in _NAMES:
        raise _invalid(f"it refers to {_word(module)} {_word(name)}")
    return _Name(_NAMES[module, name])


def _word(part: Any) -> str:
    """Return a part of a pickle for an error; only the type of a tuple.

    The text of nested tuples, each with its predecessor twice, would have exponential length.
    """
    return repr(part[:40]) if isinstance(part, str) else f"a {type(part).__name__}"


def _call_result(function: Any, arguments: Any) -> _Dtype | _PickledArray:
    """Return the result of a call by NumPy's unpickling, without the call."""
    word = function.word if isinstance(function, _Name) else None
    if not isinstance(arguments, tuple):
        raise _invalid("a call has no arguments")
    if word == "dtype" and len(arguments) == 3:
        if arguments[0] not in _TYPES:
            raise _invalid(f"its numbers have the type {_word(arguments[0])}")
        return _Dtype(arguments[0])
    if word == _RECONSTRUCT and len(arguments) == 3 and arguments[0] == _Name("ndarray"):
        return _PickledArray()
    if word == _FROM_BUFFER and len(arguments) == 4:
        data, dtype, shape, order = arguments
        return _PickledArray(_array(shape, dtype, order == "F", data))
    raise _invalid("it calls a function that does not make an array")


def _fill(target: Any, state: Any) -> None:
    """Execute BUILD: set the byte order of a type, or the content of an array."""
    if not isinstance(state, tuple):
        raise _invalid("a state is not a tuple")
    if isinstance(target, _Dtype) and target.order is None and len(state) in (8, 9):
        if state[1] not in ("<", ">", "=", "|") or any(part is not None for part in state[2:5]):
            raise _invalid("its numbers have fields or no byte order")
        target.order = state[1]
    elif isinstance(target, _PickledArray) and target.value is None and len(state) == 5:
        _, shape, dtype, is_fortran, data = state
        target.value = _array(shape, dtype, is_fortran is True, data)
    else:
        raise _invalid("a state belongs to something else or occurs twice")


def _array(shape: Any, dtype: Any, is_fortran: bool, data: Any) -> NDArray[Any]:
    has_sizes = isinstance(shape, tuple) and all(type(size) is int and 0 < size <= MAX_BYTES for size in shape)
    if not has_sizes or not 0 < len(shape) <= _MAX_DIMENSIONS:
        raise _invalid(f"its shape must have 1 to {_MAX_DIMENSIONS} sizes above 0")
    if not isinstance(dtype, _Dtype) or not isinstance(data, bytes | bytearray):
        raise _invalid("the type or the bytes of its numbers are missing")
    kind = dtype.numpy()
    if (expected := math.prod(shape) * kind.itemsize) != len(data):
        raise _invalid(f"its shape needs {expected:,} bytes, got {len(data):,}")
    found = np.frombuffer(bytes(data), kind).reshape(shape, order="F" if is_fortran else "C")
    return found.astype(kind.newbyteorder("="), copy=False)
