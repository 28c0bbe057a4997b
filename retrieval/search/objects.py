"""Photos and objects of an index: object logits from photo logits, the best objects, and a sample."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from indexes.errors import AGAIN, CorruptIndex
from indexes.store.generation import Generation
from indexes.store.rows import Row
from retrieval.data.text import is_inside
from retrieval.model.posterior import Posterior

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]
SAMPLE = 100
"""Number of random objects that represent those that a query does not score."""


@dataclass(frozen=True)
class ListedPhoto:
    """A photo of an index, or a gel image of a reference touch.

    Attributes:
        object_id: The object.
        path: Path relative to the catalogue, and inside it.
        metadata: The user's metadata.
        digest: SHA-256 of the file, in hexadecimal.
        is_touch: Whether it is a gel image.
    """

    object_id: str
    path: str
    metadata: dict[str, Any]
    digest: str = ""
    is_touch: bool = False


def listed_photo(row: Row) -> ListedPhoto:
    """Return the photo of a row.

    Args:
        row: A row of an index.

    Raises:
        CorruptIndex: The path is outside the catalogue. Pages would show such a file.
    """
    if not is_inside(row.path):
        raise CorruptIndex(f"the index must list photos inside the catalogue, but has {row.path!r}; {AGAIN}")
    return ListedPhoto(row.object_id, row.path, row.metadata, row.digest)


class ScoredObjects(NamedTuple):
    """Objects with a scored photo, or with a gel image in its place.

    Attributes:
        numbers: Their numbers (J,).
        logits: Their logits (J,) float64.
        rows: Rows (J,) of their best photos.
        photo_logits: Logits (J,) from photos only, NaN without photos; None if the index has no reference touches.
    """

    numbers: Rows
    logits: NDArray[np.float64]
    rows: Rows
    photo_logits: NDArray[np.float64] | None = None


class Objects:
    """The objects of an index, numbered in the order of their names.

    In all methods, `rows` (n,) selects photos, and `logits` (n,) are their logits.
    """

    def __init__(self, generation: Generation) -> None:
        rows = generation.rows
        self._of_row, self.count = rows.objects, rows.object_count
        self._original = None if (rows.originals == np.arange(len(rows))).all() else rows.originals
        """For each photo the first one with the same bytes; None if all photos differ."""
        self._photos = np.bincount(self._of_row)

    def align_duplicates(self, rows: Rows, logits: Floats) -> Floats:
        """Return the logits with equal values for photos with equal bytes.

        A matrix product may round its last rows differently.
        """
        if self._original is None:
            return logits
        original, of_original = self._original[rows], np.empty(len(self._original), dtype=np.float32)
        of_original[original[::-1]] = logits[::-1]  # the last assignment remains: that of the first equal photo
        equal: Floats = of_original[original]
        return equal

    def aggregate(self, rows: Rows, logits: Floats, posterior: Posterior, grasps: int) -> ScoredObjects:
        """Return the objects of scored photos with their logits and best photos; ties take the first photo.

        Args:
            rows: Rows (n,) of the scored photos.
            logits: Their match logits (n,), summed over the grasps.
            posterior: Combines the photos of an object.
            grasps: Number of grasps.
        """
        numbers, owner = np.unique(self._of_row[rows], return_inverse=True)
        order = np.lexsort((rows, -logits, owner))
        first = order[np.searchsorted(owner[order], np.arange(len(numbers)))]
        return ScoredObjects(
            numbers, posterior.object_logits(logits, owner, self._photos[numbers], grasps), rows[first]
        )

    def best(self, scored: ScoredObjects, top: int) -> Rows:
        """Return the positions in `scored` of the `top` objects with the largest logits; ties are ordered by name."""
        selected = np.arange(len(scored.logits))
        if top < len(selected):  # including ties with the last one
            selected = np.flatnonzero(scored.logits >= np.partition(scored.logits, -top)[-top])
        order = np.lexsort((scored.numbers[selected], -scored.logits[selected]))  # numbers are in the order of names
        return np.asarray(selected[order[:top]])

    def remaining_rows(self, numbers: Rows, rows: Rows) -> Rows:
        """Return the photos of the objects `numbers` that are not among the sorted `rows`."""
        is_selected = np.zeros(self.count, dtype=bool)
        is_selected[numbers] = True
        return np.setdiff1d(np.flatnonzero(is_selected[self._of_row]), rows, assume_unique=True)

    def sample_rows_without(self, numbers: Rows) -> Rows:
        """Return the photos of the sampled objects that are not among `numbers`, perhaps none."""
        rows, owners = self._sample
        return np.asarray(rows[~np.isin(owners, numbers)])

    @cached_property
    def _sample(self) -> tuple[Rows, Rows]:
        """Rows of the photos of `SAMPLE` random objects (fixed seed), and the objects of these rows."""
        drawn = np.zeros(self.count, dtype=bool)
        drawn[np.random.default_rng(0).permutation(self.count)[:SAMPLE]] = True
        rows = np.flatnonzero(drawn[self._of_row])
        return rows, self._of_row[rows]
