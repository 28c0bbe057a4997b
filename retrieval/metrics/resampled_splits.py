"""Values over several random splits into training and test objects: mean, range, and an interval that covers the split.

Splits that share objects are not independent, so the spread of their values alone gives intervals that are far too
narrow. The variance of their mean is estimated as `(1 / J + test / train) * s^2` (the corrected resampled t-test;
Nadeau and Bengio 2003, Machine Learning 52, eq. 15), with J splits, s^2 the variance of their values, and test and
train the numbers of objects of a split. It covers other test objects AND other training objects from the same
collection. It does not cover another sensor, nor classes that the collection lacks.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t

from retrieval.errors import BadInput
from retrieval.metrics.intervals import FEW_OBJECTS, LEVEL
from retrieval.metrics.measure import Measure


def summarise_splits(splits: Sequence[Measure], ratio: float) -> dict[str, Any]:
    """Return the "summary" of results.json over splits.

    Args:
        splits: One measure per split.
        ratio: Test objects per training object of a split.

    Returns:
        The keys of `intervals.summarise`, with "by_split" [[m], ...], "min" and "max" [m] in place of "by_seed".

    Raises:
        BadInput: There are fewer than two splits.
    """
    means = _means(splits)
    value, margin = means.mean(0), _margin(means, ratio)
    return {
        "value": value.tolist(),
        "low": np.clip(value - margin, 0, 1).tolist(),
        "high": np.clip(value + margin, 0, 1).tolist(),
        "min": means.min(0).tolist(),
        "max": means.max(0).tolist(),
        "chance": np.mean([one.chance for one in splits], axis=0).tolist(),
        "queries": sum(len(one.owner) for one in splits),
        "objects": len(np.unique(np.concatenate([one.owner for one in splits]))),
        "few_objects": len(splits) < FEW_OBJECTS,
        "gallery": splits[0].gallery,
        "by_split": means.tolist(),
    }


def compare_splits(a: Sequence[Measure], b: Sequence[Measure], ratio: float, *, column: int = 0) -> dict[str, Any]:
    """Compare two methods on the same splits, paired by split.

    Args:
        a: Measures of the first method, one per split.
        b: Measures of the second.
        ratio: Test objects per training object of a split.
        column: Column of the values; of a top-n curve, 0 is the top-1 accuracy.

    Returns:
        {"difference": a - b, "low", "high", "min", "max", "few_objects", "p"}; p is that of the corrected t-test,
        two-sided.

    Raises:
        BadInput: There are fewer than two splits.
    """
    differences = (_means(a) - _means(b))[:, [column]]
    value, margin = float(differences.mean()), float(_margin(differences, ratio)[0])
    scale = margin / t.ppf((1 + LEVEL) / 2, len(differences) - 1)
    p = float(2 * t.sf(abs(value) / scale, len(differences) - 1)) if scale else float(value == 0)
    return {
        "difference": value,
        "low": max(value - margin, -1.0),
        "high": min(value + margin, 1.0),
        "min": float(differences.min()),
        "max": float(differences.max()),
        "few_objects": len(differences) < FEW_OBJECTS,
        "p": p,
    }


def _means(splits: Sequence[Measure]) -> NDArray[np.float64]:
    """Return the values (J, m) of the splits, with objects of equal weight."""
    if len(splits) < 2:
        raise BadInput(f"a spread over splits needs at least two splits; got {len(splits)}")
    return np.array([one.by_object()[1].mean(0) for one in splits])


def _margin(means: NDArray[np.float64], ratio: float) -> NDArray[np.float64]:
    count = len(means)
    spread = np.sqrt((1 / count + ratio) * means.var(0, ddof=1))
    return np.asarray(t.ppf((1 + LEVEL) / 2, count - 1) * spread)
