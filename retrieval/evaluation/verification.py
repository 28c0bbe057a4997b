"""Verification on test objects: false-reject rate (FRR) against false-accept rate (FAR) of late fusion.

The score of a sequence of grasps is its largest log likelihood ratio so far, by which `retrieve verify` accepts
(`retrieval.model.verification`). A rate is stated only if the trials would contain `ERRORS_NEEDED` false accepts. For
random impostors a trial is a pair of objects, for the most similar ones it is an object. Intervals count each object as
one trial, because its sequences are correlated. In simulations with 30 and 80 objects they contained the true FRR in 96
to 100 % of cases; a bootstrap over objects did so in 76 to 97 %, least for small rates.
"""

import math
from collections.abc import Sequence
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


Errors = tuple[int, int, tuple[float, ...]]
"""Numbers of objects and of sequences, equal error rate, then false-reject rates at `FARS`, of one training seed."""
ErrorsByImpostors = dict[str, dict[str, Errors]]
"""Kind of impostors ("random", "similar") -> number of grasps -> errors."""


def verification_errors(scores: MethodScores, features: Features, checkpoint: Checkpoint) -> ErrorsByImpostors | None:
    """Return the errors of late fusion on test objects, from its scores and the tower features of all grasps.

    A head that was trained on features has no posterior; one is fitted on validation objects, as in training. None for
    fewer than three test objects, or for a model without posterior and fewer than three validation objects.
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
    found: ErrorsByImpostors = {"random": {}, "similar": {}}
    for grasps in GRASPS:
        sequences = verification_sequences(test, posterior, scores.seed, grasps)
        if sequences is not None and (objects := len(np.unique(sequences.owner))) >= MIN_OBJECTS:
            genuine = sequences.ratios.max(1)
            for kind, impostors in (("random", sequences.impostor.ravel()), ("similar", sequences.similar)):
                frr = [false_rejects(far, genuine, impostors) for far in FARS]
                found[kind][str(grasps)] = objects, len(genuine), (equal_error_rate(genuine, impostors), *frr)
    return found if found["random"] else None


def verification_rates(by_seed: Sequence[ErrorsByImpostors]) -> dict[str, dict[str, VerificationRates]]:
    """Return the rates with intervals, averaged over the training seeds."""
    return {
        kind: {grasps: _rates(kind, [one[kind][grasps] for one in by_seed]) for grasps in by_grasps}
        for kind, by_grasps in by_seed[0].items()
    }


def _rates(kind: str, by_seed: Sequence[Errors]) -> VerificationRates:
    objects, sequences, _ = by_seed[0]
    eer, *frr = np.mean([rates for _, _, rates in by_seed], axis=0).tolist()

    def rate(value: float, far: float) -> Rate:
        needed = objects_needed(far) if kind == "random" else math.ceil(ERRORS_NEEDED / far)
        if objects < needed:
            return Rate(None, None, None, needed)
        return Rate(**asdict(error_rate(value, objects)), objects_needed=needed)

    return VerificationRates(
        objects,
        sequences,
        rate(eer, eer) if eer else Rate(None, None, None, None),
        {f"{far:g}": rate(value, far) for far, value in zip(FARS, frr, strict=True)},
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
