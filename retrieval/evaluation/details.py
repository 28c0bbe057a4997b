"""Single objects and decisions of a method on one split: accuracy by object, confusions, calibration, rejection."""

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from retrieval.evaluation.queries import MethodScores
from retrieval.evaluation.reject import reject
from retrieval.evaluation.results import Confusion, Details, Rejection
from retrieval.evaluation.verification import verification_rates
from retrieval.methods.late_fusion import LateFusion
from retrieval.methods.method import Method
from retrieval.metrics.intervals import summarise
from retrieval.metrics.pairs import reliability_bins
from retrieval.metrics.registry import confusions, k_way
from retrieval.metrics.table import ScoreTable, object_scores
from retrieval.model.posterior import Posterior
from retrieval.training.calibration.scores import MIN_OBJECTS
from retrieval.training.features import Features

K_WAY_TESTS = {"k5": 5, "k10": 10}
"""Tests of calibrated probabilities: number of candidates, of one photo each."""
_CONFUSIONS = 12
_TESTS_OF_A_ROW = 4


def describe(method: Method, scores: MethodScores, features: Features) -> Details:
    """Return the details of a fitted method, from its scores and all features; only late fusion is verified."""
    seed, objects, test, posterior = scores.seed, scores.queries.objects, scores.touches("test"), scores.posterior
    accuracies = {"test_candidates": k_way(test, 5, seed=seed), "all_candidates": k_way(scores.touches(), 5, seed=seed)}
    rejection = None
    if posterior and len(test.objects) >= MIN_OBJECTS:
        found = reject(posterior, test, seed=seed)
        auroc, balanced = (summarise([one], seed=seed) for one in (found.auroc, found.balanced_accuracy))
        rejection = Rejection(auroc, balanced, found.roc)
    return Details(
        pair_threshold=scores.pair_threshold,
        per_object={
            key: {objects[number]: float(mean[0]) for number, mean in zip(*measure.by_object(), strict=True)}
            for key, measure in accuracies.items()
            if measure
        },
        confusions=[
            Confusion(objects[true], objects[other], fraction)
            for true, other, fraction in confusions(test, seed=seed)[:_CONFUSIONS]
        ],
        posterior=asdict(posterior) if posterior else None,
        reliability=reliability(posterior, test, seed=seed) if posterior else {},
        reject=rejection,
        verification=verification_rates(scores, features, method.checkpoint) if type(method) is LateFusion else None,
    )


def draw_k_way_tests(table: ScoreTable, k: int, seed: int) -> NDArray[np.float64]:
    """Return scores (Q, k) of K-way tests, the true candidate first: 4 tests for each row with uniformly drawn rivals.

    A candidate has one photo. There must be at least k objects.
    """
    targets = table.with_targets
    scores = object_scores(targets, 1, _TESTS_OF_A_ROW, seed)
    # The true object gets the smallest key, so it always comes first.
    true = targets.touch_owner[:, None] == targets.objects
    keys = np.random.default_rng([seed, 2]).random(scores.shape) - true
    return np.take_along_axis(scores, np.argsort(keys, axis=2)[..., :k], 2).reshape(-1, k)


def reliability(posterior: Posterior, test: ScoreTable, *, seed: int = 0) -> dict[str, Any]:
    """Return the reliability bins of calibrated probabilities on test objects; `seed` draws the tests.

    Returns:
        By name of `K_WAY_TESTS`: probability of the top-1 candidate when one candidate is true (prior of none: 0)
        against its accuracy, where tied candidates split the credit. Tests without enough test objects are left out.
    """
    found = {}
    for name, k in K_WAY_TESTS.items():
        if len(test.objects) >= k:
            logits = draw_k_way_tests(test, k, seed)
            tied = logits == logits.max(1, keepdims=True)
            confidences = softmax(posterior.slope * logits, axis=1).max(1)
            found[name] = reliability_bins(confidences, tied[:, 0] / tied.sum(1))
    return found
