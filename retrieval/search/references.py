"""Reference touches of an opened index: their contribution to object logits, and the nearest one of an object."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.documents import typed
from indexes.errors import AGAIN, CorruptIndex
from indexes.store.generation import Generation
from retrieval.data.text import is_inside
from retrieval.errors import BadInput
from retrieval.model.posterior import Posterior
from retrieval.model.references import (
    REFERENCE_CALIBRATION,
    REFERENCE_PARTIALS,
    REFERENCE_ROWS,
    Floats,
    Numbers,
    ReferenceCalibration,
    reference_similarity,
    unit_embeddings,
)
from retrieval.search.answer import NearestReference
from retrieval.search.objects import ListedPhoto, Objects, ScoredObjects

Similarities = NDArray[np.float64]


@dataclass(frozen=True)
class _ReferenceTouch:
    """A reference touch: its object, the paths of its gel images, and the digests of their files."""

    object_id: str
    touch: tuple[str, ...]
    digests: tuple[str, ...]


@dataclass(frozen=True)
class _ReferenceDocument:
    """The document of reference touches, and the objects without photos."""

    touches: list[_ReferenceTouch]
    touch_only: list[str]


class References:
    """Reference touches of a generation's objects, which are numbered as in `Objects`.

    `similarities` (count,) is the value C of each object with the grasps of a query, NaN without a reference
    (`retrieval.model.references`).
    """

    def __init__(self, generation: Generation, objects: Objects, columns: slice) -> None:
        """Read and check the references.

        Args:
            generation: An opened generation with reference touches.
            objects: Its objects.
            columns: Columns of a partial activation with the scaled embedding.

        Raises:
            CorruptIndex: The documents are damaged.
        """
        where, documents = generation.folder, generation.documents
        try:
            listed = typed(documents[REFERENCE_ROWS], _ReferenceDocument)
            if not all(len(one.touch) == len(one.digests) and all(map(is_inside, one.touch)) for one in listed.touches):
                raise ValueError("a gel image is outside the catalogue or has no digest")
        except ValueError as error:
            raise CorruptIndex(f"{where}: the list of reference touches is invalid ({error}); {AGAIN}") from error
        touches, touch_only = listed.touches, listed.touch_only
        partials = documents.get(REFERENCE_PARTIALS)
        if (
            not isinstance(partials, np.ndarray)
            or partials.ndim != 2
            or len(partials) != len(touches)
            or partials.shape[1] < columns.stop
            or partials.dtype.kind != "f"
        ):
            raise CorruptIndex(
                f"{where}: each reference touch must have a partial activation of at least {columns.stop} numbers; "
                f"{AGAIN}"
            )
        try:
            self.calibration = ReferenceCalibration.from_dict(
                reference_summary(generation.manifest.about).get("calibration")
            )
        except (BadInput, TypeError) as error:
            raise CorruptIndex(f"{where}: the calibration of its references is damaged ({error}); {AGAIN}") from error
        names = [one.object_id for one in touches] + touch_only
        known = np.array([generation.rows.find_object(name) for name in names], dtype=np.int64)
        numbers, without_photos = known[: len(touches)], known[len(touches) :]
        order = np.flatnonzero(numbers >= 0)  # an object without a readable photo has no number
        order = order[np.argsort(numbers[order], kind="stable")]
        self._touches, self._all = [touches[row].touch for row in order], touches
        self._codes: Floats = unit_embeddings(partials[order], columns)
        self._objects, self._starts = np.unique(numbers[order], return_index=True)
        self._columns, self._touch_only = columns, np.zeros(objects.count, np.bool_)
        self._touch_only[without_photos[without_photos >= 0]] = True

    def image(self, path: str) -> ListedPhoto | None:
        """Return the gel image of a reference touch with this path in the catalogue; None if there is none."""
        return self._images.get(path)

    @cached_property
    def _images(self) -> dict[str, ListedPhoto]:
        """Gel images by path; queries do not need them."""
        return {
            path: ListedPhoto(one.object_id, path, {}, digest, is_touch=True)
            for one in self._all
            for path, digest in zip(one.touch, one.digests, strict=True)
        }

    def similarities_to_objects(self, partials: Floats) -> Similarities:
        """Return the similarities (count,) of grasps, as partial activations (G, touch_partial_width), with objects."""
        found = np.full(len(self._touch_only), np.nan)
        if len(self._objects):
            found[self._objects] = reference_similarity(
                unit_embeddings(partials, self._columns) @ self._codes.T, self._starts
            ).sum(0)
        return found

    def nearest_objects(self, similarities: Similarities, maximum: int) -> Numbers:
        """Return the objects with the largest similarities, at most `maximum`."""
        order = np.argsort(-similarities[self._objects], kind="stable")
        return np.asarray(self._objects[order[:maximum]])

    def combine(
        self,
        scored: ScoredObjects,
        both_logits: ScoredObjects | None,
        similarities: Similarities,
        posterior: Posterior,
        grasps: int,
    ) -> ScoredObjects:
        """Return the objects with the combined logits of photos and references.

        Args:
            scored: Objects scored by their photos.
            both_logits: The same objects, scored by photos with the posterior for photos next to references; None if
                no object has both.
            similarities: Similarities (count,) with the references.
            posterior: Posterior of photos.
            grasps: Number of grasps.
        """
        mine, touch_only = similarities[scored.numbers], self._touch_only[scored.numbers]
        touched, logits = np.isfinite(mine), scored.logits.copy()
        one = touched & touch_only
        logits[one] = posterior.logit_of(self.calibration.touch_only.log_ratio(mine[one], grasps), grasps)
        both = touched & ~touch_only
        if both_logits is not None and self.calibration.with_photos is not None and self.calibration.weight is not None:
            sums = both_logits.logits[both] + self.calibration.weight * mine[both]
            logits[both] = posterior.logit_of(self.calibration.with_photos.log_ratio(sums, grasps), grasps)
        return scored._replace(logits=logits, photo_logits=np.where(touch_only, np.nan, scored.logits))

    def nearest(self, number: int, partials: Floats, logit: float, photo_logits: float) -> NearestReference | None:
        """Return the nearest reference touch of an object.

        Args:
            number: Number of the object.
            partials: Partial activations (G, touch_partial_width) of the grasps.
            logit: Logit of the object.
            photo_logits: Its logit from photos only; NaN without photos.

        Returns:
            The reference; None if the object has none.
        """
        place = int(np.searchsorted(self._objects, number))
        if place == len(self._objects) or self._objects[place] != number:
            return None
        start = int(self._starts[place])
        stop = int(self._starts[place + 1]) if place + 1 < len(self._starts) else len(self._codes)
        cosines = (unit_embeddings(partials, self._columns) @ self._codes[start:stop].T).max(0)
        best = int(cosines.argmax())
        adds = None if np.isnan(photo_logits) else logit - photo_logits
        return NearestReference(self._touches[start + best], float(cosines[best]), adds)


def reference_summary(about: Mapping[str, Any]) -> dict[str, Any]:
    """Return a manifest's entries about reference touches: counts and calibration; empty without references."""
    counts, calibration = about.get(REFERENCE_ROWS), about.get(REFERENCE_CALIBRATION)
    return {**counts, **calibration} if isinstance(counts, dict) and isinstance(calibration, dict) else {}
