"""Calibration of reference touches: touches of catalogue objects with which a query's touch is compared.

    c(g, o) = 1 / SHARPNESS * log mean exp(SHARPNESS * cosine)   grasp g with object o, over the references of o
    C(o)    = sum of c(g, o) over the grasps

The cosine is that of the contrastive embeddings of two touches. The references of an object are equally likely, so a
copy of a reference changes nothing. C is calibrated like match logits (`retrieval.model.posterior`), on objects some of
whose touches are references and the others queries:

    an object with touches only       log likelihood ratio = w_a C + offset_a
    an object with photos, too        log likelihood ratio = w_b (l_b + weight C) + offset_b

w_a, offset_a and w_b, offset_b are those of two posteriors, and l_b is the object's logit over its photos by the second
one. The second is fitted on the sums, because photo and reference are compared with the same touch and are not
independent evidence. Each ratio is converted to the logit of an object with photos only and the same ratio. One formula
then ranks all objects of a catalogue and gives their probabilities, with photos, references or both.
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
from retrieval.model.calibration_touches import CalibrationTouches
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
"""Names in an index: of the document that lists its reference touches (and, in the manifest, of their number), of their
partial activations and, in the manifest, of their calibration."""
SHARPNESS = 16.0
"""Weight of the nearest of an object's references relative to the others. With 8, with 16 and with only the nearest,
unseen simulated objects were found equally often."""
MAX_REFERENCES = 3
"""Largest number of references of an object in the fit: a typical number if a user records few."""
WEIGHT_BOUNDS = (0.01, 1000.0)
"""Search range of the weight of C next to photos."""


@dataclass(frozen=True)
class ReferenceCalibration:
    """Parameters of the formulas above.

    Attributes:
        touch_only: Posterior of objects without photos.
        weight: Weight of C for objects with photos; None if no object had both.
        with_photos: Posterior of objects with photos; None if no object had both.
        objects: Number of objects of the fit.
        touches: Number of their query touches.
    """

    touch_only: Posterior
    weight: Annotated[float, Meta(ge=0, le=1e9)] | None
    with_photos: Posterior | None
    objects: Annotated[int, Meta(ge=0)]
    touches: Annotated[int, Meta(ge=0)]

    def __post_init__(self) -> None:
        check_fields(self, "references", BadInput)
        if (self.weight is None) != (self.with_photos is None):
            raise BadInput("weight and with_photos must both be present or both be absent; one of them is missing")

    def to_dict(self) -> dict[str, Any]:
        """Return a plain dictionary, as stored in checkpoints and in the manifests of indexes."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, data: Any) -> "ReferenceCalibration":
        """Inverse of `to_dict`. Raises BadInput for anything else."""
        return typed(data, cls, "references", complete=True, error=BadInput)


def unit_embeddings(partials: NDArray[np.floating[Any]], columns: slice) -> Floats:
    """Return the unit contrastive embeddings (B, d) of touches or photos.

    Args:
        partials: (B, partial) partial activations.
        columns: Their d columns with the scaled embeddings (`MatcherConfig.cosine_columns`). d is 0 for a model whose
            logit has no cosine.
    """
    embeddings = np.asarray(partials[:, columns], dtype=np.float32)
    return np.asarray(embeddings / np.maximum(np.linalg.norm(embeddings, axis=1, keepdims=True), np.float32(1e-6)))


def reference_similarity(cosines: NDArray[np.floating[Any]], starts: Numbers) -> NDArray[np.float64]:
    """Return C (G, O) of cosines (G, R) of grasps with references; an object's columns begin at `starts` (O,)."""
    scaled = SHARPNESS * cosines.astype(np.float64)
    counts = np.diff(np.append(starts, scaled.shape[1]))
    top = np.maximum.reduceat(scaled, starts, axis=1)
    sums = np.add.reduceat(np.exp(scaled - np.repeat(top, counts, axis=1)), starts, axis=1)
    return np.asarray((top + np.log(sums / counts)) / SHARPNESS)


# Fitting ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _ReferenceTrials:
    """Trials on objects some of whose touches are references: C of the others, and their match logits with photos."""

    touch_only: ScoredTouches
    photos: ScoredTouches

    @property
    def both(self) -> NDArray[np.float64]:
        """C (T, N) of each touch with the object of each photo."""
        return np.asarray(self.touch_only.logits[:, self.photos.photo_owner])

    @property
    def can_fit_photos(self) -> bool:
        """Whether identification trials among the objects with photos are possible."""
        own = self.photos.photo_owner == self.photos.touch_owner[:, None]
        return len(np.unique(self.photos.photo_owner)) >= MIN_OBJECTS and bool((own & ~self.photos.own).any())


def fit_reference_calibration(*parts: CalibrationTouches, seed: int = 0) -> ReferenceCalibration | None:
    """Fit on touches of objects that have at least two.

    References come from the first half of an object's touches, or from the first quarter if that suffices, at most
    `MAX_REFERENCES`. The queries are the second half, so with enough touches no query neighbours a reference. All
    trials are repeated with one reference per object, because a fit to three references is overconfident for one.

    Args:
        parts: Touches of one matcher or several, as in `retrieval.model.posterior.fit_posterior`.
        seed: Seed of the trials.

    Returns:
        The calibration; None for fewer than three such objects, or for a model without embeddings.
    """
    encoded = [part for part in parts if part.touch_embeddings.shape[1]]
    many, one = (
        [found for part in encoded if (found := _reference_trials(part, max_references)) is not None]
        for max_references in (MAX_REFERENCES, 1)
    )
    if not many:
        return None
    trials = [*many, *one]
    with_both = [part for part in trials if part.can_fit_photos]
    weight = _weight(with_both, seed) if with_both else None
    with_photos = None
    if weight is not None:
        sums = (dataclasses.replace(part.photos, logits=part.photos.logits + weight * part.both) for part in with_both)
        with_photos = fit_posterior(*sums, seed=seed)
    return ReferenceCalibration(
        fit_posterior(*(part.touch_only for part in trials), seed=seed),
        weight,
        with_photos,
        sum(len(part.touch_only.photo_owner) for part in many),
        sum(len(part.touch_only.touch_owner) for part in many),
    )


def _reference_trials(part: CalibrationTouches, max_references: int) -> _ReferenceTrials | None:
    """Return the trials with at most `max_references` references per object; None for too few objects."""
    scored = part.scored
    rows = [np.flatnonzero(scored.touch_owner == name) for name in np.unique(scored.touch_owner)]
    rows = [mine for mine in rows if len(mine) > 1]
    if len(rows) < MIN_OBJECTS:
        return None
    references = [
        _evenly_spaced(mine[: max(len(mine) // 4, min(MAX_REFERENCES, len(mine) // 2))], max_references)
        for mine in rows
    ]
    queries = np.concatenate([mine[len(mine) // 2 :] for mine in rows])
    owner = np.repeat(np.arange(len(rows)), [len(mine) - len(mine) // 2 for mine in rows])
    cosines = part.touch_embeddings[queries] @ part.touch_embeddings[np.concatenate(references)].T
    near = reference_similarity(cosines, np.cumsum([0, *(len(some) for some in references[:-1])]))
    number = {int(scored.touch_owner[mine[0]]): place for place, mine in enumerate(rows)}
    known = np.flatnonzero(np.isin(scored.photo_owner, list(number)))
    photo_owner = np.array([number[int(name)] for name in scored.photo_owner[known]], np.int64)
    return _ReferenceTrials(
        ScoredTouches(near, owner, np.arange(len(rows)), np.zeros(near.shape, np.bool_)),
        ScoredTouches(scored.logits[np.ix_(queries, known)], owner, photo_owner, scored.own[np.ix_(queries, known)]),
    )


def _evenly_spaced(rows: Numbers, max_references: int) -> Numbers:
    """Return at most `max_references` of the rows, evenly spaced."""
    places = np.linspace(0, len(rows) - 1, min(max_references, len(rows)))
    return np.asarray(rows[places.round().astype(np.int64)])


def _weight(trials: Sequence[_ReferenceTrials], seed: int) -> float:
    """Return the most likely weight of C, in match logits, over identification trials with single touches."""
    from scipy.optimize import minimize_scalar  # slow to import; queries do not need it

    photos = [next(identification_trials(part.photos, seed)) for part in trials]
    near = [next(identification_trials(dataclasses.replace(part.photos, logits=part.both), seed)) for part in trials]
    count = sum(len(one.scores) for one in photos)

    def loss(log_weight: float) -> float:
        weight = math.exp(log_weight)
        sums = [
            dataclasses.replace(photo, scores=photo.scores + weight * touch.scores)
            for photo, touch in zip(photos, near, strict=True)
        ]
        posterior = fit_posterior_to_trials(sums)
        return sum(len(one.scores) * one.loss(posterior, 1 / (count + 2)) for one in sums) / count

    bounds = [math.log(weight) for weight in WEIGHT_BOUNDS]
    return math.exp(float(minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 0.1}).x))
