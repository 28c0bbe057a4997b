"""Values of a measure by query, their means by object, and how often one score exceeds another."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FEW_OBJECTS = 5
"""With fewer objects, the coverage of an interval is far below its level."""


@dataclass(frozen=True, eq=False)
class Measure:
    """Values of one protocol by query: fractions, which lie between 0 and 1 on average.

    Attributes:
        values: (Q, m); m is 1, or K for a top-n curve.
        owner: (Q,) object of each query: the unit that intervals resample.
        chance: (m,) values of a constant scorer, in closed form, averaged like the values (each object with weight 1).
        gallery: Description of the searched items.
    """

    values: NDArray[np.float64]
    owner: NDArray[np.int64]
    chance: NDArray[np.float64]
    gallery: str

    def by_object(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the objects (R,), ascending, and the mean value (R, m) of the queries of each."""
        return object_means(self.values, self.owner)


def pooled(parts: Sequence[Measure], unit_of: Mapping[int, int] | None = None) -> Measure:
    """Return one measure of queries against several galleries, such as those of folds.

    Values keep their order within a unit. Chance is averaged like the values.

    Args:
        parts: The measures, at least one.
        unit_of: The unit that replaces an object's number: the object, or a group of objects that are correlated. None
            for the objects' own numbers.
    """
    owner = np.concatenate([part.owner for part in parts])
    if unit_of is not None:
        owner = np.array([unit_of[name] for name in owner.tolist()])
    order = np.argsort(owner, kind="stable")
    chance = parts[0].chance
    if not all(np.array_equal(part.chance, chance) for part in parts):  # the mean of equal numbers may be rounded
        chances = np.concatenate([np.tile(part.chance, (len(part.owner), 1)) for part in parts])
        chance = object_means(chances, owner)[1].mean(0)
    return Measure(
        np.concatenate([part.values for part in parts])[order],
        owner[order].astype(np.int64),
        chance,
        parts[0].gallery,
    )


def object_means(
    values: NDArray[np.float64], owner: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the objects (R,), ascending, and the mean (R, m) of the rows of `values` (Q, m) of each."""
    objects, place = np.unique(owner, return_inverse=True)
    means = np.zeros((len(objects), values.shape[1]))
    np.add.at(means, place, values)
    return objects, means / np.bincount(place)[:, None]


def object_weights(owner: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return weights (Q,) that sum to 1 and give every object the same total, however many queries it has."""
    _, place, counts = np.unique(owner, return_inverse=True, return_counts=True)
    return np.asarray(1 / (counts[place] * len(counts)))


def weight_below(
    values: NDArray[np.floating[Any]], others: NDArray[np.floating[Any]], weights: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Return the weight (V,) of the `others` (O,) below each of `values` (V,); equal ones count half (Mann-Whitney).

    With weights (O,) that sum to 1, or divided by the number of others, the mean over values is the AUC. Without
    weights each counts 1. Scores must be finite: a NaN is sorted as the highest.
    """
    order = np.argsort(others)
    below = np.append(0.0, np.cumsum(np.ones(len(others)) if weights is None else weights[order]))
    left, right = (np.searchsorted(others[order], values, side) for side in ("left", "right"))
    return np.asarray((below[left] + below[right]) / 2)
