"""Fit of the evidence of reference touches: their similarity to a touch, alone and next to photos."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from retrieval.model.references import ReferenceCalibration, reference_similarity
from retrieval.training.calibration.posterior import (
    fit_posterior,
    fit_posterior_to_trials,
    identification_trials,
    mean_loss,
)
from retrieval.training.calibration.scores import MIN_OBJECTS, Numbers, ScoredTouches

MAX_REFERENCES = 3
"""Largest number of references of an object in the fit: a typical number if a user records few."""
WEIGHT_BOUNDS = (0.01, 1000.0)
"""Search range of the weight of C next to photos."""


def fit_references(*parts: ScoredTouches, seed: int = 0) -> ReferenceCalibration | None:
    """Fit on touches of objects that have at least two.

    References come from the first half of an object's touches, or from the first quarter if that suffices, at most
    `MAX_REFERENCES`. The queries are the second half, so with enough touches no query neighbours a reference. All
    trials are repeated with one reference per object, because a fit to three references is overconfident for one.

    None for fewer than three such objects, or for a model without embeddings.
    """
    many, one = (
        [found for part in parts if (found := _reference_trials(part, max_references)) is not None]
        for max_references in (MAX_REFERENCES, 1)
    )
    if not many:
        return None
    trials, weight, with_photos = [*many, *one], None, None
    pairs = [
        (photos, dataclasses.replace(photos, logits=near.logits[:, photos.photo_owner]))
        for near, photos in trials
        if photos.has_trials
    ]
    if pairs:
        weight = _weight(pairs, seed)
        sums = (dataclasses.replace(photos, logits=photos.logits + weight * near.logits) for photos, near in pairs)
        with_photos = fit_posterior(*sums, seed=seed)
    return ReferenceCalibration(
        fit_posterior(*(near for near, _ in trials), seed=seed),
        weight,
        with_photos,
        sum(len(near.photo_owner) for near, _ in many),
        sum(len(near.touch_owner) for near, _ in many),
    )


def _reference_trials(part: ScoredTouches, max_references: int) -> tuple[ScoredTouches, ScoredTouches] | None:
    """Return C of the other touches with each object, and their match logits with one photo of each, its first one.

    At most `max_references` touches of each object are references. None for too few objects, or without embeddings.
    """
    sets = reference_sets(part.touch_owner, max_references, part.touch_group)
    if len(sets) < MIN_OBJECTS or not part.touch_embeddings.shape[1]:
        return None
    references, of_objects = zip(*sets, strict=True)
    queries, owner = np.concatenate(of_objects), np.repeat(np.arange(len(sets)), [len(some) for some in of_objects])
    cosines = part.touch_embeddings[queries] @ part.touch_embeddings[np.concatenate(references)].T
    near = reference_similarity(cosines, np.cumsum([0, *(len(some) for some in references[:-1])]))
    number = {int(part.touch_owner[mine[0]]): place for place, (mine, _) in enumerate(sets)}
    names, first = np.unique(part.photo_owner, return_index=True)
    known = first[np.isin(names, list(number))]
    photo_owner = np.array([number[int(name)] for name in part.photo_owner[known]], np.int64)
    shared = np.ix_(queries, known)
    return (
        ScoredTouches(near, owner, np.arange(len(sets)), np.zeros(near.shape, np.bool_)),
        ScoredTouches(part.logits[shared], owner, photo_owner, part.own[shared]),
    )


def reference_sets(owner: Numbers, max_references: int, group: Numbers | None = None) -> list[tuple[Numbers, Numbers]]:
    """Return the touches that are references, and the queries, of each object with both (`fit_references`).

    With `group`, the references are from the first half of an object's groups, the queries from the others.
    """
    sets = []
    for name in np.unique(owner):
        mine = np.flatnonzero(owner == name)
        shown, rows = mine[: max(len(mine) // 4, min(MAX_REFERENCES, len(mine) // 2))], mine[len(mine) // 2 :]
        if group is not None:
            groups = np.unique(group[mine])
            is_first = np.isin(group[mine], groups[: max(1, len(groups) // 2)])
            shown, rows = mine[is_first], mine[~is_first]
        places = np.linspace(0, len(shown) - 1, min(max_references, len(shown)))  # evenly spaced
        if len(shown) and len(rows):
            sets.append((shown[places.round().astype(np.int64)], rows))
    return sets


def _weight(pairs: Sequence[tuple[ScoredTouches, ScoredTouches]], seed: int) -> float:
    """Return the most likely weight of C, in match logits, over identification trials with single touches.

    Each pair has the match logits of touches with photos, and C of the touches with the objects of the same photos.
    """
    from scipy.optimize import minimize_scalar  # slow to import; queries do not need it

    trials = [[next(identification_trials(scored, seed)) for scored in pair] for pair in pairs]

    def loss(log_weight: float) -> float:
        sums = [
            dataclasses.replace(photos, scores=photos.scores + math.exp(log_weight) * near.scores)
            for photos, near in trials
        ]
        return mean_loss(sums, fit_posterior_to_trials(sums))

    bounds = [math.log(weight) for weight in WEIGHT_BOUNDS]
    return math.exp(float(minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 0.1}).x))
