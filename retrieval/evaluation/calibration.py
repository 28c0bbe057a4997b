"""Calibrated probabilities of a method: fitted on validation objects, and their reliability on test objects.

Ranking does not need calibration. The posterior over objects and "none of these" is that of queries
(`retrieval.model.posterior`). It is fitted separately for each number of grasps, because each method combines the
scores of several grasps in its own way: a set is treated as one touch with the score of the set.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, softmax

from retrieval.errors import BadInput
from retrieval.metrics.pairs import reliability_bins
from retrieval.metrics.registry import PHOTOS_PER_CANDIDATE
from retrieval.metrics.table import ScoreTable, object_scores
from retrieval.model.posterior import Posterior
from retrieval.training.calibration.posterior import MIN_OBJECTS, IdentificationTrials, fit_posterior_to_trials
from retrieval.training.calibration.touches import ScoredTouches

K_WAY_TESTS = {"k5": (5, 1, 1), "k10": (10, 1, 1), "k5_g5": (5, 5, PHOTOS_PER_CANDIDATE)}
"""Tests of calibrated probabilities: candidates, grasps of a query, and photos of a candidate."""
CALIBRATED_GRASPS = (1, 5)
"""Numbers of grasps for which a posterior is fitted: those of `K_WAY_TESTS`."""
_PAIRS_OF_A_ROW = 8  # of each kind
_TESTS_OF_A_ROW = 4


def identification_trials(table: ScoreTable, seed: int = 0) -> IdentificationTrials:
    """Return an identification trial for every row that has a target photo; a row counts as one touch.

    Args:
        table: The scores.
        seed: Seed of the catalogues.

    Returns:
        The trials: objects in the order of `table.objects`, rows in the order of `table.with_targets`.

    Raises:
        BadInput: The table has fewer than three objects.
    """
    targets = table.with_targets
    scored = ScoredTouches(targets.scores, targets.touch_owner, targets.photo_owner, targets.own)
    return IdentificationTrials.of(scored, np.arange(len(targets.touch_owner))[:, None], seed)


def fit_posterior(validation: ScoreTable, seed: int = 0) -> Posterior | None:
    """Return the posterior of the rows of a table of validation objects; None for fewer than three objects."""
    if len(validation.objects) < MIN_OBJECTS:
        return None
    return fit_posterior_to_trials([identification_trials(validation, seed)])


def draw_pairs(table: ScoreTable, seed: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Draw up to 8 true photos of each row, and as many false ones.

    The photo of the row's own grasp is never drawn. For a false pair first the object is drawn uniformly, then its
    photo, with replacement.

    Args:
        table: The scores, of at least two objects.
        seed: Seed of the draw.

    Returns:
        Scores (P,) and labels (P,), 1 for a true pair.
    """
    targets = table.with_targets
    rng = np.random.default_rng([seed, 1])
    keys = np.where(targets.relevant & ~targets.own, rng.random(targets.own.shape), np.inf)
    true = np.argsort(keys, axis=1)[:, :_PAIRS_OF_A_ROW]
    is_drawn = np.isfinite(np.take_along_axis(keys, true, 1))
    objects, counts = np.unique(targets.photo_owner, return_counts=True)
    order, start = np.argsort(targets.photo_owner, kind="stable"), np.cumsum(counts) - counts
    other = rng.integers(len(objects) - 1, size=true.shape)
    other += other >= np.searchsorted(objects, targets.touch_owner)[:, None]
    false = order[start[other] + (rng.random(other.shape) * counts[other]).astype(np.int64)]
    scores = [np.take_along_axis(targets.scores, columns, 1)[is_drawn] for columns in (true, false)]
    return np.concatenate(scores).astype(np.float64), np.repeat([1, 0], is_drawn.sum())


def draw_k_way_tests(table: ScoreTable, k: int, photos: int, seed: int, posterior: Posterior) -> NDArray[np.float64]:
    """Draw K-way tests, 4 for each row; rivals are drawn uniformly.

    Args:
        table: The scores.
        k: Number of candidates.
        photos: Photos of each candidate.
        seed: Seed of the draw.
        posterior: Combines the scores of a candidate's photos into one logit.

    Returns:
        Logits (Q, k) of the candidates, the true one first.

    Raises:
        BadInput: The table has fewer than k objects.
    """
    targets = table.with_targets
    if len(targets.objects) < k:
        raise BadInput(f"A {k}-way test needs at least {k} objects, got {len(targets.objects)}.")
    scores = object_scores(targets, photos, _TESTS_OF_A_ROW, seed, posterior.object_logits)
    # The true object gets the smallest key, so it always comes first.
    true = targets.touch_owner[:, None] == targets.objects
    keys = np.random.default_rng([seed, 2]).random(scores.shape) - true
    return np.take_along_axis(scores, np.argsort(keys, axis=2)[..., :k], 2).reshape(-1, k)


def reliability(
    posteriors: Mapping[int, Posterior], test: Mapping[int, ScoreTable], *, seed: int = 0
) -> dict[str, Any]:
    """Return the reliability bins of calibrated probabilities on test objects.

    Args:
        posteriors: The fitted posteriors, by number of grasps.
        test: Scores of test objects, by number of grasps.
        seed: Seed of the drawn pairs and tests.

    Returns:
        {"pairs": bins, "k5": bins, "k5_g5": bins, ...}. "pairs": match probabilities of single touches at even prior
        odds. A K-way test: probability of the top-1 candidate when one candidate is true (prior of none: 0) against
        its accuracy; tied candidates split the credit. Tests without a posterior or enough test objects are left out.
    """
    found = {}
    if 1 in posteriors:
        scores, labels = draw_pairs(test[1], seed)
        found["pairs"] = reliability_bins(expit(posteriors[1].log_ratio(scores, 1)), labels)
    for name, (k, grasps, photos) in K_WAY_TESTS.items():
        if grasps in posteriors and grasps in test and len(test[grasps].objects) >= k:
            logits = draw_k_way_tests(test[grasps], k, photos, seed, posteriors[grasps])
            tied = logits == logits.max(1, keepdims=True)
            confidences = softmax(posteriors[grasps].slope * logits, axis=1).max(1)
            found[name] = reliability_bins(confidences, tied[:, 0] / tied.sum(1))
    return found
