"""Features of concatenated towers in the widest directions of each tower, with equal weight for every tower."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from retrieval.methods.cca import CcaView, decompose

Matrix = NDArray[np.float64]
Rows = NDArray[np.float32]


class AffineMap(NamedTuple):
    """`x @ weight + bias`: weight (F, k), bias (k,)."""

    weight: Matrix
    bias: Matrix

    def __call__(self, x: NDArray[np.floating]) -> Matrix:
        """Return (n, k) for rows x (n, F)."""
        return np.asarray(x @ self.weight + self.bias)

    def compose(self, other: "AffineMap") -> "AffineMap":
        """Return this map followed by another, as one map."""
        return AffineMap(self.weight @ other.weight, self.bias @ other.weight + other.bias)


@dataclass(frozen=True, eq=False)
class ReducedFeatures:
    """One modality of n items in the widest directions of each tower's features.

    Attributes:
        views: A decomposition for each tower, of a limited number of directions.
        widths: Feature width of each tower.
        towers: Number of towers; with several fingers, each tower has several views.
    """

    views: tuple[CcaView, ...]
    widths: tuple[int, ...]
    towers: int = 1

    @classmethod
    def of(cls, x: Rows, blocks: Sequence[int], max_directions: int, *, towers: int = 1) -> Self:
        """Return the reduction of features x (n, F) of concatenated towers, whose widths are `blocks`."""
        parts = np.split(x, np.cumsum(blocks)[:-1], axis=1)
        return cls(tuple(decompose(part, max_directions) for part in parts), tuple(blocks), towers)

    def _used(self, last_tower: bool) -> list[int]:
        """Return the places of the used views: all, or those of the last tower."""
        return [place for place in range(len(self.views)) if not last_tower or (place + 1) % self.towers == 0]

    def items(self, directions: int, *, last_tower: bool = False) -> Matrix:
        """Return the items (n, k) in `directions` directions of each tower; the variances of each tower add up to 1.

        Args:
            directions: Number of directions of each tower.
            last_tower: Use only the last tower.
        """
        columns, used = slice(directions), [self.views[place] for place in self._used(last_tower)]
        parts = [view.left[:, columns] * view.singular[columns] / _size(view, directions) for view in used]
        return np.concatenate(parts, axis=1)

    def map(self, directions: int, *, last_tower: bool = False) -> AffineMap:
        """Return the map from features to `items`."""
        weight, bias, starts = [], [], np.cumsum([0, *self.widths])
        for place in self._used(last_tower):
            view = self.views[place]
            rank = min(view.rank, directions)
            part = view.right[:rank].T / view.standardise.scale[:, None] / _size(view, directions)
            columns = np.zeros((sum(self.widths), rank))
            columns[starts[place] + view.standardise.columns] = part
            weight.append(columns)
            bias.append(-(view.standardise.mean @ part))
        return AffineMap(np.concatenate(weight, axis=1), np.concatenate(bias))


def _size(view: CcaView, directions: int) -> float:
    return float(np.sqrt((view.singular[:directions] ** 2).sum() / len(view.left)))
