"""Probabilities of pairs, of sums of grasps and of K-way choices: fitted on validation objects, judged on test objects.

Ranking needs none of this. Even odds: `log_odds = slope * score + intercept`, fitted for each number of grasps on
its own, for grasps of one object are alike and the sum of their logits is over-confident. Among K candidates of which
one is true, the prior 1/K moves the log-odds of each by -log(K - 1), and knowing that exactly one is true makes them
a softmax; its one parameter, the temperature, is fitted as well.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import expit, log_softmax, softmax

from retrieval.calibration import SLOPE_BOUNDS, Calibration, fit_calibration
from retrieval.errors import BadInput, NumericalError
from retrieval.evaluation.protocols import asked
from retrieval.evaluation.table import ScoreTable, object_scores

BINS = 15
_PAIRS_OF_A_ROW = 8  # of each kind
_TESTS_OF_A_ROW = 4


class Choice(NamedTuple):
    """A K-way test: the true object among k candidates, after so many grasps, each shown by so many photos."""

    k: int
    grasps: int = 1
    photos: int = 1

    @property
    def name(self) -> str:
        """As in results.json: "k5", "k5_g5"."""
        return f"k{self.k}" + (f"_g{self.grasps}" if self.grasps > 1 else "")


@dataclass(frozen=True)
class Calibrations:
    """What validation objects say of a method's scores.

    pairs: calibration of a touch with a photo, by the number of grasps whose scores are summed; slopes: what scores
    are multiplied by before the softmax of a choice, 1 / temperature.
    """

    pairs: dict[int, Calibration]
    slopes: dict[Choice, float]

    def to_dict(self) -> dict[str, Any]:
        """JSON types: {"pairs": {"1": {...}}, "choices": {"k5": {"grasps", "photos", "temperature"}}}."""
        pairs = {str(grasps): fitted.to_dict() for grasps, fitted in self.pairs.items()}
        choices = {
            choice.name: {"grasps": choice.grasps, "photos": choice.photos, "temperature": 1 / slope}
            for choice, slope in self.slopes.items()
        }
        return {"pairs": pairs, "choices": choices}


def calibrate(validation: Mapping[int, ScoreTable], choices: Sequence[Choice], *, seed: int = 0) -> Calibrations:
    """Fit on validation objects; `validation` holds a table for each number of grasps.

    A choice among more candidates than there are validation objects is fitted on as many as there are: the slope of
    a softmax does not hang on their number. A choice whose number of grasps has no table is left out.
    """
    pairs = {grasps: fit_calibration(*drawn_pairs(table, seed)) for grasps, table in validation.items()}
    slopes = {
        choice: fit_slope(drawn_choices(validation[choice.grasps], choice, seed))
        for choice in choices
        if choice.grasps in validation
    }
    return Calibrations(pairs, slopes)


def drawn_pairs(table: ScoreTable, seed: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Scores and labels (P,): up to 8 photos of each row's object (never its own), as many of other objects.

    The object of a false pair is drawn uniformly, then its photo, so that both kinds are even in every row.
    """
    kept = asked(table)
    rng = np.random.default_rng([seed, 1])
    keys = np.where(kept.relevant & ~kept.own, rng.random(kept.own.shape), np.inf)
    true = np.argsort(keys, axis=1)[:, :_PAIRS_OF_A_ROW]
    shown = np.isfinite(np.take_along_axis(keys, true, 1))
    false = _other_photos(kept, true.shape[1], rng)
    scores = [np.take_along_axis(kept.scores, columns, 1)[shown] for columns in (true, false)]
    labels = np.repeat([1, 0], shown.sum())
    return np.concatenate(scores).astype(np.float64), labels


def _other_photos(table: ScoreTable, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """(T, count) columns of other objects, drawn with replacement."""
    objects, counts = np.unique(table.photo_owner, return_counts=True)
    if len(objects) < 2:
        raise BadInput(f"pairs need {table.column_words} of two objects at least; got {len(objects)}")
    order, start = np.argsort(table.photo_owner, kind="stable"), np.cumsum(counts) - counts
    other = rng.integers(len(objects) - 1, size=(len(table.touch_owner), count))
    other += other >= np.searchsorted(objects, table.touch_owner)[:, None]
    return np.asarray(order[start[other] + (rng.random(other.shape) * counts[other]).astype(np.int64)])


def drawn_choices(table: ScoreTable, choice: Choice, seed: int) -> NDArray[np.float64]:
    """Scores (Q, k) of candidates, the true one first; rivals drawn uniformly, 4 tests a row.

    Raises BadInput for fewer than two objects; with fewer than k there are as many candidates as objects.
    """
    kept = asked(table)
    scores = object_scores(kept, choice.photos, _TESTS_OF_A_ROW, seed)
    count = min(choice.k, len(kept.objects))
    if count < 2:
        raise BadInput(f"a choice needs two objects at least; got {len(kept.objects)}")
    # The true object gets the smallest key, so it always comes first.
    true = kept.touch_owner[:, None] == kept.objects
    keys = np.random.default_rng([seed, 2]).random(scores.shape) - true
    return np.take_along_axis(scores, np.argsort(keys, axis=2)[..., :count], 2).reshape(-1, count)


def fit_slope(scores: ArrayLike) -> float:
    """Factor of the scores (Q, k), the true one first, for which the softmax is likeliest: 1 / temperature.

    Targets are smoothed as Platt's are, a test more for every candidate: (Q + 1) / (Q + k) for the true one, so that
    scores that never err still have a finite optimum. The loss is convex in the factor: the root of its derivative,
    within `SLOPE_BOUNDS`. Raises NumericalError for a score that is not finite.
    """
    z = np.asarray(scores, dtype=np.float64)
    if not np.isfinite(z).all():
        row = int(np.flatnonzero(~np.isfinite(z).all(axis=1))[0])
        raise NumericalError(f"every score of a choice must be finite; choice {row} holds a NaN or infinite one")
    z = z - z[:, :1]
    tests, k = z.shape
    targets = np.append((tests + 1) / (tests + k), np.full(k - 1, 1 / (tests + k)))

    def derivative(log_slope: float) -> float:
        return float((z * (softmax(np.exp(log_slope) * z, axis=1) - targets)).sum())

    low, high = np.log(SLOPE_BOUNDS)
    if derivative(low) >= 0:
        return SLOPE_BOUNDS[0]
    return SLOPE_BOUNDS[1] if derivative(high) <= 0 else float(np.exp(brentq(derivative, low, high)))


def log_odds_among(log_odds: ArrayLike, k: int) -> NDArray[np.float64]:
    """Log-odds that a candidate is the true one of k, from its log-odds at even odds: less log(k - 1)."""
    return np.asarray(np.asarray(log_odds, dtype=np.float64) - np.log(k - 1))


def reliability(calibrations: Calibrations, test: Mapping[int, ScoreTable], *, seed: int = 0) -> dict[str, Any]:
    """How often what was said came true, on test objects: {"pairs": ..., "k5": ..., "calibration": {...}}.

    "pairs" (even odds, one grasp): probability and truth of pairs. A choice: probability of the first guess and
    whether it was right (equals share it); there "ece_of_pairs" is the error of the pairs' calibration moved by the
    prior, which does not know that exactly one candidate is true. A choice among more candidates than there are test
    objects is left out.
    """
    scores, labels = drawn_pairs(test[1], seed)
    found = {"pairs": reliability_bins(calibrations.pairs[1].probability(scores), labels)}
    for choice, slope in calibrations.slopes.items():
        if choice.grasps in test and len(test[choice.grasps].objects) >= choice.k:
            pairs = calibrations.pairs[choice.grasps]
            found[choice.name] = _choice_reliability(drawn_choices(test[choice.grasps], choice, seed), slope, pairs)
    return {**found, "calibration": calibrations.to_dict()}


def _choice_reliability(scores: NDArray[np.float64], slope: float, pairs: Calibration) -> dict[str, Any]:
    best = scores.max(1)
    tied = scores == best[:, None]
    right = tied[:, 0] / tied.sum(1)
    said = np.exp(log_softmax(slope * (scores - best[:, None]), axis=1).max(1))
    alone = expit(log_odds_among(pairs.log_odds(best), scores.shape[1]))
    return {**reliability_bins(said, right), "ece_of_pairs": reliability_bins(alone, right)["ece"]}


def reliability_bins(probability: ArrayLike, came_true: ArrayLike) -> dict[str, Any]:
    """{"ece", "bins": [{"probability", "share", "count"}]}: means over 15 equal bins, empty ones left out.

    probability, came_true (P,): 1 or 0, or a share where equals were settled by a draw. Expected calibration error:
    the mean over all of |probability - share| of its bin.
    """
    p, y = np.asarray(probability, dtype=np.float64), np.asarray(came_true, dtype=np.float64)
    if p.shape != y.shape or p.ndim != 1 or not len(p) or not ((p >= 0) & (p <= 1)).all():
        raise BadInput(f"probabilities between 0 and 1 and as many outcomes are needed; got {p.shape} and {y.shape}")
    which = np.minimum((p * BINS).astype(int), BINS - 1)
    used, place, counts = np.unique(which, return_inverse=True, return_counts=True)
    said, share = (np.bincount(place, weights=values) / counts for values in (p, y))
    bins = [
        {"probability": float(said[row]), "share": float(share[row]), "count": int(counts[row])}
        for row in range(len(used))
    ]
    return {"ece": float((np.abs(said - share) * counts).sum() / len(p)), "bins": bins}
