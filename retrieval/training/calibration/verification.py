"""Fit the error rates of verification (`retrieval.model.verification`) on sequences of grasps."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from retrieval.model.posterior import Posterior
from retrieval.model.verification import LEVELS, MAX_GRASPS, QUANTILES, VerificationCalibration, supports_calibration
from retrieval.training.calibration.posterior import IdentificationTrials
from retrieval.training.calibration.touches import ScoredTouches

SEQUENCES = 8
"""Sequences of grasps of each validation object."""
Floats = NDArray[np.float64]


class VerificationSequences(NamedTuple):
    """Log likelihood ratios of sequences of G grasps.

    Attributes:
        owner: (S,) object of each sequence.
        ratios: (S, G) ratios of the right object after 1, 2, ... grasps.
        genuine: (G, S) the largest of them so far.
        impostor: (S, O - 1) largest ratio of each other object.
        similar: (S,) largest ratio of the most similar other object.
    """

    owner: NDArray[np.int64]
    ratios: Floats
    genuine: Floats
    impostor: Floats
    similar: Floats


def verification_sequences(
    scored: ScoredTouches, posterior: Posterior, seed: int = 0, grasps: int = MAX_GRASPS
) -> VerificationSequences | None:
    """Draw and score `SEQUENCES` sequences of each object that has `grasps` grasps and a photo of another grasp.

    The embeddings of the photos give the most similar object. Shorter sequences of a seed are the first grasps of
    longer ones. None without any such object.
    """
    sets = scored.draw_sets(grasps, SEQUENCES, np.random.default_rng([seed, 7]))
    if not len(sets):
        return None
    owner, objects = scored.touch_owner[sets[:, 0]], np.unique(scored.photo_owner)
    ratios = np.stack(
        [IdentificationTrials.of(scored, sets[:, :count], seed).log_ratios(posterior) for count in range(1, grasps + 1)]
    )
    rows, true = np.arange(len(sets)), np.searchsorted(objects, owner)
    highest = np.maximum.accumulate(ratios, axis=0)
    is_impostor = np.arange(len(objects)) != true[:, None]
    similar = _nearest_objects(objects, scored.photo_owner, scored.photo_embeddings)[true]
    return VerificationSequences(
        owner,
        ratios[:, rows, true].T,
        highest[:, rows, true],
        highest[-1][is_impostor].reshape(len(sets), -1),
        highest[-1][rows, similar],
    )


def fit_verification(
    parts: Sequence[ScoredTouches], posterior: Posterior, seed: int = 0
) -> VerificationCalibration | None:
    """Return the calibration from validation objects, which are compared only within a part.

    None if fewer than `MIN_OBJECTS` objects have sequences (`verification_sequences`), or if their pairs do not support
    `CARD_FAR`.
    """
    found = [each for part in parts if (each := verification_sequences(part, posterior, seed)) is not None]
    sizes = tuple(len(np.unique(each.owner)) for each in found)
    if not supports_calibration(sizes):
        return None
    impostors = np.concatenate([each.impostor.ravel() for each in found])
    genuine = np.concatenate([each.genuine for each in found], axis=1)
    lowest = np.concatenate([each.ratios[:, :-1].min(1) for each in found])
    return VerificationCalibration(
        sizes,
        _quantiles(impostors, 1 - np.array(LEVELS)),
        _quantiles(np.concatenate([each.similar for each in found])),
        tuple(map(_quantiles, genuine)),
        _quantiles(lowest),
    )


def _quantiles(values: Floats, at: Sequence[float] | Floats = QUANTILES) -> tuple[float, ...]:
    return tuple(np.quantile(values, at).tolist())


def _nearest_objects(
    objects: NDArray[np.int64], owner: NDArray[np.int64], embeddings: NDArray[np.floating[Any]]
) -> NDArray[np.int64]:
    """Return for each object the place (O,) of the other object with the most similar mean embedding."""
    means = np.stack([embeddings[owner == name].mean(0) for name in objects])
    means /= np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-9)
    cosines = means @ means.T
    np.fill_diagonal(cosines, -np.inf)
    return np.asarray(cosines.argmax(1))
