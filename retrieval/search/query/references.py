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
from retrieval.model.references import CODES, ROWS, WORTH, Floats, Numbers, ReferenceWorth, nearness, touch_codes
from retrieval.search.query.answer import NearestReference
from retrieval.search.query.objects import JudgedObjects, Objects

Near = NDArray[np.float64]


@dataclass(frozen=True)
class _Touch:
    """A reference touch: its object, the paths of its gel images, and the digests of their files."""

    object_id: str
    touch: tuple[str, ...]
    digests: tuple[str, ...]


@dataclass(frozen=True)
class _Listed:
    """The document of reference touches, and the objects without photos."""

    touches: list[_Touch]
    alone: list[str]


class References:
    """Touches of a generation's objects; `count` objects are numbered as in `Objects`."""

    def __init__(self, generation: Generation, objects: Objects, hidden: int) -> None:
        """hidden: numbers of a half before its embedding. Raises CorruptIndex."""
        where, documents = generation.folder, generation.documents
        try:
            listed = typed(documents[ROWS], _Listed)
            if not all(len(one.touch) == len(one.digests) and all(map(is_inside, one.touch)) for one in listed.touches):
                raise ValueError("a gel image lies outside the catalogue or has no digest")
        except ValueError as error:
            raise CorruptIndex(
                f"{where}: its list of reference touches is not what the format says ({error}); {AGAIN}"
            ) from error
        touches, alone = listed.touches, listed.alone
        halves = documents.get(CODES)
        width = generation.arrays["halves"].shape[1]
        if not isinstance(halves, np.ndarray) or halves.shape != (len(touches), width) or halves.dtype.kind != "f":
            raise CorruptIndex(f"{where}: it must hold a half of {width} numbers of each reference touch; {AGAIN}")
        try:
            self.worth = ReferenceWorth.from_dict(told_of(generation.manifest.about).get("worth"))
        except (BadInput, TypeError) as error:
            raise CorruptIndex(f"{where}: what its references are worth is damaged ({error}); {AGAIN}") from error
        known = objects.numbers_of([one.object_id for one in touches] + alone)
        numbers, shown_alone = known[: len(touches)], known[len(touches) :]
        order = np.flatnonzero(numbers >= 0)  # an object whose photos are all broken has no number
        order = order[np.argsort(numbers[order], kind="stable")]
        self._touches, self._all = [touches[row].touch for row in order], touches
        self._codes: Floats = touch_codes(halves[order], hidden)
        self._objects, self._starts = np.unique(numbers[order], return_index=True)
        self._hidden, self._alone = hidden, np.zeros(objects.count, np.bool_)
        self._alone[shown_alone[shown_alone >= 0]] = True

    def image(self, path: str) -> dict[str, Any] | None:
        """A row for the gel image at this path of the catalogue, as those of photos, but with `touch`; None where no
        reference has it."""
        if path not in self._images:
            return None
        one, digest = self._images[path]
        told = {"object_id": one.object_id, "digest": digest, "metadata": {}, "touch": True}
        return {"id": path, "path": path, **told}

    @cached_property
    def _images(self) -> dict[str, tuple[_Touch, str]]:
        """Touch and digest of each gel image; a query needs none of it."""
        return {path: (one, digest) for one in self._all for path, digest in zip(one.touch, one.digests, strict=True)}

    def near(self, halves: Floats) -> Near:
        """C (count,) of the grasps with these halves (G, half) with every object; NaN where it has no reference."""
        found = np.full(len(self._alone), np.nan)
        if len(self._objects):
            found[self._objects] = nearness(touch_codes(halves, self._hidden) @ self._codes.T, self._starts).sum(0)
        return found

    def nearest_objects(self, near: Near, most: int) -> Numbers:
        """At most so many objects of largest C."""
        order = np.argsort(-near[self._objects], kind="stable")
        return np.asarray(self._objects[order[:most]])

    def added(
        self, judged: JudgedObjects, by_both: JudgedObjects | None, near: Near, posterior: Posterior, grasps: int
    ) -> JudgedObjects:
        """The objects with the logits that photos and references give them together.

        by_both: the same objects by their photos, as the posterior beside references takes these; None where no object
        has both.
        """
        mine, alone = near[judged.numbers], self._alone[judged.numbers]
        felt, logits = np.isfinite(mine), judged.logits.copy()
        one = felt & alone
        logits[one] = posterior.logit_of(self.worth.alone.log_ratio(mine[one], grasps), grasps)
        both = felt & ~alone
        if by_both is not None and self.worth.beside is not None and self.worth.weight is not None:
            sums = by_both.logits[both] + self.worth.weight * mine[both]
            logits[both] = posterior.logit_of(self.worth.beside.log_ratio(sums, grasps), grasps)
        return judged._replace(logits=logits, by_photos=np.where(alone, np.nan, judged.logits))

    def nearest(self, number: int, halves: Floats, logit: float, by_photos: float) -> NearestReference | None:
        """That of an object, with its logit and the one that photos alone give it (NaN without photos)."""
        place = int(np.searchsorted(self._objects, number))
        if place == len(self._objects) or self._objects[place] != number:
            return None
        start = int(self._starts[place])
        stop = int(self._starts[place + 1]) if place + 1 < len(self._starts) else len(self._codes)
        cosines = (touch_codes(halves, self._hidden) @ self._codes[start:stop].T).max(0)
        best = int(cosines.argmax())
        adds = None if np.isnan(by_photos) else logit - by_photos
        return NearestReference(self._touches[start + best], float(cosines[best]), adds)


def told_of(about: Mapping[str, Any]) -> dict[str, Any]:
    """What a manifest says of reference touches: how many, of how many objects, and what they are worth; nothing where
    there are none."""
    counts, worth = about.get(ROWS), about.get(WORTH)
    return {**counts, **worth} if isinstance(counts, dict) and isinstance(worth, dict) else {}
