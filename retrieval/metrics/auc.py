"""The area under the ROC curve (Mann and Whitney): how often one score beats another, equals counting half."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def weight_below(
    values: NDArray[np.floating[Any]], others: NDArray[np.floating[Any]], weights: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """(V,) weight of the `others` that each of `values` is above; of equals half. weights: 1 for each where None.

    With weights that sum to 1, or divided by the number of others, the mean over values is the area. Scores must be
    finite: a NaN is above nothing.
    """
    order = np.argsort(others)
    below = np.append(0.0, np.cumsum(np.ones(len(others)) if weights is None else weights[order]))
    left, right = (np.searchsorted(others[order], values, side) for side in ("left", "right"))
    return np.asarray((below[left] + below[right]) / 2)
