"""From match logits of photos to objects: what each object's logit is, which are best, and a sample of the others."""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from indexes.store.generation import Generation
from retrieval.model.posterior import Posterior
from retrieval.search.listing import listed_photo

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]
SAMPLE = 100
"""Objects, drawn once, that stand for those that a query does not judge."""


class JudgedObjects(NamedTuple):
    """Objects with a judged photo: their numbers (J,), logits (J,) float64, and best photos' rows (J,)."""

    numbers: Rows
    logits: NDArray[np.float64]
    rows: Rows


class Objects:
    """The objects of an index. Arrays `rows` (n,) name photos, and `logits` (n,) are theirs."""

    def __init__(self, generation: Generation) -> None:
        self._rows = generation.rows
        self._of_row = generation.codes("object_id")
        self._original = _originals(generation.codes("digest"))
        self._photos = np.bincount(self._of_row)

    @property
    def count(self) -> int:
        """Number of objects."""
        return len(self._photos)

    def equal_for_equals(self, rows: Rows, logits: Floats) -> Floats:
        """Photos of equal bytes have equal logits; a matrix product may round its last rows in another way."""
        if self._original is None:
            return logits
        original, of_original = self._original[rows], np.empty(len(self._original), dtype=np.float32)
        of_original[original[::-1]] = logits[::-1]  # the last assignment counts: that of the first equal photo
        equal: Floats = of_original[original]
        return equal

    def judged(self, rows: Rows, logits: Floats, posterior: Posterior, grasps: int) -> JudgedObjects:
        """Objects by the photos that were judged; the best photo of equal ones is the first."""
        numbers, owner = np.unique(self._of_row[rows], return_inverse=True)
        order = np.lexsort((rows, -logits, owner))
        first = order[np.searchsorted(owner[order], np.arange(len(numbers)))]
        return JudgedObjects(
            numbers, posterior.object_logits(logits, owner, self._photos[numbers], grasps), rows[first]
        )

    def best(self, judged: JudgedObjects, top: int) -> Rows:
        """Places in `judged` of the `top` objects of largest logit; ties by name."""
        near = _largest(judged.logits, top)
        order = np.lexsort((self._ranks(judged.rows[near], judged.logits[near]), -judged.logits[near]))
        return np.asarray(near[order[:top]])

    def _ranks(self, rows: Rows, logits: NDArray[np.float64]) -> Rows:
        """Of each row, its object's place in the order of names; all 0 where no tie asks for it, as it parses rows."""
        if len(np.unique(logits)) == len(logits):
            return np.zeros(len(rows), dtype=np.int64)
        names = np.array([listed_photo(self._rows[row]).object_id for row in rows])
        return np.unique(names, return_inverse=True)[1]

    def rest_of(self, numbers: Rows, rows: Rows) -> Rows:
        """Rows of the photos of these objects that are not among `rows`, which are sorted."""
        wanted = np.zeros(self.count, dtype=bool)
        wanted[numbers] = True
        return np.setdiff1d(np.flatnonzero(wanted[self._of_row]), rows, assume_unique=True)

    def sample_without(self, numbers: Rows) -> Rows:
        """Rows of all photos of the sampled objects that are not among `numbers`; perhaps none."""
        rows, owners = self._sample
        return np.asarray(rows[~np.isin(owners, numbers)])

    @cached_property
    def _sample(self) -> tuple[Rows, Rows]:
        """Rows of the photos of `SAMPLE` objects, drawn by a seed, and whose they are."""
        drawn = np.zeros(self.count, dtype=bool)
        drawn[np.random.default_rng(0).permutation(self.count)[:SAMPLE]] = True
        rows = np.flatnonzero(drawn[self._of_row])
        return rows, self._of_row[rows]


def _originals(contents: Rows) -> Rows | None:
    """For each photo the first one of equal bytes, which `contents` numbers; None where no two are equal."""
    _, first = np.unique(contents, return_index=True)
    return first[contents] if len(first) < len(contents) else None


def _largest(values: NDArray[np.float64], count: int) -> Rows:
    """Places of the `count` largest values, and of all that equal the least of them."""
    if count >= len(values):
        return np.arange(len(values))
    return np.flatnonzero(values >= np.partition(values, len(values) - count)[len(values) - count])
