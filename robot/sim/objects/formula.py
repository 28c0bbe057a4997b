"""Formulas: the operations of a numpy function, recorded once so that compiled code can apply them to many points.

A shape computes its distance in plain numpy, with a few dozen operations over arrays. On whole arrays each operation
goes through memory. `trace_formula` runs the function on symbols instead and records its operations;
`robot.sim.objects.packets` executes them on a few points at a time, in the processor's cache and at the width of its
vector unit. The numpy function remains the only definition of the shape, and the oracle of its formula.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from robot.errors import SceneError
from robot.sim.objects.packets import OPERATIONS, Formula

_UFUNCS = {getattr(np, name): name for name in OPERATIONS if name != "where"}


def trace_formula(function: Callable[..., Any], operands: int) -> Formula:
    """Record the formula of a function of float32 arrays.

    Args:
        function: returns an array or a tuple of arrays. It must consist of numpy's elementwise functions
            (`OPERATIONS`), and use `np.where`, not `if`, for choices that depend on its operands.
        operands: number of its arguments.

    Raises:
        SceneError: It calls any other function of numpy.
    """
    tape = _Tape(operands)
    returned = function(*(_Symbol(tape, number) for number in range(operands)))
    outputs = returned if isinstance(returned, tuple) else (returned,)
    return tape.formula([tape.number_of(value) for value in outputs])


class _Symbol(np.lib.mixins.NDArrayOperatorsMixin):
    """Placeholder for an array: numpy operations on it are recorded on the tape."""

    def __init__(self, tape: "_Tape", number: int) -> None:
        self._tape, self.number = tape, number

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> "_Symbol":
        options.pop("out", None)  # an in-place operation gives a new value under the old name
        if method != "__call__" or ufunc not in (*_UFUNCS, np.negative, np.less) or options:
            raise SceneError(f"a formula may only use {', '.join(OPERATIONS)}; got {ufunc.__name__}")
        if ufunc is np.negative:
            return self._tape.write("subtract", (0.0, *inputs))
        if ufunc is np.less:
            return self._tape.write("greater", inputs[::-1])
        return self._tape.write(_UFUNCS[ufunc], inputs)

    def __array_function__(self, function: Any, types: Any, args: Any, options: Any) -> "_Symbol":
        if function is np.where and len(args) == 3:
            return self._tape.write("where", args)
        if function is np.clip and len(args) == 3 and not options:
            return self._tape.write("minimum", (self._tape.write("maximum", args[:2]), args[2]))
        if function is np.full_like and len(args) == 2:
            return _Symbol(self._tape, self._tape.number_of(args[1]))
        raise SceneError(f"a formula may only use {', '.join(OPERATIONS)}, clip and full_like; got {function}")


class _Tape:
    """Values in the order of their computation: operands, constants and results of operations."""

    def __init__(self, operands: int) -> None:
        self._values: list[tuple[Any, ...]] = [("operand", number) for number in range(operands)]
        self._number: dict[tuple[Any, ...], int] = {value: number for number, value in enumerate(self._values)}

    def write(self, operation: str, inputs: Sequence[Any]) -> _Symbol:
        """Record an operation and return the symbol of its result."""
        return _Symbol(self, self._intern((operation, *map(self.number_of, inputs))))

    def number_of(self, value: Any) -> int:
        """Return the number of a symbol or constant on the tape."""
        return value.number if isinstance(value, _Symbol) else self._intern(("constant", float(np.float32(value))))

    def _intern(self, value: tuple[Any, ...]) -> int:
        """Return the number of a value; an operation that is already recorded is not recorded again."""
        number = self._number.setdefault(value, len(self._values))
        if number == len(self._values):
            self._values.append(value)
        return number

    def formula(self, results: Sequence[int]) -> Formula:
        """Assign rows to the values; rows of temporary values are reused after their last use."""
        fixed = [number for number, (kind, *_) in enumerate(self._values) if kind == "operand"]
        fixed += [number for number, (kind, *_) in enumerate(self._values) if kind == "constant"]
        row = {number: place for place, number in enumerate(fixed)}
        computed = [(number, value) for number, value in enumerate(self._values) if number not in row]
        last_use = {operand: number for number, (_, *inputs) in computed for operand in inputs}
        code, free, count = [], list[int](), len(fixed)
        for number, (kind, *inputs) in computed:
            # A result never overwrites its own operands: the compiled loops are vectorised under that condition.
            row[number] = free.pop() if free else count
            count = max(count, row[number] + 1)
            read = [row[operand] for operand in inputs]
            code.append((OPERATIONS.index(kind), row[number], *read, *(read[:1] * (3 - len(read)))))
            finished = {operand for operand in inputs if last_use[operand] == number}
            free += [row[operand] for operand in sorted(finished - set(fixed) - set(results))]
        start = np.zeros(count, np.float32)
        for number in fixed:
            kind, value = self._values[number]
            if kind == "constant":
                start[row[number]] = value
        places = np.array([row[number] for number in results], np.int64)
        return Formula(np.array(code, np.int64).reshape(-1, 5), start, places)
