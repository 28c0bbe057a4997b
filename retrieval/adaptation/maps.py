"""Linear maps from features to codes whose cosine matches touches with photos, fitted on few objects.

Features of each tower are first reduced to their widest directions, every tower weighing the same; then come canonical
correlations with a ridge (`retrieval.methods.cca`). On a few dozen objects nothing with more freedom did better
(docs/adapting.md). A map of maps is one matrix, so that the result is stored as the projections of an ordinary matcher.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from retrieval.methods.cca import View, canonical, decompose, leading, unit_rows
from retrieval.methods.standardise import Standardiser

Matrix = NDArray[np.float64]
Rows = NDArray[np.float32]
DIRECTIONS = 256
"""Of each tower's features that are kept."""
COMPONENTS = 64
RIDGES = (0.1, 0.3, 1.0)


class Affine(NamedTuple):
    """`x @ weight + bias`: weight (F, k), bias (k,)."""

    weight: Matrix
    bias: Matrix

    def __call__(self, x: NDArray[np.floating]) -> Matrix:
        """(n, k) of rows x (n, F)."""
        return np.asarray(x @ self.weight + self.bias)

    def then(self, other: "Affine") -> "Affine":
        """This map and another after it, as one."""
        return Affine(self.weight @ other.weight, self.bias @ other.weight + other.bias)


class Codes(NamedTuple):
    """How touches and photos become codes whose cosine is high where they show one object."""

    touch: Affine
    photo: Affine

    def cosines(self, touch: Rows, photo: Rows) -> Rows:
        """(T, N) of features (T, F) and (N, F')."""
        return unit_rows(self.touch(touch)) @ unit_rows(self.photo(photo)).T


@dataclass(frozen=True, eq=False)
class Reduced:
    """One modality of n items: the map to the widest directions of each tower's features, and the items there."""

    map: Affine
    view: View

    @classmethod
    def of(cls, x: Rows, blocks: Sequence[int]) -> Self:
        """Of features x (n, F), towers side by side as wide as `blocks` say; a block that does not vary gives none."""
        parts = [_widest(part) for part in np.split(x, np.cumsum(blocks)[:-1], axis=1)]
        weight = np.zeros((x.shape[1], sum(part.weight.shape[1] for part in parts)))
        row = column = 0
        for width, part in zip(blocks, parts, strict=True):
            weight[row : row + width, column : column + part.weight.shape[1]] = part.weight
            row, column = row + width, column + part.weight.shape[1]
        found = Affine(weight, np.concatenate([part.bias for part in parts]))
        return cls(found, _centred(found(x)))


def _widest(x: Rows) -> Affine:
    """To the widest directions of x (n, F), whose variances add up to 1."""
    view = decompose(x)
    kept = slice(min(DIRECTIONS, view.rank))
    size = np.sqrt((view.singular[kept] ** 2).sum() / len(x))
    weight = np.zeros((x.shape[1], view.rank))[:, kept]
    weight[view.standardise.kept] = view.right[kept].T / view.standardise.scale[:, None] / size
    return Affine(weight, -(view.standardise.mean @ weight[view.standardise.kept]))


def _centred(x: Matrix) -> View:
    """Of items that are centred already, and whose spread is meant."""
    left, singular, right = leading(x)
    rank = int((singular > 1e-7 * singular[0]).sum())
    as_it_is = Standardiser(np.arange(x.shape[1]), np.zeros(x.shape[1]), np.ones(x.shape[1]))
    return View(as_it_is, left[:, :rank], singular[:rank], right[:rank])


def fit_codes(
    touch: Rows,
    photo: Rows,
    owner: NDArray[np.int64],
    blocks: tuple[Sequence[int], Sequence[int]],
    ridges: Sequence[float] = RIDGES,
) -> Iterator[tuple[float, Codes]]:
    """The codes of each ridge, from features of grasps: touch (n, F), photo (n, F'), owner (n,) objects from 0.

    blocks: how wide the towers' features are that stand side by side, of touches and of photos. Variates are weighted
    by their correlation; a ridge is a share of the mean variance.
    """
    felt, seen = Reduced.of(touch, blocks[0]), Reduced.of(photo, blocks[1])
    for ridge in ridges:
        found = canonical(felt.view, seen.view, owner, ridge)
        weights = found.correlations[:COMPONENTS]
        yield (
            ridge,
            Codes(
                *(
                    part.map.then(Affine(variates[:, :COMPONENTS] * weights, np.zeros(len(weights))))
                    for part, variates in ((felt, found.touch_weights), (seen, found.photo_weights))
                )
            ),
        )
