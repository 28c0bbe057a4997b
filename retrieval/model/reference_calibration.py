"""What reference touches are worth: touches of the catalogue's objects, with which a query's touch is compared.

    c(g, o) = 1 / SHARPNESS * log mean exp(SHARPNESS * cosine)   grasp g with object o, over the references of o
    C(o)    = sum of c(g, o) over the grasps

The cosine is that of the contrastive embeddings of two touches; a reference is one touch of its object, each as likely,
so a copy of a reference changes nothing. What C says is fitted as match logits are (`retrieval.model.posterior`), on
objects whose touches are in part references and in part ask:

    an object shown by touches alone    log likelihood ratio = w_a C + offset_a
    an object shown by photos, too      log likelihood ratio = w_b (l_b + weight C) + offset_b

w_a, offset_a and w_b, offset_b are those of two posteriors, l_b the object's logit over its photos by the second one.
The second is fitted on sums of both, for photo and reference are asked by one and the same touch and do not count as
two witnesses. Told as the logit that an object with photos alone would have for that ratio, all objects of a catalogue
are ranked and believed by one formula, whatever shows them.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from _touch_retrieval.documents import check_fields, typed
from retrieval.errors import BadInput
from retrieval.model.posterior import (
    MIN_OBJECTS,
    Posterior,
    ScoredTouches,
    fit_posterior,
    fit_posterior_to_trials,
    identification_trials,
)

Floats = NDArray[np.float32]
Numbers = NDArray[np.int64]
REFERENCE_ROWS, REFERENCE_PARTIALS, REFERENCE_CALIBRATION = "references", "touches", "reference_calibration"
"""Names in an index: of the document that lists its reference touches (and in the manifest, of their number), of their
partial activations, and in the manifest, of their calibration."""
SHARPNESS = 16.0
"""How far the nearest of an object's references counts before the others; of simulated unseen objects 8, 16 and the
nearest alone found the object equally often."""
MAX_REFERENCES = 3
"""Of an object, when it is fitted what they are worth: as many as somebody takes who takes few."""
WEIGHT_BOUNDS = (0.01, 1000.0)
"""Within which the weight beside photos is looked for."""


@dataclass(frozen=True)
class ReferenceCalibration:
    """The numbers of the formulas above. alone: of objects without photos; weight, beside: of those with photos, None
    where no object had both. objects, touches: on how many it was fitted, and how many touches of these asked.
    """

    touch_only: Posterior
    weight: Annotated[float, Meta(ge=0, le=1e9)] | None
    with_photos: Posterior | None
    objects: Annotated[int, Meta(ge=0)]
    touches: Annotated[int, Meta(ge=0)]

    def __post_init__(self) -> None:
        check_fields(self, "references", BadInput)
        if (self.weight is None) != (self.with_photos is None):
            raise BadInput("a weight beside photos and its posterior go together; one of them is missing")

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary, as stored in checkpoints and in the manifests of indexes."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, data: Any) -> "ReferenceCalibration":
        """Inverse of `to_dict`. Raises BadInput for anything else."""
        return typed(data, cls, "references", complete=True, error=BadInput)


def touch_embeddings(partials: NDArray[np.floating[Any]], hidden: int) -> Floats:
    """Unit contrastive embeddings (G, d) of touches, from halves (G, hidden + d) that end with them; d is 0 for a model
    whose logit counts no cosine.
    """
    embeddings = np.asarray(partials[:, hidden:], dtype=np.float32)
    return np.asarray(embeddings / np.maximum(np.linalg.norm(embeddings, axis=1, keepdims=True), np.float32(1e-6)))


def reference_similarity(cosines: NDArray[np.floating[Any]], starts: Numbers) -> NDArray[np.float64]:
    """C (G, O) of cosines (G, R) of grasps with references, those of an object side by side from `starts` (O,) on."""
    scaled = SHARPNESS * cosines.astype(np.float64)
    counts = np.diff(np.append(starts, scaled.shape[1]))
    top = np.maximum.reduceat(scaled, starts, axis=1)
    sums = np.add.reduceat(np.exp(scaled - np.repeat(top, counts, axis=1)), starts, axis=1)
    return np.asarray((top + np.log(sums / counts)) / SHARPNESS)


# Fitting ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ReferenceTouches:
    """Touches of known objects in the order of capture, with their codes (T, d) and what photos say of them; there may
    be no photo.
    """

    scored: ScoredTouches
    embeddings: Floats


@dataclass(frozen=True, eq=False)
class _ReferenceTrials:
    """Objects some of whose touches are references: C of the others, alone, and these with the photos' logits."""

    touch_only: ScoredTouches
    photos: ScoredTouches

    @property
    def both(self) -> NDArray[np.float64]:
        """(T, N): C of each touch with the object of each photo."""
        return np.asarray(self.touch_only.logits[:, self.photos.photo_owner])

    @property
    def can_fit_photos(self) -> bool:
        """Whether it can be asked which object it was of those with photos."""
        own = self.photos.photo_owner == self.photos.touch_owner[:, None]
        return len(np.unique(self.photos.photo_owner)) >= MIN_OBJECTS and bool((own & ~self.photos.own).any())


def fit_reference_calibration(*parts: ReferenceTouches, seed: int = 0) -> ReferenceCalibration | None:
    """What references are worth, by touches of objects that have two at least; None for fewer than three such objects,
    and for codes of nothing.

    parts: as `retrieval.model.posterior.fit_posterior` takes them. References are of an object's first half of touches,
    of many touches of the first quarter, at most `MAX_REFERENCES`; the last half asks. Where there are enough, so, no
    touch is asked beside its neighbour. All is asked once more of one reference of each object, so that what is fitted
    holds between: fitted to three alone, one is believed too much.
    """
    coded = [part for part in parts if part.embeddings.shape[1]]
    many, one = (
        [found for part in coded if (found := _reference_trials(part, max_references)) is not None]
        for max_references in (MAX_REFERENCES, 1)
    )
    if not many:
        return None
    trials = [*many, *one]
    seen = [part for part in trials if part.can_fit_photos]
    weight = _weight(seen, seed) if seen else None
    with_photos = None
    if weight is not None:
        sums = (dataclasses.replace(part.photos, logits=part.photos.logits + weight * part.both) for part in seen)
        with_photos = fit_posterior(*sums, seed=seed)
    return ReferenceCalibration(
        fit_posterior(*(part.touch_only for part in trials), seed=seed),
        weight,
        with_photos,
        sum(len(part.touch_only.photo_owner) for part in many),
        sum(len(part.touch_only.touch_owner) for part in many),
    )


def _reference_trials(part: ReferenceTouches, max_references: int) -> _ReferenceTrials | None:
    """With at most so many references of each object."""
    scored = part.scored
    rows = [np.flatnonzero(scored.touch_owner == name) for name in np.unique(scored.touch_owner)]
    rows = [mine for mine in rows if len(mine) > 1]
    if len(rows) < MIN_OBJECTS:
        return None
    shown = [
        _evenly_spaced(mine[: max(len(mine) // 4, min(MAX_REFERENCES, len(mine) // 2))], max_references)
        for mine in rows
    ]
    asking = np.concatenate([mine[len(mine) // 2 :] for mine in rows])
    owner = np.repeat(np.arange(len(rows)), [len(mine) - len(mine) // 2 for mine in rows])
    cosines = part.embeddings[asking] @ part.embeddings[np.concatenate(shown)].T
    near = reference_similarity(cosines, np.cumsum([0, *(len(some) for some in shown[:-1])]))
    number = {int(scored.touch_owner[mine[0]]): place for place, mine in enumerate(rows)}
    known = np.flatnonzero(np.isin(scored.photo_owner, list(number)))
    photo_owner = np.array([number[int(name)] for name in scored.photo_owner[known]], np.int64)
    return _ReferenceTrials(
        ScoredTouches(near, owner, np.arange(len(rows)), np.zeros(near.shape, np.bool_)),
        ScoredTouches(scored.logits[np.ix_(asking, known)], owner, photo_owner, scored.own[np.ix_(asking, known)]),
    )


def _evenly_spaced(rows: Numbers, max_references: int) -> Numbers:
    """At most so many of the rows, evenly spaced."""
    places = np.linspace(0, len(rows) - 1, min(max_references, len(rows)))
    return np.asarray(rows[places.round().astype(np.int64)])


def _weight(trials: Sequence[_ReferenceTrials], seed: int) -> float:
    """How many match logits a C of 1 is worth: the likeliest weight for "which object was it, or none", asked of single
    touches.
    """
    from scipy.optimize import minimize_scalar  # slow to import, and no query needs it

    photos = [next(identification_trials(part.photos, seed)) for part in trials]
    near = [next(identification_trials(dataclasses.replace(part.photos, logits=part.both), seed)) for part in trials]
    count = sum(len(one.scores) for one in photos)

    def loss(log_weight: float) -> float:
        weight = math.exp(log_weight)
        sums = [
            dataclasses.replace(seen, scores=seen.scores + weight * felt.scores)
            for seen, felt in zip(photos, near, strict=True)
        ]
        posterior = fit_posterior_to_trials(sums)
        return sum(len(one.scores) * one.loss(posterior, 1 / (count + 2)) for one in sums) / count

    bounds = [math.log(weight) for weight in WEIGHT_BOUNDS]
    return math.exp(float(minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 0.1}).x))
