"""What a measure says of every query, its means by object, and how often one score beats another."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput, NumericalError


@dataclass(frozen=True, eq=False)
class Measure:
    """Values of one protocol, query by query; shares, so that they lie between 0 and 1 on average.

    values (Q, m): m = 1, or K for a guess curve; owner (Q,): object of the query, which is what intervals resample;
    chance (m,): what a constant scorer gets, in closed form, averaged as the values are (objects alike);
    gallery: what was searched, in plain words.
    """

    values: NDArray[np.float64]
    owner: NDArray[np.int64]
    chance: NDArray[np.float64]
    gallery: str

    def __post_init__(self) -> None:
        wanted = (len(self.owner), len(self.chance))
        if self.values.shape != wanted or 0 in wanted:
            raise BadInput(
                f"a measure must have values of shape {wanted}, and a query at least; got {self.values.shape}"
            )
        if not np.isfinite(self.values).all():
            raise NumericalError("every value of a measure must be finite; one is not")

    def by_object(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Numbers of the objects (R,), ascending, and the mean value of the queries of each (R, m)."""
        return object_means(self.values, self.owner)


def pooled(parts: Sequence[Measure], units: Sequence[Mapping[int, int]] | None = None) -> Measure:
    """One measure of queries that were asked in several galleries, such as those of folds.

    units: for each part, what stands for an object's number in the whole: the object, or a group of objects that only
    together say how much others differ; None: numbers stand for themselves. Values keep their order within a unit;
    chance is averaged as they are. Raises BadInput for no parts.
    """
    if not parts:
        raise BadInput("measures are pooled of one gallery at least; got none")
    owners = [part.owner for part in parts]
    if units is not None:
        owners = [np.array([unit[name] for name in own.tolist()]) for own, unit in zip(owners, units, strict=True)]
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    chances = np.concatenate([np.tile(part.chance, (len(part.owner), 1)) for part in parts])
    return Measure(
        np.concatenate([part.values for part in parts])[order],
        owner[order].astype(np.int64),
        object_means(chances, owner)[1].mean(0),
        parts[0].gallery,
    )


def object_means(
    values: NDArray[np.float64], owner: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Numbers of the objects (R,), ascending, and the mean of the rows of `values` (Q, m) that each owns, (R, m)."""
    objects, place = np.unique(owner, return_inverse=True)
    means = np.zeros((len(objects), values.shape[1]))
    np.add.at(means, place, values)
    return objects, means / np.bincount(place)[:, None]


def object_weights(owner: NDArray[np.int64]) -> NDArray[np.float64]:
    """(Q,) weights that sum to 1 and make every object count alike, however many queries it has."""
    _, place, counts = np.unique(owner, return_inverse=True, return_counts=True)
    return np.asarray(1 / (counts[place] * len(counts)))


def weight_below(
    values: NDArray[np.floating[Any]], others: NDArray[np.floating[Any]], weights: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """(V,) weight of the `others` that each of `values` is above; of equals half (Mann and Whitney).

    weights: 1 for each where None.

    With weights that sum to 1, or divided by the number of others, the mean over values is the area. Scores must be
    finite: a NaN is above nothing.
    """
    order = np.argsort(others)
    below = np.append(0.0, np.cumsum(np.ones(len(others)) if weights is None else weights[order]))
    left, right = (np.searchsorted(others[order], values, side) for side in ("left", "right"))
    return np.asarray((below[left] + below[right]) / 2)
