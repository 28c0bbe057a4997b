"""Whether probabilities mean what they say."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from retrieval.errors import BadInput

BINS = 15


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
