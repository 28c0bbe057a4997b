"""CCA of towers side by side, for few objects: what `retrieve adapt` fits.

Features of each tower are first reduced to their widest directions, every tower weighing the same; then come canonical
correlations with a ridge (`retrieval.methods.cca`). On a few dozen objects nothing with more freedom did better
(docs/adapting.md). A map of maps is one matrix, so that the result is stored as the projections of an ordinary matcher.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput
from retrieval.methods.base import Array, Method
from retrieval.methods.cca import LEADING, View, canonical, cosine, decompose, factored, unit_rows
from retrieval.methods.selection import Validator
from retrieval.methods.standardise import Standardiser
from retrieval.model.config import Config
from retrieval.model.towers import build_tower
from retrieval.model.towers.side_by_side import widths_of

if TYPE_CHECKING:
    from retrieval.training.features import Features

Matrix = NDArray[np.float64]
Rows = NDArray[np.float32]
Blocks = tuple[Sequence[int], Sequence[int]]
"""How wide the features are of towers that stand side by side, of a touch and of a photo."""
DIRECTIONS = 256
"""Of each tower's features that are kept."""
COMPONENTS = 64
RIDGES = (0.1, 0.3, 1.0)
PHOTO_RIDGE = 1.0
"""Photos of an object are fewer than its touches, and more alike."""


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
        """The reduction of features x (n, F), which come from towers that stand side by side, as wide as `blocks` say;
        a block that does not vary is left out."""
        parts = [_widest(part) for part in np.split(x, np.cumsum(blocks)[:-1], axis=1)]
        weight = np.zeros((x.shape[1], sum(part.weight.shape[1] for part in parts)))
        row = column = 0
        for width, part in zip(blocks, parts, strict=True):
            weight[row : row + width, column : column + part.weight.shape[1]] = part.weight
            row, column = row + width, column + part.weight.shape[1]
        found = Affine(weight, np.concatenate([part.bias for part in parts]))
        return cls(found, _centred(found(x)))


def _widest(x: Rows) -> Affine:
    """The map of x (n, F) to its directions of largest variance, scaled so that all variances add up to 1."""
    view = decompose(x, DIRECTIONS)
    size = np.sqrt((view.singular**2).sum() / len(x))
    weight = np.zeros((x.shape[1], view.rank))
    weight[view.standardise.kept] = view.right.T / view.standardise.scale[:, None] / size
    return Affine(weight, -(view.standardise.mean @ weight[view.standardise.kept]))


def _centred(x: Matrix) -> View:
    """The decomposition of items that are centred already and are not to be scaled: their spread has a meaning."""
    as_it_is = Standardiser(np.arange(x.shape[1]), np.zeros(x.shape[1]), np.ones(x.shape[1]))
    return factored(x, as_it_is, LEADING)


def fit_codes(
    touch: Rows,
    photo: Rows,
    owner: NDArray[np.int64],
    blocks: Blocks,
    ridges: Sequence[float] = RIDGES,
) -> Iterator[tuple[float, Codes]]:
    """The codes of each ridge, from features of grasps: touch (n, F), photo (n, F'), owner (n,) objects from 0.

    blocks: how wide the towers' features are that stand side by side, of touches and of photos. Variates are weighted
    by their correlation; a ridge is a share of the mean variance, that of photos is `PHOTO_RIDGE`.
    """
    felt, seen = Reduced.of(touch, blocks[0]), Reduced.of(photo, blocks[1])
    for ridge in ridges:
        found = canonical(felt.view, seen.view, owner, ridge, PHOTO_RIDGE)
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


class CcaTowers(Method):
    """CCA on the features of towers that stand side by side: a pair's score is the cosine of its two codes, and the
    ridge is chosen by ranking on validation objects.

    Where features of a reference touch stand behind those of each photo, a catalogue's entry is both. A touch's cosine
    with the photo and its cosine with the reference, which is encoded as a touch, are then weighed as the log-odds of
    one object on validation objects say.
    """

    def _fit(self, train: "Features", validation: "Features") -> None:
        blocks = blocks_of(self.setting.config, train)
        self._width = sum(blocks[1])
        judged = Validator.of(validation)
        shown = judged.features
        fits = dict(fit_codes(_rows(train), train.photo[:, : self._width], train.owner, blocks))
        photo = shown.photo[:, : self._width]
        aucs = {ridge: judged.touches(codes.cosines(_rows(shown), photo)) for ridge, codes in fits.items()}
        best = max(aucs, key=lambda ridge: (aucs[ridge], ridge))
        self.chosen = {"ridge": best, "validation_auc": aucs[best]}
        self._weights: list[float] | None = None
        if self._width < train.photo.shape[1]:
            self._weights = _weights(fits[best], shown, self._width)
            self.chosen |= dict(zip(("photo_weight", "reference_weight"), self._weights, strict=True))
        if self.setting.all_teach:
            known = train.joined(validation)
            fits = dict(fit_codes(_rows(known), known.photo[:, : self._width], known.owner, blocks, ridges=(best,)))
        self._codes = fits[best]

    def _encode_touch(self, touch: Array) -> Array:
        code = unit_rows(self._codes.touch(touch.reshape(len(touch), -1)))
        return code if self._weights is None else np.tile(code, 2)

    def _encode_photo(self, photo: Array) -> Array:
        code = unit_rows(self._codes.photo(photo[:, : self._width]))
        if self._weights is None:
            return code
        reference = unit_rows(self._codes.touch(photo[:, self._width :]))
        return np.concatenate([weight * one for weight, one in zip(self._weights, (code, reference), strict=True)], 1)

    def _score(self, touch_codes: Array, photo_codes: Array) -> Array:
        return cosine(touch_codes, photo_codes)


def _rows(features: "Features") -> Rows:
    return features.touch.reshape(len(features), -1)


def _weights(codes: Codes, shown: "Features", width: int) -> list[float]:
    """What the cosine with a photo and that with a reference touch add to the log-odds of one object: logistic
    regression over all pairs of a touch and an entry, where pairs of one object weigh as much as the others. No weight
    is negative."""
    from sklearn.linear_model import LogisticRegression  # slow to import

    touch, entries = _rows(shown), shown.photo
    felt = unit_rows(codes.touch(touch))
    cosines = codes.cosines(touch, entries[:, :width]), felt @ unit_rows(codes.touch(entries[:, width:])).T
    same = shown.owner[:, None] == shown.owner
    found = LogisticRegression(C=1e4, class_weight="balanced").fit(np.stack(cosines, -1).reshape(-1, 2), same.ravel())
    return [max(0.0, float(weight)) for weight in found.coef_[0]]


def blocks_of(config: Config, features: "Features") -> Blocks:
    """How wide the features of each tower of `config` are, of a touch and of a photo, without those of a reference
    touch behind a photo; touches alone may stand in place of photos. Raises BadInput for features that are not of these
    towers."""
    import torch

    with torch.device("meta"):
        widths = widths_of(build_tower(config.matcher.tower, config.matcher.tower_output))
    felt, seen = widths * features.touch.shape[1], widths * len(config.preprocessing.views)
    wanted, got = (sum(felt), sum(seen)), (_rows(features).shape[1], features.photo.shape[1])
    shown = {sum(seen) + sum(felt): seen, sum(felt): felt, sum(seen): seen}
    if wanted[0] != got[0] or got[1] not in shown:
        raise BadInput(
            f"features must be those of the towers {config.matcher.tower} ({config.matcher.tower_output}), "
            f"{wanted[0]} of a touch and {wanted[1]} of a photo; got {got[0]} and {got[1]}; encode with these"
        )
    return felt, shown[got[1]]
