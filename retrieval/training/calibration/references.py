"""Fit the calibration of reference touches (`retrieval.model.references`)."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retrieval.model.references import ReferenceCalibration, reference_similarity
from retrieval.training.calibration.posterior import (
    MIN_OBJECTS,
    fit_posterior,
    fit_posterior_to_trials,
    identification_trials,
)
from retrieval.training.calibration.touches import ScoredTouches

MAX_REFERENCES = 3
"""Largest number of references of an object in the fit: a typical number if a user records few."""
WEIGHT_BOUNDS = (0.01, 1000.0)
"""Search range of the weight of C next to photos."""


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


def fit_references(*parts: ScoredTouches, seed: int = 0) -> ReferenceCalibration | None:
    """Fit on touches of objects that have at least two.

    References come from the first half of an object's touches, or from the first quarter if that suffices, at most
    `MAX_REFERENCES`. The queries are the second half, so with enough touches no query neighbours a reference. All
    trials are repeated with one reference per object, because a fit to three references is overconfident for one.

    None for fewer than three such objects, or for a model without embeddings.
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


def _reference_trials(part: ScoredTouches, max_references: int) -> _ReferenceTrials | None:
    """Return the trials with at most `max_references` references per object; None for too few objects."""
    rows = [np.flatnonzero(part.touch_owner == name) for name in np.unique(part.touch_owner)]
    rows = [mine for mine in rows if len(mine) > 1]
    if len(rows) < MIN_OBJECTS:
        return None
    references = []
    for mine in rows:
        shown = mine[: max(len(mine) // 4, min(MAX_REFERENCES, len(mine) // 2))]
        places = np.linspace(0, len(shown) - 1, min(max_references, len(shown)))  # evenly spaced
        references.append(shown[places.round().astype(np.int64)])
    queries = np.concatenate([mine[len(mine) // 2 :] for mine in rows])
    owner = np.repeat(np.arange(len(rows)), [len(mine) - len(mine) // 2 for mine in rows])
    cosines = part.touch_embeddings[queries] @ part.touch_embeddings[np.concatenate(references)].T
    near = reference_similarity(cosines, np.cumsum([0, *(len(some) for some in references[:-1])]))
    number = {int(part.touch_owner[mine[0]]): place for place, mine in enumerate(rows)}
    known = np.flatnonzero(np.isin(part.photo_owner, list(number)))
    photo_owner = np.array([number[int(name)] for name in part.photo_owner[known]], np.int64)
    return _ReferenceTrials(
        ScoredTouches(near, owner, np.arange(len(rows)), np.zeros(near.shape, np.bool_)),
        ScoredTouches(part.logits[np.ix_(queries, known)], owner, photo_owner, part.own[np.ix_(queries, known)]),
    )


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
