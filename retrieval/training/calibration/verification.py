"""Fit of the bounds of verification to sequences of grasps of right and of other objects."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from retrieval.model import verification
from retrieval.model.posterior import Posterior
from retrieval.model.verification import LEVELS, QUANTILES, VerificationCalibration, supports_calibration
from retrieval.training.calibration.posterior import IdentificationTrials
from retrieval.training.calibration.scores import ScoredTouches

Floats = NDArray[np.float64]
SEQUENCES = 8
"""Sequences of grasps of each validation object, for verification."""


class VerificationSequences(NamedTuple):
    """Log likelihood ratios of sequences of G grasps.

    Attributes:
        owner: (S,) object of each sequence.
        ratios: (S, G) ratios of the right object after 1, 2, ... grasps.
        impostor: (S, O - 1) largest ratio of each other object.
        similar: (S,) largest ratio of the most similar other object.
    """

    owner: NDArray[np.int64]
    ratios: Floats
    impostor: Floats
    similar: Floats


def verification_sequences(
    scored: ScoredTouches, posterior: Posterior, seed: int = 0, grasps: int = verification.MAX_GRASPS
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
    highest = ratios.max(0)
    is_impostor = np.arange(len(objects)) != true[:, None]
    means = np.stack([scored.photo_embeddings[scored.photo_owner == name].mean(0) for name in objects])
    means /= np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-9)
    cosines = means @ means.T
    np.fill_diagonal(cosines, -np.inf)
    similar = cosines.argmax(1)[true]
    return VerificationSequences(
        owner,
        ratios[:, rows, true].T,
        highest[is_impostor].reshape(len(sets), -1),
        highest[rows, similar],
    )


def fit_verification(
    parts: Sequence[ScoredTouches],
    posterior: Posterior,
    seed: int = 0,
    refused: Sequence[NDArray[np.bool_]] | None = None,
) -> VerificationCalibration | None:
    """Return the calibration from validation objects, which are compared only within a part.

    `refused`: whether the gel check refuses each touch of each part. Refused touches raise the false rejects, and do
    not lower the false accepts.

    None if fewer than `MIN_OBJECTS` objects have sequences (`verification_sequences`), or if their pairs do not support
    `CARD_FAR`.
    """
    found = [each for part in parts if (each := verification_sequences(part, posterior, seed)) is not None]
    sizes = tuple(len(np.unique(each.owner)) for each in found)
    if not supports_calibration(sizes):
        return None
    impostors = np.concatenate([each.impostor.ravel() for each in found])
    genuine = found
    if refused is not None:
        checked = (part.without_evidence(touches) for part, touches in zip(parts, refused, strict=True))
        genuine = [each for part in checked if (each := verification_sequences(part, posterior, seed)) is not None]
    ratios = np.concatenate([each.ratios for each in genuine])
    return VerificationCalibration(
        sizes,
        _quantiles(impostors, 1 - np.array(LEVELS)),
        _quantiles(np.concatenate([each.similar for each in found])),
        tuple(map(_quantiles, np.maximum.accumulate(ratios, axis=1).T)),
        _quantiles(ratios[:, :-1].min(1)),
    )


def _quantiles(values: Floats, at: Sequence[float] | Floats = QUANTILES) -> tuple[float, ...]:
    return tuple(np.quantile(values, at).tolist())
