"""From match logits to probabilities, and how well pairs are told apart, on objects held out for the purpose.

Ranking uses logits and never what stands here; probabilities are for people to read.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retrieval.errors import BadInput, NumericalError
from retrieval.metrics.measure import weight_below

SLOPE_BOUNDS = (0.01, 100.0)
BINS = 15
_LARGEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class Calibration:
    """`log_odds = slope * logit + intercept`, fitted on validation pairs at even odds.

    reject_log_odds: below it the pair is better called "no match" (largest balanced accuracy on those pairs).
    positives, negatives: how many pairs it was fitted on. nll_*, ece_*: mean negative log-likelihood in nats and
    expected calibration error (15 equal bins) on the same pairs, before and after.
    """

    slope: float
    intercept: float
    reject_log_odds: float
    positives: int
    negatives: int
    nll_before: float
    nll_after: float
    ece_before: float
    ece_after: float

    def log_odds(self, logit: ArrayLike) -> NDArray[np.float64]:
        """Calibrated log-odds of match logits. Raises NumericalError for one that is not finite: it is above no
        threshold, and would count as "no match".
        """
        z = np.asarray(logit, dtype=np.float64)
        if not np.isfinite(z).all():
            raise NumericalError(f"every logit must be finite to be calibrated; got {z[~np.isfinite(z)][0]}")
        return self.slope * z + self.intercept

    def probability(self, logit: ArrayLike) -> NDArray[np.float64]:
        """Probability of a match at even odds, for people; never rank by it."""
        return _expit(self.log_odds(logit))

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary, as in `results.json`."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class Threshold:
    """A fixed rule: scores above `at` are matches."""

    at: float

    def log_odds(self, score: ArrayLike) -> NDArray[np.float64]:
        """How far scores lie above the threshold."""
        return np.asarray(score, dtype=np.float64) - self.at


def fit_calibration(logits: ArrayLike, labels: ArrayLike) -> Calibration:
    """Fit slope and intercept by maximum likelihood with Platt's smoothed targets (Platt 1999, section 2.2).

    logits (P,), labels (P,) of 0 and 1. Smoothing gives separable data a finite optimum, and the slope is kept within
    `SLOPE_BOUNDS`: at the lower one where logits say nothing, or the opposite. Raises BadInput unless both classes
    are there, NumericalError for a logit that is not a finite float32.
    """
    z, y = _checked(logits, labels)
    slope, intercept = _likeliest(z, y)
    x = slope * z + intercept
    return Calibration(
        slope=slope,
        intercept=intercept,
        reject_log_odds=_best_threshold(x, y),
        positives=int(y.sum()),
        negatives=int((1 - y).sum()),
        nll_before=_nll(z, y),
        nll_after=_nll(x, y),
        ece_before=reliability_bins(_expit(z), y)["ece"],
        ece_after=reliability_bins(_expit(x), y)["ece"],
    )


def _likeliest(z: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Slope within its bounds, and intercept, of the smallest loss; two root searches, one inside the other.

    The loss is convex in both, so its derivative by the intercept grows with the intercept, and at the best intercept
    its derivative by the slope grows with the slope. Bracketed roots are found at any scale and offset of the logits;
    a quasi-Newton search of both at once stops early at logits of 1000 +- 1.
    """
    from scipy.optimize import brentq  # slow to import, and no query needs it

    positives, negatives = y.sum(), (1 - y).sum()
    targets = np.where(y == 1, (positives + 1) / (positives + 2), 1 / (negatives + 2))
    # Both classes weigh the same, whatever their counts: the odds are even by definition.
    weights = np.where(y == 1, 0.5 / positives, 0.5 / negatives)
    centre = float(np.median(z))
    z = z - centre

    def slack(slope: float, intercept: float) -> NDArray[np.float64]:
        return np.asarray(weights * (_expit(slope * z + intercept) - targets))

    def best_intercept(slope: float) -> float:
        reach = slope * float(np.abs(z).max()) + 50  # there every probability is 0 (or 1) and the targets are not
        return float(brentq(lambda intercept: slack(slope, intercept).sum(), -reach, reach, maxiter=1000))

    def derivative(log_slope: float) -> float:
        slope = float(np.exp(log_slope))
        return float(np.sum(slack(slope, best_intercept(slope)) * z))

    low, high = np.log(SLOPE_BOUNDS)
    if derivative(low) >= 0:
        slope = SLOPE_BOUNDS[0]
    else:
        slope = SLOPE_BOUNDS[1] if derivative(high) <= 0 else float(np.exp(brentq(derivative, low, high)))
    return slope, best_intercept(slope) - slope * centre


def pair_accuracy(logits: ArrayLike, labels: ArrayLike) -> float:
    """Share of pairs on the right side of logit 0; a logit of exactly 0 is half right, as a coin would be."""
    z, y = _checked(logits, labels)
    right = np.where(z == 0, 0.5, (z > 0) == (y == 1))
    return float(right.mean())


def pair_auc(logits: ArrayLike, labels: ArrayLike) -> float:
    """Chance that a random true pair has a higher logit than a random false one; equals count half.

    It needs no threshold; a constant scorer has exactly 0.5.
    """
    z, y = _checked(logits, labels)
    true, false = z[y == 1], z[y == 0]
    return float(weight_below(true, false).sum() / (len(true) * len(false)))


def reliability_bins(probability: ArrayLike, outcomes: ArrayLike) -> dict[str, Any]:
    """{"ece", "bins": [{"probability", "share", "count"}]}: means over 15 equal bins, empty ones left out.

    probability, came_true (P,): 1 or 0, or a share where equals were settled by a draw. Expected calibration error:
    the mean over all of |probability - share| of its bin.
    """
    p, y = np.asarray(probability, dtype=np.float64), np.asarray(outcomes, dtype=np.float64)
    if p.shape != y.shape or p.ndim != 1 or not len(p) or not ((p >= 0) & (p <= 1)).all():
        raise BadInput(f"probabilities between 0 and 1 and as many outcomes are needed; got {p.shape} and {y.shape}")
    which = np.minimum((p * BINS).astype(int), BINS - 1)
    used, place, counts = np.unique(which, return_inverse=True, return_counts=True)
    mean_probability, share = (np.bincount(place, weights=values) / counts for values in (p, y))
    bins = [
        {"probability": float(mean_probability[row]), "frequency": float(share[row]), "count": int(counts[row])}
        for row in range(len(used))
    ]
    return {"ece": float((np.abs(mean_probability - share) * counts).sum() / len(p)), "bins": bins}


def _checked(logits: ArrayLike, labels: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    z, y = np.asarray(logits, dtype=np.float64), np.asarray(labels, dtype=np.float64)
    if z.shape != y.shape or z.ndim != 1:
        raise BadInput(f"logits and labels must be vectors of one length; got {z.shape} and {y.shape}")
    bad = np.flatnonzero(~(np.abs(z) <= _LARGEST))
    if len(bad):
        raise NumericalError(f"every logit must be a finite float32; pair {bad[0]} has {z[bad[0]]}")
    true, false = int(np.sum(y == 1)), int(np.sum(y == 0))
    if not (true and false and true + false == len(y)):
        raise BadInput(f"pairs of both classes are needed, labelled 0 and 1; of {len(y)}, {true} are 1 and {false} 0")
    return z, y


def _best_threshold(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """The smallest value to accept for the largest balanced accuracy: midway down to the next one, if there is one."""
    values, place = np.unique(x, return_inverse=True)
    true_below = np.cumsum(np.bincount(place, weights=y)) / y.sum()
    false_below = np.cumsum(np.bincount(place, weights=1 - y)) / (1 - y).sum()
    # Accepting from values[i] on gains what lies below it; from values[0] on is to accept everything, which gains 0.
    best = int(np.argmax(np.append(0.0, (false_below - true_below)[:-1])))
    middle = (values[best] + values[max(best - 1, 0)]) / 2
    return float(middle if best == 0 or middle > values[best - 1] else values[best])


def _nll(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    return float(-np.mean(-np.logaddexp(0, np.where(y == 1, -x, x))))


def _expit(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 / (1 + exp(-x)) without overflow; scipy.special has it too, at a fifth of a second a query for its import."""
    small = np.exp(-np.abs(x))
    return np.asarray(np.where(x >= 0, 1, small) / (1 + small))
