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
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.evaluation.experiment import Experiment
from retrieval.evaluation.predictions import Predictions, scored_touches
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.posterior import Posterior
from retrieval.model.verification import ERRORS_NEEDED, error_rate, objects_needed
from retrieval.training.calibration.posterior import MIN_OBJECTS, fit_posterior
from retrieval.training.calibration.touches import ScoredTouches
from retrieval.training.calibration.verification import verification_sequences

GRASPS = (1, 2, 3, 5)
"""Numbers of grasps of the sequences."""
FARS = (0.1, 0.01, 0.001)
"""False-accept rates at which the false-reject rate is stated."""

Floats = NDArray[np.float64]


def score_verification(
    experiment: Experiment, predictions: Sequence[Predictions], seeds: Sequence[int], seed: int
) -> dict[str, Any] | None:
    """Return "verification" of results.json: error rates by kind of impostor, then by number of grasps.

    Args:
        experiment: The experiment with late fusion.
        predictions: Scores of late fusion for each training seed.
        seeds: The training seeds.
        seed: Seed of the sequences.

    Returns:
        The rates, averaged over training seeds. None for fewer than
        three test objects, or for a model without posterior and fewer than three validation objects.
    """
    touches = [
        _test_touches(experiment, scores, experiment.late_fusion_checkpoint(each), seed)
        for scores, each in zip(predictions, seeds, strict=True)
    ]
    found: dict[str, Any] = {"random": {}, "similar": {}}
    for grasps in GRASPS:
        by_seed = [verification_sequences(*one, seed, grasps) for one in touches if one is not None]
        if not by_seed or (objects := len(np.unique(by_seed[0].owner))) < MIN_OBJECTS:
            continue
        genuine = [one.genuine[-1] for one in by_seed]
        for kind, impostors, needed in (
            ("random", [one.impostor.ravel() for one in by_seed], objects_needed),
            ("similar", [one.similar for one in by_seed], lambda far: math.ceil(ERRORS_NEEDED / far)),
        ):
            pairs = list(zip(genuine, impostors, strict=True))
            eer = float(np.mean([equal_error_rate(*pair) for pair in pairs]))
            rates = {f"{far:g}": (far, float(np.mean([false_rejects(far, *pair) for pair in pairs]))) for far in FARS}
            found[kind][str(grasps)] = {
                "objects": objects,
                "sequences": len(genuine[0]),
                "eer": _rate(eer, objects, needed(eer) if eer else None),
                "frr": {name: _rate(frr, objects, needed(far)) for name, (far, frr) in rates.items()},
            }
    return found if found["random"] else None


def _rate(value: float, objects: int, needed: int | None) -> dict[str, float | None]:
    """Return a rate and its interval, None for too few objects; `needed` is None if there are no errors."""
    if needed is None or objects < needed:
        return {"value": None, "low": None, "high": None, "objects_needed": needed}
    return {**asdict(error_rate(value, objects)), "objects_needed": needed}


def _test_touches(
    experiment: Experiment, predictions: Predictions, checkpoint: Checkpoint, seed: int
) -> tuple[ScoredTouches, Posterior] | None:
    """Return the scored touches of test objects, and the posterior; None for too few objects.

    A head that was trained on features has no posterior; a posterior is fitted on validation objects, as in training.
    """
    queries, posterior = experiment.queries, checkpoint.posterior
    validation, test = (scored_touches(queries, predictions, part) for part in ("validation", "test"))
    if posterior is None and len(np.unique(validation.photo_owner)) >= MIN_OBJECTS:
        posterior = fit_posterior(validation, seed=seed)
    if posterior is None or len(np.unique(test.photo_owner)) < MIN_OBJECTS:
        return None
    photos = queries.photos[queries.of_part(queries.photo_owner, "test")]
    features = torch.from_numpy(experiment.features_for("late_fusion").photo[photos])
    with torch.inference_mode():
        embeddings = checkpoint.matcher.photo_encoding(features).embedding.numpy()
    return replace(test, photo_embeddings=embeddings), posterior


def false_rejects(far: float, genuine: Floats, impostors: Floats) -> float:
    """Return the false-reject rate at the lowest threshold that accepts at most a fraction `far` of the impostors.

    Args:
        far: False-accept rate, less than 1.
        genuine: (S,) scores of the right object.
        impostors: (T,) scores of other objects.
    """
    accepted = math.floor(far * len(impostors) + 1e-9)  # 0.29 * 100 is less than 29
    return float((genuine <= np.sort(impostors)[-1 - accepted]).mean())


def equal_error_rate(genuine: Floats, impostors: Floats) -> float:
    """Return the rate at which false-accept and false-reject rate are equal (EER), interpolated between thresholds."""
    thresholds = np.unique(np.concatenate([genuine, impostors]))
    frr, far = (np.searchsorted(np.sort(scores), thresholds) / len(scores) for scores in (genuine, impostors))
    frr, far = np.append(frr, 1.0), np.append(1 - far, 0.0)
    return float(np.interp(0.0, frr - far, far))
