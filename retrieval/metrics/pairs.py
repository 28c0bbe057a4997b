"""The accuracy of match decisions on pairs, and of probabilities, on held-out objects."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retrieval.errors import BadInput, NumericalError
from retrieval.metrics.measure import weight_below

BINS = 15
_LARGEST = float(np.finfo(np.float32).max)


def pair_accuracy(logits: ArrayLike, labels: ArrayLike) -> float:
    """Return the fraction of pairs on the correct side of logit 0; a logit of exactly 0 counts half."""
    z, y = _checked(logits, labels)
    correct = np.where(z == 0, 0.5, (z > 0) == (y == 1))
    return float(correct.mean())


def negative_log_likelihood(logits: ArrayLike, labels: ArrayLike) -> float:
    """Return the mean negative log-likelihood of pairs in nats, with the logits as log-odds."""
    z, y = _checked(logits, labels)
    return float(-np.mean(-np.logaddexp(0, np.where(y == 1, -z, z))))


def pair_auc(logits: ArrayLike, labels: ArrayLike) -> float:
    """Return the probability that a random true pair has a higher logit than a random false one; ties count half.

    No threshold is needed. A constant scorer has exactly 0.5.
    """
    z, y = _checked(logits, labels)
    true, false = z[y == 1], z[y == 0]
    return float(weight_below(true, false).sum() / (len(true) * len(false)))


def reliability_bins(probability: ArrayLike, outcomes: ArrayLike) -> dict[str, Any]:
    """Return {"ece", "bins": [{"probability", "frequency", "count"}]} of 15 equal bins, empty ones left out.

    Each prediction has the error |probability - frequency| of its bin. The expected calibration error is the mean over
    all predictions (P,). An outcome is 1 if the prediction is true, 0 if not; 1/n if n answers tie and one is right.
    """
    p, y = np.asarray(probability, dtype=np.float64), np.asarray(outcomes, dtype=np.float64)
    which = np.minimum((p * BINS).astype(int), BINS - 1)
    used, place, counts = np.unique(which, return_inverse=True, return_counts=True)
    mean_probability, frequency = (np.bincount(place, weights=values) / counts for values in (p, y))
    bins = [
        {"probability": float(mean_probability[row]), "frequency": float(frequency[row]), "count": int(counts[row])}
        for row in range(len(used))
    ]
    return {"ece": float((np.abs(mean_probability - frequency) * counts).sum() / len(p)), "bins": bins}


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
