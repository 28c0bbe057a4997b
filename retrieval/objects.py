"""From match logits of photos to objects: each counts by its best photo."""

import numpy as np
from numpy.typing import NDArray

from indexes.generation import Generation
from retrieval.listing import listed_photo

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]


class Objects:
    """The objects of an index. Arrays `rows` (n,) name photos, and `logits` (n,) are theirs."""

    def __init__(self, generation: Generation) -> None:
        self._rows = generation.rows
        self._of_row = generation.codes("object_id")
        self._original = _originals(generation.codes("digest"))

    @property
    def count(self) -> int:
        """Number of objects."""
        return int(self._of_row.max()) + 1

    def equal_for_equals(self, rows: Rows, logits: Floats) -> Floats:
        """Photos of equal bytes have equal logits; a matrix product may round its last rows in another way."""
        if self._original is None:
            return logits
        original, of_original = self._original[rows], np.empty(len(self._original), dtype=np.float32)
        of_original[original[::-1]] = logits[::-1]  # the last assignment counts: that of the first equal photo
        equal: Floats = of_original[original]
        return equal

    def best(self, rows: Rows, logits: Floats, top: int) -> list[tuple[int, float]]:
        """(row, logit) of the best photo of each of the `top` best objects; ties by object, then by row."""
        looked_at = 8 * top
        while True:
            near = _largest(logits, looked_at)
            objects = self._of_row[rows[near]]
            order = np.lexsort((rows[near], self._ranks(rows[near], logits[near]), -logits[near]))
            _, first = np.unique(objects[order], return_index=True)
            if len(first) >= top or len(near) == len(rows):
                best = near[order[np.sort(first)[:top]]]
                return [(int(rows[place]), float(logits[place])) for place in best]
            looked_at *= 8

    def _ranks(self, rows: Rows, logits: Floats) -> Rows:
        """Of each row, its object's place in the order of names; all 0 where no tie asks for it, as it parses rows."""
        if len(np.unique(logits)) == len(logits):
            return np.zeros(len(rows), dtype=np.int64)
        names = np.array([listed_photo(self._rows[row]).object_id for row in rows])
        return np.unique(names, return_inverse=True)[1]


def _originals(contents: Rows) -> Rows | None:
    """For each photo the first one of equal bytes, which `contents` numbers; None where no two are equal."""
    _, first = np.unique(contents, return_index=True)
    return first[contents] if len(first) < len(contents) else None


def _largest(values: Floats, count: int) -> Rows:
    """Places of the `count` largest values, and of all that equal the least of them."""
    if count >= len(values):
        return np.arange(len(values))
    return np.flatnonzero(values >= np.partition(values, len(values) - count)[len(values) - count])
