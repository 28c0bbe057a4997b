"""Single objects and decisions of a method on one split: accuracy by object, confusions, calibration, rejection."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from retrieval.evaluation.calibration import CALIBRATED_GRASPS, fit_posterior, reliability
from retrieval.evaluation.reject import RejectionMeasures, reject
from retrieval.evaluation.results import Confusion, Details, PairThreshold, Rejection
from retrieval.evaluation.scoring import MethodScores
from retrieval.evaluation.verification import ErrorsByImpostors, verification_errors, verification_rates
from retrieval.methods.late_fusion import LateFusion
from retrieval.methods.method import Method
from retrieval.metrics.intervals import summarise
from retrieval.metrics.registry import confusions, k_way
from retrieval.training.calibration.posterior import MIN_OBJECTS
from retrieval.training.features import Features

_CONFUSIONS = 12


@dataclass(frozen=True, eq=False)
class SeedDetails:
    """`Details` of one training seed; confusions are fractions by (object, mistaken for)."""

    pair_threshold: PairThreshold
    per_object: dict[str, dict[str, float]]
    confusions: list[tuple[str, str, float]]
    calibration: dict[str, Any]
    reliability: dict[str, Any]
    reject: RejectionMeasures | None
    verification: ErrorsByImpostors | None


def describe(method: Method, scores: MethodScores, features: Features) -> SeedDetails:
    """Return the details of one method and seed; only late fusion is verified.

    Args:
        method: The fitted method.
        scores: Its scores.
        features: Features of all grasps, as the method takes them.
    """
    seed, objects, test = scores.seed, scores.queries.objects, scores.touches("test", "test")
    validation = scores.sets("validation")
    posteriors = {1: scores.posterior} | {
        grasps: fit_posterior(validation[grasps], seed) for grasps in CALIBRATED_GRASPS[1:] if grasps in validation
    }
    fitted = {grasps: posterior for grasps, posterior in posteriors.items() if posterior}
    accuracies = {
        "test_candidates": k_way(test, 5, seed=seed),
        "all_candidates": k_way(scores.touches(None, None), 5, seed=seed),
    }
    return SeedDetails(
        pair_threshold=scores.pair_threshold,
        per_object={
            key: {objects[number]: float(mean[0]) for number, mean in zip(*measure.by_object(), strict=True)}
            for key, measure in accuracies.items()
            if measure
        },
        confusions=[
            (objects[true], objects[predicted], fraction) for true, predicted, fraction in confusions(test, seed=seed)
        ],
        calibration={"posteriors": {str(grasps): posterior.to_dict() for grasps, posterior in fitted.items()}},
        reliability=reliability(fitted, scores.sets("test") | {1: test}, seed=seed),
        reject=reject(fitted[1], test, seed=seed) if fitted and len(test.objects) >= MIN_OBJECTS else None,
        verification=verification_errors(scores, features, method.checkpoint) if type(method) is LateFusion else None,
    )


def combine(by_seed: Sequence[SeedDetails], seed: int) -> Details:
    """Return the details of all training seeds: means; threshold, calibration and curves are those of the first seed.

    Args:
        by_seed: The details of each seed.
        seed: Seed of the resamples.
    """
    first = by_seed[0]
    fractions: dict[tuple[str, str], float] = {}
    for true, predicted, fraction in (each for one in by_seed for each in one.confusions):
        fractions[true, predicted] = fractions.get((true, predicted), 0) + fraction / len(by_seed)
    largest = sorted(fractions.items(), key=lambda item: (-item[1], item[0]))[:_CONFUSIONS]
    rejections = [one.reject for one in by_seed if one.reject]
    verified = [one.verification for one in by_seed if one.verification]
    return Details(
        pair_threshold=first.pair_threshold,
        per_object={
            key: {name: float(np.mean([one.per_object[key][name] for one in by_seed])) for name in accuracies}
            for key, accuracies in first.per_object.items()
        },
        confusions=[Confusion(*pair, fraction) for pair, fraction in largest],
        calibration=first.calibration,
        reliability=first.reliability,
        reject=_rejection(rejections, seed) if rejections else None,
        verification=verification_rates(verified) if verified else None,
    )


def _rejection(by_seed: Sequence[RejectionMeasures], seed: int) -> Rejection:
    names = "auroc", "false_accepts_at_95", "balanced_accuracy"
    summaries = {name: summarise([getattr(one, name) for one in by_seed], seed=seed) for name in names}
    return Rejection(**summaries, roc=by_seed[0].roc, risk_coverage=by_seed[0].risk_coverage)
