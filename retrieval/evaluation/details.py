"""Single objects and decisions of a method on one split: accuracy by object, confusions, calibration, rejection."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from retrieval.evaluation.calibrate import KWayTest, calibrate, has_enough_objects, reliability
from retrieval.evaluation.reject import RejectionMeasures, reject
from retrieval.evaluation.results import Confusion, Details, PairThreshold, Rejection
from retrieval.evaluation.scoring import MethodScores
from retrieval.evaluation.verification import ErrorsByImpostors, verification_errors, verification_rates
from retrieval.metrics import protocols
from retrieval.metrics.intervals import Summary, summarise
from retrieval.metrics.registry import PHOTOS_PER_CANDIDATE, k_way_measure
from retrieval.model.checkpoint import Checkpoint
from retrieval.training.features import Features

CHOICES = (KWayTest(5), KWayTest(10), KWayTest(5, 5, PHOTOS_PER_CANDIDATE))
_CONFUSIONS = 12


@dataclass(frozen=True, eq=False)
class SeedDetails:
    """Details of one training seed, as in `Details`."""

    pair_threshold: PairThreshold
    per_object: dict[str, dict[str, float]]
    confusions: list[Confusion]
    calibration: dict[str, Any]
    reliability: dict[str, Any]
    reject: RejectionMeasures | None
    verification: ErrorsByImpostors | None


def describe(scores: MethodScores, features: Features, late_fusion: Checkpoint | None) -> SeedDetails:
    """Return the details of one method and seed.

    Args:
        scores: The scores of the method.
        features: Features of all grasps, as the method takes them.
        late_fusion: The model, if the method is late fusion, which alone is verified.
    """
    seed, objects, test = scores.seed, scores.queries.objects, scores.touches("test", "test")
    calibrations = calibrate(scores.by_grasps("validation"), seed=seed)
    accuracies = {"test_candidates": k_way_measure(test, 5, seed)}
    accuracies["all_candidates"] = k_way_measure(scores.touches(None, None), 5, seed)
    return SeedDetails(
        pair_threshold=scores.pair_threshold,
        per_object={
            name: {objects[number]: value for number, value in protocols.per_object(measure).items()}
            for name, measure in accuracies.items()
            if measure
        },
        confusions=[
            Confusion(objects[true], objects[predicted], fraction)
            for true, predicted, fraction in protocols.confusions(test, seed=seed)
        ],
        calibration=calibrations.to_dict(),
        reliability=reliability(calibrations, scores.by_grasps("test"), CHOICES, seed=seed),
        # Not possible with fewer than three validation or test objects.
        reject=reject(calibrations.posteriors[1], test, seed=seed)
        if 1 in calibrations.posteriors and has_enough_objects(test)
        else None,
        verification=verification_errors(scores, features, late_fusion) if late_fusion else None,
    )


def combine(by_seed: Sequence[SeedDetails], seed: int) -> Details:
    """Return the details of all training seeds: means; threshold, calibration and curves are those of the first seed.

    Args:
        by_seed: The details of each seed.
        seed: Seed of the resamples.
    """
    first = by_seed[0]
    verified = [one.verification for one in by_seed if one.verification]
    return Details(
        pair_threshold=first.pair_threshold,
        per_object={name: _means(one.per_object.get(name, {}) for one in by_seed) for name in _PER_OBJECT},
        confusions=_largest_confusions(by_seed),
        calibration=first.calibration,
        reliability=first.reliability,
        reject=_rejection([one.reject for one in by_seed if one.reject], seed),
        verification=verification_rates(verified) if verified else None,
    )


_PER_OBJECT = ("test_candidates", "all_candidates")


def _means(by_seed: Iterable[Mapping[str, float]]) -> dict[str, float]:
    found: dict[str, list[float]] = {}
    for accuracies in by_seed:
        for name, accuracy in accuracies.items():
            found.setdefault(name, []).append(accuracy)
    return {name: float(np.mean(values)) for name, values in found.items()}


def _largest_confusions(by_seed: Sequence[SeedDetails]) -> list[Confusion]:
    fractions: dict[tuple[str, str], float] = {}
    for one in by_seed:
        for found in one.confusions:
            pair = found.object_id, found.mistaken_for
            fractions[pair] = fractions.get(pair, 0) + found.share / len(by_seed)
    largest = sorted(fractions.items(), key=lambda item: (-item[1], item[0]))[:_CONFUSIONS]
    return [Confusion(*pair, fraction) for pair, fraction in largest]


def _rejection(by_seed: Sequence[RejectionMeasures], seed: int) -> Rejection | None:
    if not by_seed:
        return None

    def summary(name: str) -> Summary:
        return summarise([getattr(one, name) for one in by_seed], seed=seed)

    return Rejection(
        summary("auroc"),
        summary("false_accepts_at_95"),
        summary("balanced_accuracy"),
        by_seed[0].roc,
        by_seed[0].risk_coverage,
    )
