"""Values over several choices of test objects: the mean, the range, and an interval that covers the choice.

Two choices that share objects are not independent, so that the spread of their values alone gives intervals that are
far too narrow. The variance of their mean is therefore taken as `(1 / J + test / train) * s^2` (the corrected resampled
t-test; Nadeau and Bengio 2003, Machine Learning 52, eq. 15), J choices, s^2 the variance of their values, test and
train the numbers of objects of a choice. It covers other objects that test AND other objects that train, drawn from the
same collection; not another sensor, and not classes that the collection lacks.
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
    """The "summary" of results.json over choices: one measure for each choice of test objects.

    ratio: test objects of a choice for each training object. As `intervals.summarise`, with "by_choice" [[m], ...],
    "least" and "most" [m] in place of "by_seed".
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
    """Two methods on the same choices, paired by choice: {"difference": a - b, "low", "high", "least", "most",
    "few_objects", "p"}; p is that of the same corrected t-test, two-sided.
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
    """(J, m): the value of each choice, whose objects count alike."""
    if len(splits) < 2:
        raise BadInput(f"a spread over choices of test objects needs two choices at least; got {len(splits)}")
    return np.array([one.by_object()[1].mean(0) for one in splits])


def _margin(means: NDArray[np.float64], ratio: float) -> NDArray[np.float64]:
    count = len(means)
    spread = np.sqrt((1 / count + ratio) * means.var(0, ddof=1))
    return np.asarray(t.ppf((1 + LEVEL) / 2, count - 1) * spread)
