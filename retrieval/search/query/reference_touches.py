"""Reference touches of an opened index: what they say of its objects, and which of them is nearest."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.documents import typed
from indexes.errors import AGAIN, CorruptIndex
from indexes.store.generation import Generation
from retrieval.data.storage import is_inside
from retrieval.errors import BadInput
from retrieval.model.posterior import Posterior
from retrieval.model.reference_calibration import (
    REFERENCE_CALIBRATION,
    REFERENCE_PARTIALS,
    REFERENCE_ROWS,
    Floats,
    Numbers,
    ReferenceCalibration,
    reference_similarity,
    touch_embeddings,
)
from retrieval.search.query.answer import NearestReference
from retrieval.search.query.objects import Objects, ScoredObjects

Nearness = NDArray[np.float64]


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
    """Touches of a generation's objects; `count` objects are numbered as in `Objects`."""

    def __init__(self, generation: Generation, objects: Objects, hidden: int) -> None:
        """hidden: numbers of a half before its embedding. Raises CorruptIndex."""
        where, documents = generation.folder, generation.documents
        try:
            listed = typed(documents[REFERENCE_ROWS], _ReferenceDocument)
            if not all(len(one.touch) == len(one.digests) and all(map(is_inside, one.touch)) for one in listed.touches):
                raise ValueError("a gel image lies outside the catalogue or has no digest")
        except ValueError as error:
            raise CorruptIndex(
                f"{where}: its list of reference touches is not what the format says ({error}); {AGAIN}"
            ) from error
        touches, touch_only = listed.touches, listed.touch_only
        partials = documents.get(REFERENCE_PARTIALS)
        width = generation.arrays["partials"].shape[1]
        if (
            not isinstance(partials, np.ndarray)
            or partials.shape != (len(touches), width)
            or partials.dtype.kind != "f"
        ):
            raise CorruptIndex(f"{where}: it must hold a half of {width} numbers of each reference touch; {AGAIN}")
        try:
            self.calibration = ReferenceCalibration.from_dict(
                reference_summary(generation.manifest.about).get("calibration")
            )
        except (BadInput, TypeError) as error:
            raise CorruptIndex(f"{where}: what its references are worth is damaged ({error}); {AGAIN}") from error
        known = objects.numbers_of([one.object_id for one in touches] + touch_only)
        numbers, shown_alone = known[: len(touches)], known[len(touches) :]
        order = np.flatnonzero(numbers >= 0)  # an object whose photos are all broken has no number
        order = order[np.argsort(numbers[order], kind="stable")]
        self._touches, self._all = [touches[row].touch for row in order], touches
        self._codes: Floats = touch_embeddings(partials[order], hidden)
        self._objects, self._starts = np.unique(numbers[order], return_index=True)
        self._hidden, self._alone = hidden, np.zeros(objects.count, np.bool_)
        self._alone[shown_alone[shown_alone >= 0]] = True

    def image(self, path: str) -> dict[str, Any] | None:
        """A row for the gel image at this path of the catalogue, as those of photos, but with `touch`; None where no
        reference has it.
        """
        if path not in self._images:
            return None
        one, digest = self._images[path]
        told = {"object_id": one.object_id, "digest": digest, "metadata": {}, "touch": True}
        return {"id": path, "path": path, **told}

    @cached_property
    def _images(self) -> dict[str, tuple[_ReferenceTouch, str]]:
        """Touch and digest of each gel image; a query needs none of it."""
        return {path: (one, digest) for one in self._all for path, digest in zip(one.touch, one.digests, strict=True)}

    def near(self, partials: Floats) -> Nearness:
        """C (count,) of the grasps with these halves (G, half) with every object; NaN where it has no reference."""
        found = np.full(len(self._alone), np.nan)
        if len(self._objects):
            found[self._objects] = reference_similarity(
                touch_embeddings(partials, self._hidden) @ self._codes.T, self._starts
            ).sum(0)
        return found

    def nearest_objects(self, near: Nearness, most: int) -> Numbers:
        """At most so many objects of largest C."""
        order = np.argsort(-near[self._objects], kind="stable")
        return np.asarray(self._objects[order[:most]])

    def combine(
        self,
        judged: ScoredObjects,
        both_logits: ScoredObjects | None,
        near: Nearness,
        posterior: Posterior,
        grasps: int,
    ) -> ScoredObjects:
        """The objects with the logits that photos and references give them together.

        by_both: the same objects by their photos, as the posterior beside references takes these; None where no object
        has both.
        """
        mine, touch_only = near[judged.numbers], self._alone[judged.numbers]
        felt, logits = np.isfinite(mine), judged.logits.copy()
        one = felt & touch_only
        logits[one] = posterior.logit_of(self.calibration.touch_only.log_ratio(mine[one], grasps), grasps)
        both = felt & ~touch_only
        if both_logits is not None and self.calibration.with_photos is not None and self.calibration.weight is not None:
            sums = both_logits.logits[both] + self.calibration.weight * mine[both]
            logits[both] = posterior.logit_of(self.calibration.with_photos.log_ratio(sums, grasps), grasps)
        return judged._replace(logits=logits, photo_logits=np.where(touch_only, np.nan, judged.logits))

    def nearest(self, number: int, partials: Floats, logit: float, photo_logits: float) -> NearestReference | None:
        """That of an object, with its logit and the one that photos alone give it (NaN without photos)."""
        place = int(np.searchsorted(self._objects, number))
        if place == len(self._objects) or self._objects[place] != number:
            return None
        start = int(self._starts[place])
        stop = int(self._starts[place + 1]) if place + 1 < len(self._starts) else len(self._codes)
        cosines = (touch_embeddings(partials, self._hidden) @ self._codes[start:stop].T).max(0)
        best = int(cosines.argmax())
        adds = None if np.isnan(photo_logits) else logit - photo_logits
        return NearestReference(self._touches[start + best], float(cosines[best]), adds)


def reference_summary(about: Mapping[str, Any]) -> dict[str, Any]:
    """What a manifest says of reference touches: how many, of how many objects, and what they are worth; nothing where
    there are none.
    """
    counts, calibration = about.get(REFERENCE_ROWS), about.get(REFERENCE_CALIBRATION)
    return {**counts, **calibration} if isinstance(counts, dict) and isinstance(calibration, dict) else {}
