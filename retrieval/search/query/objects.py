"""The photos of an index, checked as they are read, for an index may come from anyone; and its objects: from the match
logits of photos to what each object's logit is, which are best, and a sample of the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from indexes.errors import AGAIN, CorruptIndex
from indexes.store.generation import Generation
from indexes.store.rows import keys_of
from retrieval.data.storage import is_inside
from retrieval.data.text import replace_surrogates
from retrieval.model.posterior import Posterior

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]
SAMPLE = 100
"""Objects, drawn once, that stand for those that a query does not judge."""


@dataclass(frozen=True)
class ListedPhoto:
    """A row of an index. path: inside the catalogue, relative to it; metadata: the user's own."""

    object_id: str
    path: str
    metadata: dict[str, Any]


def listed_photo(row: dict[str, Any]) -> ListedPhoto:
    """The photo of a row; U+FFFD stands for text that UTF-8 cannot hold, which older versions let into indexes. Raises
    CorruptIndex for one whose parts are missing or that lies outside the catalogue, from where its picture would be put
    into pages.
    """
    object_id, path, metadata = (row.get(name) for name in ("object_id", "path", "metadata"))
    if not (isinstance(object_id, str) and isinstance(path, str) and isinstance(metadata, dict)):
        raise CorruptIndex(f"row {row['id']!r} must have an object_id, a path and metadata; {AGAIN}")
    if not is_inside(path):
        raise CorruptIndex(f"row {row['id']!r} must name a photo inside the catalogue, names {path!r}; {AGAIN}")
    return ListedPhoto(replace_surrogates(object_id), replace_surrogates(path), replace_surrogates(metadata))


def check_usable(generation: Generation, partial_width: int) -> None:
    """Raise CorruptIndex unless the index says where its catalogue and checkpoint lie, and holds halves of `partial_width`
    numbers.
    """
    about, partials = generation.manifest.about, generation.arrays.get("partials")
    candidates = about.get("candidates")
    k = candidates.get("k") if isinstance(candidates, dict) else None
    if candidates is not None and not (type(k) is int and 1 <= k < 2**31):
        raise CorruptIndex(f"{generation.folder}: its number of candidates must be 1 or more; {AGAIN}")
    if not all(isinstance(about.get(name), str) and "\0" not in about[name] for name in ("catalogue", "checkpoint")):
        raise CorruptIndex(f"{generation.folder}: it must say its catalogue and its checkpoint; {AGAIN}")
    if partials is None or partials.ndim != 2 or partials.shape[1] != partial_width or partials.dtype.kind != "f":
        got = "none" if partials is None else f"{partials.dtype} {partials.shape}"
        raise CorruptIndex(f"{generation.folder}: it must hold halves of {partial_width} numbers, holds {got}; {AGAIN}")


class ScoredObjects(NamedTuple):
    """Objects with a judged photo: their numbers (J,), logits (J,) float64, and best photos' rows (J,). by_photos (J,):
    the logits that photos alone give them, NaN without photos; None where there are no reference touches.
    """

    numbers: Rows
    logits: NDArray[np.float64]
    rows: Rows
    photo_logits: NDArray[np.float64] | None = None


class Objects:
    """The objects of an index. Arrays `rows` (n,) name photos, and `logits` (n,) are theirs."""

    def __init__(self, generation: Generation) -> None:
        self._rows = generation.rows
        self._of_row = generation.codes("object_id")
        contents = generation.codes("digest")
        first = np.unique(contents, return_index=True)[1]
        self._original = first[contents] if len(first) < len(contents) else None
        """For each photo the first one of equal bytes; None where no two are equal."""
        self._photos = np.bincount(self._of_row)

    @property
    def count(self) -> int:
        """Number of objects."""
        return len(self._photos)

    def numbers_of(self, names: Sequence[str]) -> Rows:
        """The number of each object named; -1 for one that is not there."""
        keys, first = np.unique(self._rows.keys("object_id"), return_index=True)
        wanted = keys_of(names)
        places = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        return np.asarray(np.where(keys[places] == wanted, self._of_row[first[places]], -1))

    def align_duplicates(self, rows: Rows, logits: Floats) -> Floats:
        """Photos of equal bytes have equal logits; a matrix product may round its last rows in another way."""
        if self._original is None:
            return logits
        original, of_original = self._original[rows], np.empty(len(self._original), dtype=np.float32)
        of_original[original[::-1]] = logits[::-1]  # the last assignment counts: that of the first equal photo
        equal: Floats = of_original[original]
        return equal

    def judged(self, rows: Rows, logits: Floats, posterior: Posterior, grasps: int) -> ScoredObjects:
        """Objects by the photos that were judged; the best photo of equal ones is the first."""
        numbers, owner = np.unique(self._of_row[rows], return_inverse=True)
        order = np.lexsort((rows, -logits, owner))
        first = order[np.searchsorted(owner[order], np.arange(len(numbers)))]
        return ScoredObjects(
            numbers, posterior.object_logits(logits, owner, self._photos[numbers], grasps), rows[first]
        )

    def best(self, judged: ScoredObjects, top: int) -> Rows:
        """Places in `judged` of the `top` objects of largest logit; ties by name."""
        near = np.arange(len(judged.logits))
        if top < len(near):  # and all that equal the least of them
            near = np.flatnonzero(judged.logits >= np.partition(judged.logits, -top)[-top])
        logits = judged.logits[near]
        if len(set(logits.tolist())) == len(near):  # no tie asks for names, for which rows are parsed
            order = np.argsort(-logits)
        else:
            names = np.array([listed_photo(self._rows[row]).object_id for row in judged.rows[near]])
            order = np.lexsort((names, -logits))
        return np.asarray(near[order[:top]])

    def remaining_rows(self, numbers: Rows, rows: Rows) -> Rows:
        """Rows of the photos of these objects that are not among `rows`, which are sorted."""
        wanted = np.zeros(self.count, dtype=bool)
        wanted[numbers] = True
        return np.setdiff1d(np.flatnonzero(wanted[self._of_row]), rows, assume_unique=True)

    def sample_rows_without(self, numbers: Rows) -> Rows:
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
