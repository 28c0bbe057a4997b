"""From match logits to probabilities, and how well pairs are told apart, on objects held out for the purpose.

Ranking uses logits and never what stands here; probabilities are for people to read.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.special import expit, log_expit
from scipy.stats import rankdata

from retrieval.errors import BadInput, NumericalError

SLOPE_BOUNDS = (0.01, 100.0)


@dataclass(frozen=True)
class Calibration:
    """`log_odds = slope * logit + intercept` for one grasp, fitted on validation pairs at even odds.

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

    def log_odds(self, logit: ArrayLike, grasps: int = 1) -> NDArray[np.float64]:
        """Calibrated log-odds of a sum of `grasps` match logits (the grasps taken as independent)."""
        return self.slope * np.asarray(logit, dtype=np.float64) + grasps * self.intercept

    def probability(self, logit: ArrayLike, grasps: int = 1) -> NDArray[np.float64]:
        """Probability of a match at even odds, for people; never rank by it."""
        return np.asarray(expit(self.log_odds(logit, grasps)))

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary, as stored in checkpoints and in `calibration.json`."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "Calibration":
        """Inverse of `to_dict`. Raises BadInput for anything else."""
        try:
            return cls(**data)
        except TypeError as error:
            raise BadInput(f"calibration must hold {[f.name for f in dataclasses.fields(cls)]}; {error}") from error


def fit_calibration(logits: ArrayLike, labels: ArrayLike) -> Calibration:
    """Fit slope and intercept by maximum likelihood with Platt's smoothed targets (Platt 1999, section 2.2).

    logits (P,), labels (P,) of 0 and 1. Smoothing gives separable data a finite optimum, and the slope is kept within
    `SLOPE_BOUNDS`. Raises BadInput unless both classes are there, NumericalError for a logit that is not finite.
    """
    z, y = _checked(logits, labels)
    positives, negatives = int(y.sum()), int((1 - y).sum())
    targets = np.where(y == 1, (positives + 1) / (positives + 2), 1 / (negatives + 2))
    # Both classes weigh the same, whatever their counts: the odds are even by definition.
    weights = np.where(y == 1, 0.5 / positives, 0.5 / negatives)

    def loss(parameters: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        slope = np.exp(parameters[0])
        x = slope * z + parameters[1]
        value = -np.sum(weights * (targets * log_expit(x) + (1 - targets) * log_expit(-x)))
        slack = weights * (expit(x) - targets)
        return float(value), np.array([np.sum(slack * slope * z), np.sum(slack)])

    spread = float(np.std(z)) or 1.0
    first = np.log(np.clip(1 / spread, *SLOPE_BOUNDS))
    limit = 1e3 + 100 * float(np.abs(z).max())
    bounds = [tuple(np.log(SLOPE_BOUNDS)), (-limit, limit)]
    found = minimize(loss, np.array([first, -np.exp(first) * np.median(z)]), jac=True, bounds=bounds, method="L-BFGS-B")
    slope, intercept = float(np.exp(found.x[0])), float(found.x[1])
    x = slope * z + intercept
    return Calibration(
        slope=slope,
        intercept=intercept,
        reject_log_odds=_best_threshold(x, y),
        positives=positives,
        negatives=negatives,
        nll_before=_nll(z, y),
        nll_after=_nll(x, y),
        ece_before=_ece(z, y),
        ece_after=_ece(x, y),
    )


def pair_accuracy(logits: ArrayLike, labels: ArrayLike) -> float:
    """Share of pairs on the right side of logit 0; a logit of exactly 0 is half right, as a coin would be."""
    z, y = _checked(logits, labels)
    right = np.where(z == 0, 0.5, (z > 0) == (y == 1))
    return float(right.mean())


def pair_auc(logits: ArrayLike, labels: ArrayLike) -> float:
    """Chance that a random true pair has a higher logit than a random false one; equals count half.

    Rank-based (Mann-Whitney), so it needs no threshold; a constant scorer has exactly 0.5.
    """
    z, y = _checked(logits, labels)
    positives, negatives = y.sum(), (1 - y).sum()
    rank_sum = rankdata(z)[y == 1].sum()
    return float((rank_sum - positives * (positives + 1) / 2) / (positives * negatives))


def _checked(logits: ArrayLike, labels: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    z, y = np.asarray(logits, dtype=np.float64), np.asarray(labels, dtype=np.float64)
    if z.shape != y.shape or z.ndim != 1:
        raise BadInput(f"logits and labels must be vectors of one length; got {z.shape} and {y.shape}")
    if not np.isfinite(z).all():
        raise NumericalError(f"every logit must be finite; pair {int(np.flatnonzero(~np.isfinite(z))[0])} is not")
    if not (np.any(y == 1) and np.any(y == 0) and np.isin(y, (0, 1)).all()):
        raise BadInput("pairs of both classes are needed, labelled 0 and 1; got only one class or other labels")
    return z, y


def _best_threshold(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Midpoint of the gap between neighbouring values that gives the largest balanced accuracy."""
    values, first = np.unique(x, return_inverse=True)
    true_below = np.cumsum(np.bincount(first, weights=y)) / y.sum()
    false_below = np.cumsum(np.bincount(first, weights=1 - y)) / (1 - y).sum()
    best = int(np.argmax(false_below - true_below))
    return float((values[best] + values[min(best + 1, len(values) - 1)]) / 2)


def _nll(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    return float(-np.mean(np.where(y == 1, log_expit(x), log_expit(-x))))


def _ece(x: NDArray[np.float64], y: NDArray[np.float64], bins: int = 15) -> float:
    p = expit(x)
    which = np.minimum((p * bins).astype(int), bins - 1)
    gaps = np.bincount(which, weights=p - y, minlength=bins)
    return float(np.abs(gaps).sum() / len(y))
