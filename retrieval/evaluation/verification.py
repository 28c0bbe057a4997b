"""Verification on test objects: false-reject rate (FRR) against false-accept rate (FAR) of late fusion.

The score of a sequence of grasps is its largest log likelihood ratio so far, by which `retrieve verify` accepts
(`retrieval.model.verification`). A rate is stated only if the trials would contain `ERRORS_NEEDED` false accepts. For
random impostors a trial is a pair of objects, for the most similar ones it is an object. Intervals count each object as
one trial, because its sequences are correlated. In simulations with 30 and 80 objects they contained the true FRR in 96
to 100 % of cases; a bootstrap over objects did so in 76 to 97 %, least for small rates.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.evaluation.queries import MethodScores, scored_touches
from retrieval.evaluation.results import Rate, VerificationRates
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.verification import ERRORS_NEEDED, error_rate, objects_needed
from retrieval.training.calibration.posterior import fit_posterior
from retrieval.training.calibration.scores import MIN_OBJECTS
from retrieval.training.calibration.verification import verification_sequences
from retrieval.training.features import Features

GRASPS = (1, 2, 3, 5)
"""Numbers of grasps of the sequences."""
FARS = (0.1, 0.01, 0.001)
"""False-accept rates at which the false-reject rate is stated."""

Floats = NDArray[np.float64]


def verification_rates(
    scores: MethodScores, features: Features, checkpoint: Checkpoint
) -> dict[str, dict[str, VerificationRates]] | None:
    """Return the rates of late fusion on test objects, from its scores and the tower features of all grasps.

    A head that was trained on features has no posterior; one is fitted on validation objects, as in training.

    Returns:
        Kind of impostors ("random", "similar") -> number of grasps -> rates. None for fewer than three test objects, or
        for a model without posterior and fewer than three validation objects.
    """
    queries, posterior, test = scores.queries, checkpoint.posterior, scored_touches(scores.touches("test"))
    if posterior is None:
        validation = scored_touches(scores.touches("validation"))
        if validation.has_trials:
            posterior = fit_posterior(validation, seed=scores.seed)
    if posterior is None or not test.has_trials:
        return None
    photos = torch.from_numpy(features.photo[queries.photos[queries.of_part(queries.photo_owner, "test")]])
    with torch.inference_mode():
        embeddings = checkpoint.matcher.photo_encoding(photos).embedding.numpy()
    test = replace(test, photo_embeddings=embeddings)
    found: dict[str, dict[str, VerificationRates]] = {"random": {}, "similar": {}}
    for grasps in GRASPS:
        sequences = verification_sequences(test, posterior, scores.seed, grasps)
        if sequences is not None and (objects := len(np.unique(sequences.owner))) >= MIN_OBJECTS:
            genuine, random = sequences.ratios.max(1), sequences.impostor.ravel()
            found["random"][str(grasps)] = _rates(objects, genuine, random, objects_needed)
            found["similar"][str(grasps)] = _rates(objects, genuine, sequences.similar, _similar_needed)
    return found if found["random"] else None


def _similar_needed(far: float) -> int:
    """Return how many objects support a false-accept rate of the most similar objects: an object is one trial."""
    return math.ceil(ERRORS_NEEDED / far)


def _rates(objects: int, genuine: Floats, impostors: Floats, needed: Callable[[float], int]) -> VerificationRates:
    def rate(value: float, far: float) -> Rate:
        if objects < needed(far):
            return Rate(None, None, None, needed(far))
        return Rate(**asdict(error_rate(value, objects)), objects_needed=needed(far))

    eer = equal_error_rate(genuine, impostors)
    return VerificationRates(
        objects,
        len(genuine),
        rate(eer, eer) if eer else Rate(None, None, None, None),
        {f"{far:g}": rate(false_rejects(far, genuine, impostors), far) for far in FARS},
    )


def false_rejects(far: float, genuine: Floats, impostors: Floats) -> float:
    """Return the false-reject rate at the lowest threshold that accepts at most a fraction `far` < 1 of the impostors.

    `genuine` (S,) are scores of the right object, `impostors` (T,) of other objects.
    """
    accepted = math.floor(far * len(impostors) + 1e-9)  # 0.29 * 100 is less than 29
    return float((genuine <= np.sort(impostors)[-1 - accepted]).mean())


def equal_error_rate(genuine: Floats, impostors: Floats) -> float:
    """Return the rate at which false-accept and false-reject rate are equal (EER), interpolated between thresholds."""
    thresholds = np.unique(np.concatenate([genuine, impostors]))
    frr, far = (np.searchsorted(np.sort(scores), thresholds) / len(scores) for scores in (genuine, impostors))
    frr, far = np.append(frr, 1.0), np.append(1 - far, 0.0)
    return float(np.interp(0.0, frr - far, far))
