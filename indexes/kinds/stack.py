"""A table in several files: its parts one after another, in an order of its own, and never copied together."""

from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from indexes.kinds.scores import Floats, Slots


class Stack:
    """Arrays of equal dtype and equal shape but for the first axis, read as if they were one.

    A row, a slice, a list of rows or a mask is copied out as an array; a slice that lies in one part is a view of it.
    With `order` (N,) row number n is row `order[n]` of the parts laid end to end.
    """

    def __init__(self, parts: Sequence[NDArray[Any]], order: Slots | None = None) -> None:
        self.parts, self.order = list(parts), order
        self._starts = np.cumsum([0, *map(len, parts)])
        self.dtype = parts[0].dtype
        self.shape: tuple[int, ...] = (len(self), *parts[0].shape[1:])
        self.ndim = len(self.shape)

    def __len__(self) -> int:
        return int(self._starts[-1]) if self.order is None else len(self.order)

    def __getitem__(self, index: Any) -> NDArray[Any]:
        if isinstance(index, int | np.integer):
            return self._taken(np.array([range(len(self))[index]]))[0]  # type: ignore[no-any-return]
        if isinstance(index, slice):
            start, stop, step = index.indices(len(self))
            return self._between(start, stop) if step == 1 else self._taken(np.arange(start, stop, step))
        wanted = np.asarray(index)
        return self._taken(np.flatnonzero(wanted) if wanted.dtype == np.bool_ else wanted)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        if copy is False:
            raise ValueError("a stack of several parts has no array of its own to share")
        return self[:].astype(dtype or self.dtype)

    def _between(self, start: int, stop: int) -> NDArray[Any]:
        if self.order is not None:
            return self._placed(self.order[start:stop])
        part = int(np.searchsorted(self._starts, start, side="right")) - 1
        if stop <= start or part >= len(self.parts):
            return self.parts[0][:0]
        first = self._starts[part]
        if stop <= self._starts[part + 1]:
            return self.parts[part][start - first : stop - first]
        return self._placed(np.arange(start, stop))

    def _taken(self, rows: NDArray[Any]) -> NDArray[Any]:
        if rows.size and (rows.min() < -len(self) or rows.max() >= len(self)):
            raise IndexError(f"rows must be below {len(self)}; got {rows.min()} to {rows.max()}")
        rows = rows.astype(np.int64) % max(1, len(self))
        return self._placed(rows if self.order is None else self.order[rows])

    def _placed(self, places: Slots) -> NDArray[Any]:
        if len(self.parts) == 1:
            return np.asarray(self.parts[0][places])
        out = np.empty((*places.shape, *self.shape[1:]), self.dtype)
        owner = np.searchsorted(self._starts, places, side="right") - 1
        for number, part in enumerate(self.parts):
            mine = owner == number
            if mine.any():
                out[mine] = part[places[mine] - self._starts[number]]
        return out


Vectors: TypeAlias = "Floats | Stack"
"""A table of vectors (M, d), in one array or in several."""


def stacked(parts: Sequence[NDArray[Any]], order: Slots | None = None) -> Any:
    """The parts as one table: the part itself where there is nothing to join or to reorder."""
    return parts[0] if len(parts) == 1 and order is None else Stack(parts, order)


def parts_of(table: Vectors) -> list[Floats]:
    """The arrays that hold a table's rows in their order."""
    if not isinstance(table, Stack):
        return [table]
    return table.parts if table.order is None else [table[:]]


def blocks_of(table: Any, rows: int) -> Iterator[NDArray[Any]]:
    """The table block by block, `rows` rows or fewer at a time."""
    for start in range(0, len(table), rows):
        yield table[start : start + rows]


def segments_kept(sizes: Sequence[int], fresh: int) -> int:
    """How many leading segments stay as they are when `fresh` rows come: the new one takes in those no larger.

    As in a binary counter, every segment is larger than the next, so that N rows stand in at most log2 N + 1
    segments, and a row is copied at most log2 N times however the index has grown.
    """
    kept, new = len(sizes), fresh
    while fresh and kept and sizes[kept - 1] <= new:
        kept -= 1
        new += sizes[kept]
    return kept
