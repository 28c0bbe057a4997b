"""Photos, reference touches and objects of an opened index: object logits from photo logits, and the best objects."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.documents import typed
from _touch_retrieval.names import lookup_key
from indexes.errors import AGAIN, CorruptIndex
from indexes.store.generation import Generation
from indexes.store.rows import Row
from retrieval.data.opening import require_opening
from retrieval.data.text import is_inside
from retrieval.indexing.enrolled import EnrolledTouch, codes_of
from retrieval.model.checkpoint_info import CheckpointInfo
from retrieval.model.posterior import Posterior
from retrieval.model.references import (
    REFERENCE_PARTIALS,
    REFERENCE_ROWS,
    reference_similarity,
    unit_embeddings,
)
from retrieval.search.answer import NearestReference

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]
SAMPLE = 100
"""Number of random objects that represent those that a query does not score."""


@dataclass(frozen=True)
class ListedPhoto:
    """A photo of an index, or a gel image of a reference touch.

    Attributes:
        object_id: The object.
        path: Path relative to the catalogue, and inside it; of an enrolled touch, relative to the folder of the index.
        metadata: The user's metadata.
        digest: SHA-256 of the file, in hexadecimal.
        is_touch: Whether it is a gel image.
        is_enrolled: Whether it is a gel image of an enrolled touch.
    """

    object_id: str
    path: str
    metadata: dict[str, Any]
    digest: str = ""
    is_touch: bool = False
    is_enrolled: bool = False


def listed_photo(row: Row) -> ListedPhoto:
    """Return the photo of a row. Raises CorruptIndex for a path outside the catalogue: pages would show such a file."""
    if not is_inside(row.path):
        raise CorruptIndex(f"the index must list photos inside the catalogue, but has {row.path!r}; {AGAIN}")
    return ListedPhoto(row.object_id, row.path, row.metadata, row.digest)


class ReferenceEvidence(NamedTuple):
    """Comparison of the grasps of a query with the reference touches of each object.

    Attributes:
        similarities: C (count,) of the gel images (`retrieval.model.references`); NaN without a reference.
        openings: (count,) sum of the log likelihood ratios of the openings (`retrieval.model.opening`), 0 without one.
        compared: Number of objects whose opening was compared.
    """

    similarities: NDArray[np.float64]
    openings: NDArray[np.float64]
    compared: int


class ScoredObjects(NamedTuple):
    """Objects with a scored photo, or with a gel image in its place.

    Attributes:
        numbers: Their numbers (J,).
        logits: Their logits (J,) float64.
        rows: Rows (J,) of their best photos, -1 for objects that only the table of enrolled touches has.
        photo_logits: Logits (J,) from photos only, NaN without photos.
    """

    numbers: Rows
    logits: NDArray[np.float64]
    rows: Rows
    photo_logits: NDArray[np.float64]

    def best(self, top: int) -> Rows:
        """Return the positions of the `top` objects with the largest logits; ties are ordered by name."""
        selected = np.arange(len(self.logits))
        if top < len(selected):  # including ties with the last one
            selected = np.flatnonzero(self.logits >= np.partition(self.logits, -top)[-top])
        order = np.lexsort((self.numbers[selected], -self.logits[selected]))  # numbers are in the order of names
        return np.asarray(selected[order[:top]])


@dataclass(frozen=True)
class _ReferenceTouch:
    """A reference touch: its object, the paths of its gel images, the digests of their files, and the opening."""

    object_id: str
    touch: tuple[str, ...]
    digests: tuple[str, ...]
    opening_mm: float | None = None
    is_enrolled: bool = False


@dataclass(frozen=True)
class _References:
    """The document of reference touches, and the objects without photos."""

    touches: list[_ReferenceTouch]
    touch_only: list[str]


class Objects:
    """The objects of an index, numbered in the order of their names, and then those that were only enrolled.

    Args:
        generation: The opened generation.
        stored: Header of the checkpoint that built it.
        columns: Columns of a partial activation with the scaled embedding.

    Attributes:
        posterior: Calibration of the match logits.
        count: Number of objects.

    Raises:
        CorruptIndex: The list of reference touches is damaged.
    """

    def __init__(self, generation: Generation, stored: CheckpointInfo, columns: slice) -> None:
        self._rows = rows = generation.rows
        documents = generation.documents
        self.posterior = stored.posterior or Posterior()  # without calibration objects are ranked, too
        self._of_row, self._originals = rows.objects, rows.originals
        self._photos = np.bincount(self._of_row)
        self._columns, self._stored = columns, stored
        self._calibration, self._opening = stored.references, stored.opening
        try:
            self._references = typed(documents.get(REFERENCE_ROWS, {"touches": [], "touch_only": []}), _References)
            for reference in self._references.touches:
                if len(reference.touch) != len(reference.digests) or not all(map(is_inside, reference.touch)):
                    raise ValueError("a gel image is outside the catalogue or has no digest")
                if reference.opening_mm is not None:
                    require_opening(reference.opening_mm, "opening_mm")
        except ValueError as error:
            raise CorruptIndex(
                f"{generation.folder}: the list of reference touches is invalid ({error}); {AGAIN}"
            ) from error
        partials = documents.get(REFERENCE_PARTIALS, np.empty((0, columns.stop), np.float32))
        self._catalogue_codes = unit_embeddings(partials, columns)
        self._find = cache(rows.find_object)
        self._add(())

    def with_enrolled(self, touches: Sequence[EnrolledTouch]) -> "Objects":
        """Return the objects of the index and of these enrolled touches, in place of those of earlier ones."""
        changed = copy(self)
        vars(changed).pop("gel_images", None)
        changed._add(touches)
        return changed

    def _add(self, enrolled: Sequence[EnrolledTouch]) -> None:
        """Number the objects of enrolled touches, and order all reference touches by object."""
        touches, codes = self._references.touches, self._catalogue_codes
        if enrolled and self._calibration:  # else touches cannot be compared, nor without codes of this model
            usable, partials = codes_of(enrolled, self._stored)
            codes = np.concatenate([codes, unit_embeddings(partials, self._columns)])
            like = {name: self._rows.names_like(name) for name in {touch.object_id for touch in usable}}
            spelled = {name: names[0] if len(names) == 1 else name for name, names in like.items()}  # by the catalogue
            touches = [
                *touches,
                *(
                    _ReferenceTouch(
                        spelled[touch.object_id],
                        tuple(touch.pictures),
                        tuple(touch.pictures.values()),
                        touch.opening_mm,
                        is_enrolled=True,
                    )
                    for touch in usable
                ),
            ]
        names = sorted({touch.object_id for touch in touches if touch.is_enrolled and self._find(touch.object_id) < 0})
        self._enrolled_only = {name: self._rows.object_count + place for place, name in enumerate(names)}
        self.count = self._rows.object_count + len(names)
        numbers = np.array([self.find(touch.object_id) for touch in touches], dtype=np.int64)
        order = np.argsort(numbers, kind="stable")
        order = order[numbers[order] >= 0]  # an object without a readable photo has no number
        self._touches = [touches[place] for place in order]
        self._codes = codes[order]
        self._openings_mm = np.array(
            [touch.opening_mm for touch in self._touches], dtype=np.float64
        )  # None becomes NaN
        self._owners = numbers[order]
        self._touched, self._starts = np.unique(self._owners, return_index=True)
        self._touch_only = np.isin(np.arange(self.count), [self.find(name) for name in self._references.touch_only])

    def find(self, name: str) -> int:
        """Return the number of the object with exactly this name; -1 if there is none."""
        return self._enrolled_only.get(name, self._find(name))

    def names_like(self, name: str) -> list[str]:
        """Return the objects that a person can mean by this name (`Rows.names_like`)."""
        if self.find(name) >= 0:
            return [name]
        return self._rows.names_like(name) + [
            enrolled for enrolled in self._enrolled_only if lookup_key(enrolled) == lookup_key(name)
        ]

    @property
    def reference_counts(self) -> tuple[int, int]:
        """Number of reference touches, and of their objects."""
        return len(self._touches), len(self._touched)

    @cached_property
    def gel_images(self) -> dict[str, ListedPhoto]:
        """The gel images of the reference touches, by path; queries do not need them."""
        return {
            path: ListedPhoto(reference.object_id, path, {}, digest, is_touch=True, is_enrolled=reference.is_enrolled)
            for reference in (*self._references.touches, *self._touches)
            for path, digest in zip(reference.touch, reference.digests, strict=True)
        }

    @property
    def enrolled_pictures(self) -> list[ListedPhoto]:
        """A gel image of each touch of the objects that only the table of enrolled touches has, by object."""
        start = np.searchsorted(self._owners, self._rows.object_count)
        return [self.gel_images[reference.touch[0]] for reference in self._touches[start:]]

    @property
    def counts(self) -> tuple[int, int]:
        """Number of objects, and of enrolled touches."""
        return self.count, sum(reference.is_enrolled for reference in self._touches)

    def compare_references(self, partials: Floats, openings_mm: NDArray[np.float64] | None = None) -> ReferenceEvidence:
        """Compare grasps with the reference touches of all objects.

        Args:
            partials: (G, touch_partial_width) partial activations of the grasps.
            openings_mm: (G,) openings of the jaws, NaN where none was measured. Default: none was measured.
        """
        similarities, openings, compared = np.full(self.count, np.nan), np.zeros(self.count), 0
        if len(self._touched):
            cosines = unit_embeddings(partials, self._columns) @ self._codes.T
            similarities[self._touched] = reference_similarity(cosines, self._starts).sum(0)
            if self._opening is not None and openings_mm is not None and np.isfinite(openings_mm).any():
                openings[self._touched] = self._opening.log_ratios(openings_mm, self._openings_mm, self._starts).sum(0)
                compared = len(np.unique(self._owners[np.isfinite(self._openings_mm)]))
        return ReferenceEvidence(similarities, openings, compared)

    def score(self, rows: Rows, logits: Floats, evidence: ReferenceEvidence, grasps: int) -> ScoredObjects:
        """Return the objects of scored photos with their logits and best photos; ties take the first photo.

        Args:
            rows: Rows (n,) of the scored photos.
            logits: Their match logits (n,), summed over the grasps.
            evidence: Comparison of the grasps with the reference touches.
            grasps: Number of grasps.
        """
        # Equal photos get equal logits, of the first one: a matrix product may round its last rows differently.
        originals, of_original = self._originals[rows], np.empty(len(self._originals), dtype=np.float32)
        of_original[originals[::-1]] = logits[::-1]  # the last assignment remains
        logits = of_original[originals]
        numbers, owner = np.unique(self._of_row[rows], return_inverse=True)
        order = np.lexsort((rows, -logits, owner))
        first = order[np.searchsorted(owner[order], np.arange(len(numbers)))]

        posterior, counts = self.posterior, self._photos[numbers]
        from_photos = posterior.object_logits(logits, owner, counts, grasps)
        combined, mine, touch_only = from_photos.copy(), evidence.similarities[numbers], self._touch_only[numbers]
        if (calibration := self._calibration) is not None:
            one, both = np.isfinite(mine) & touch_only, np.isfinite(mine) & ~touch_only
            combined[one] = posterior.logit_of(calibration.touch_only.log_ratio(mine[one], grasps), grasps)
            if both.any() and calibration.with_photos is not None and calibration.weight is not None:
                # Objects with both photos and reference touches have a posterior of their own.
                sums = calibration.with_photos.object_logits(logits, owner, counts, grasps) + calibration.weight * mine
                ratios = calibration.with_photos.log_ratio(sums[both], grasps)
                combined[both] = posterior.logit_of(ratios, grasps)
        combined += evidence.openings[numbers] / posterior.slope  # a log ratio, as summed match logits are
        return ScoredObjects(numbers, combined, rows[first], np.where(touch_only, np.nan, from_photos))

    def score_enrolled_only(self, evidence: ReferenceEvidence, grasps: int) -> ScoredObjects:
        """Return the objects that only the table of enrolled touches has, with their logits."""
        numbers, logits = np.arange(self._rows.object_count, self.count), np.empty(0)
        calibration = self._calibration
        if calibration is not None and len(numbers):
            ratios = calibration.touch_only.log_ratio(evidence.similarities[numbers], grasps)
            logits = self.posterior.logit_of(ratios, grasps) + evidence.openings[numbers] / self.posterior.slope
        return ScoredObjects(numbers, logits, np.full_like(numbers, -1), np.full(len(numbers), np.nan))

    def other_rows(self, numbers: Rows, rows: Rows) -> Rows:
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
        drawn = np.zeros(self._rows.object_count, dtype=bool)
        drawn[np.random.default_rng(0).permutation(len(drawn))[:SAMPLE]] = True
        rows = np.flatnonzero(drawn[self._of_row])
        return rows, self._of_row[rows]

    def nearest_by_reference(self, evidence: ReferenceEvidence, maximum: int) -> Rows:
        """Return the objects that their reference touches make most likely, at most `maximum`."""
        slope = 1.0 if self._calibration is None else self._calibration.touch_only.slope
        ratios = slope * evidence.similarities[self._touched] + evidence.openings[self._touched]
        return np.asarray(self._touched[np.argsort(-ratios, kind="stable")[:maximum]])

    def nearest_reference(self, scored: ScoredObjects, place: int, partials: Floats) -> NearestReference | None:
        """Return the reference touch of the object at `place` nearest to one of the grasps; None if it has none."""
        number = scored.numbers[place]
        start, stop = np.searchsorted(self._owners, (number, number + 1))
        if start == stop:
            return None
        cosines = (unit_embeddings(partials, self._columns) @ self._codes[start:stop].T).max(0)
        best = int(cosines.argmax())
        adds = float(scored.logits[place] - scored.photo_logits[place])
        nearest, adds_or_none = self._touches[start + best], None if np.isnan(adds) else adds
        return NearestReference(nearest.touch, nearest.digests, float(cosines[best]), adds_or_none, nearest.is_enrolled)
