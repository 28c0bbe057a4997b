"""CCA of towers side by side, for few objects: what `retrieve adapt` fits.

Features of each tower are first reduced to their widest directions, every tower weighing the same; then come canonical
correlations with a ridge (`retrieval.methods.cca`). On a few dozen objects nothing with more freedom did better
(docs/adapting.md). A map of maps is one matrix, so that the result is stored as the projections of an ordinary matcher.

Settings are chosen from `GRID` by training objects that are held out (`choose`), never by objects that test.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby, product
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput
from retrieval.methods.base import Array, Method
from retrieval.methods.cca import LEADING, View, canonical, cosine, decompose, factored, unit_rows
from retrieval.methods.selection import Validator, held_out_folds, judged_rows
from retrieval.methods.standardise import Standardiser
from retrieval.model.config import Config
from retrieval.model.posterior import JudgedTouches, fit_posterior
from retrieval.model.references import FeltTouches
from retrieval.model.towers import build_tower
from retrieval.model.towers.side_by_side import widths_of

if TYPE_CHECKING:
    from retrieval.training.features import Features

Matrix = NDArray[np.float64]
Rows = NDArray[np.float32]
Numbers = NDArray[np.int64]
Blocks = tuple[Sequence[int], Sequence[int]]
"""How wide the features are of towers that stand side by side, of a touch and of a photo."""
COMPONENTS = 64
MAX_CHOICE_TOUCHES = 240
"""Touches of a fold that settings are chosen by."""
MAX_CALIBRATION_TOUCHES = 60
"""Touches of an object that a posterior is fitted on."""


class CcaSettings(NamedTuple):
    """Settings of one fit.

    ridge, photo_ridge: shares of the mean variance, of touches and of photos. directions: kept of each tower's
    features. power: of the correlation by which a canonical variate is weighted.
    """

    ridge: float = 0.3
    photo_ridge: float = 1.0
    directions: int = 256
    power: int = 1


GRID = tuple(CcaSettings(*one) for one in product((0.1, 0.3, 1.0), (0.3, 1.0, 3.0), (64, 128, 256), (1, 2)))
WIDEST = max(one.directions for one in GRID)


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

    def cosines(self, touch: NDArray[np.floating], photo: NDArray[np.floating]) -> Rows:
        """(T, N) of features (T, F) and (N, F')."""
        return unit_rows(self.touch(touch)) @ unit_rows(self.photo(photo)).T


@dataclass(frozen=True, eq=False)
class Reduced:
    """One modality of n items in the widest directions of each tower's features.

    views: a decomposition for each tower, of `WIDEST` directions at most. widths: how wide each tower's features are.
    """

    views: tuple[View, ...]
    widths: tuple[int, ...]

    @classmethod
    def of(cls, x: Rows, blocks: Sequence[int], most: int = WIDEST) -> Self:
        """The reduction of features x (n, F), which come from towers that stand side by side, as wide as `blocks`
        say."""
        parts = np.split(x, np.cumsum(blocks)[:-1], axis=1)
        return cls(tuple(decompose(part, most) for part in parts), tuple(blocks))

    def items(self, directions: int) -> Matrix:
        """(n, k): the items in so many directions of each tower, the variances of each tower adding up to 1."""
        shown = slice(directions)
        parts = [view.left[:, shown] * view.singular[shown] / _size(view, directions) for view in self.views]
        return np.concatenate(parts, axis=1)

    def map(self, directions: int) -> Affine:
        """The map from features to `items`."""
        ranks = [min(view.rank, directions) for view in self.views]
        weight, bias = np.zeros((sum(self.widths), sum(ranks))), []
        row = column = 0
        for view, width, rank in zip(self.views, self.widths, ranks, strict=True):
            part = view.right[:rank].T / view.standardise.scale[:, None] / _size(view, directions)
            weight[row + view.standardise.kept, column : column + rank] = part
            bias.append(-(view.standardise.mean @ part))
            row, column = row + width, column + rank
        return Affine(weight, np.concatenate(bias))


def _size(view: View, directions: int) -> float:
    return float(np.sqrt((view.singular[:directions] ** 2).sum() / len(view.left)))


def fit_codes(
    touch: Rows, photo: Rows, owner: Numbers, blocks: Blocks, settings: Sequence[CcaSettings] = GRID
) -> Iterator[tuple[CcaSettings, Codes]]:
    """Codes of each of the settings, from features of grasps: touch (n, F), photo (n, F'), owner (n,) objects from 0.

    blocks: how wide the towers' features are that stand side by side, of touches and of photos.
    """
    most = max(one.directions for one in settings)
    felt, seen = Reduced.of(touch, blocks[0], most), Reduced.of(photo, blocks[1], most)
    for one, codes in _fit(felt, seen, np.arange(len(owner)), owner, settings):
        maps = felt.map(one.directions), seen.map(one.directions)
        yield one, Codes(maps[0].then(codes.touch), maps[1].then(codes.photo))


def _fit(
    touch: Reduced, photo: Reduced, rows: Numbers, owner: Numbers, settings: Sequence[CcaSettings]
) -> Iterator[tuple[CcaSettings, Codes]]:
    """Codes of reduced items, from some of their rows."""
    for directions, some in groupby(sorted(settings, key=lambda one: one.directions), lambda one: one.directions):
        items = [part.items(directions)[rows] for part in (touch, photo)]
        means = [part.mean(0) for part in items]
        felt, seen = (_as_it_is(part - mean) for part, mean in zip(items, means, strict=True))
        for (ridge, photo_ridge), alike in groupby(sorted(some), lambda one: one[:2]):
            found = canonical(felt, seen, owner[rows], ridge, photo_ridge)
            for one in alike:
                weights = found.correlations[:COMPONENTS] ** one.power
                variates = (each[:, :COMPONENTS] * weights for each in (found.touch_weights, found.photo_weights))
                yield one, Codes(*(Affine(each, -mean @ each) for each, mean in zip(variates, means, strict=True)))


def _as_it_is(x: Matrix) -> View:
    """The decomposition of items that are centred already and are not to be scaled: their spread has a meaning."""
    return factored(x, Standardiser(np.arange(x.shape[1]), np.zeros(x.shape[1]), np.ones(x.shape[1])), LEADING)


@dataclass(frozen=True, eq=False)
class Choice:
    """Settings that were chosen by objects held out of a fit.

    auc: their mean AUC on these. codes: fitted to all objects. held_out: for each fold, cosines of its touches with its
    photos by codes that its objects did not teach, and the codes of these touches, as a posterior and the worth of
    reference touches are fitted on them.
    """

    settings: CcaSettings
    auc: float
    codes: Codes
    held_out: list[FeltTouches]


def choose(
    features: "Features", blocks: Blocks, folds: Sequence[Sequence[str]], settings: Sequence[CcaSettings] = GRID
) -> Choice:
    """Choose the settings that rank photos of held-out objects best; of equals the largest.

    folds: objects of `features` that are held out together; the others are fitted on. Only the reduction to the widest
    directions, which knows no object, sees all of them.
    """
    felt, seen = Reduced.of(_rows(features), blocks[0]), Reduced.of(features.photo, blocks[1])
    shown = {one: (felt.items(one), seen.items(one)) for one in {each.directions for each in settings}}
    found: dict[CcaSettings, list[tuple[float, Codes]]] = {one: [] for one in settings}
    rows_of = [np.flatnonzero(np.isin(features.object_ids, fold)) for fold in folds]
    for rows in rows_of:
        out = features.select(rows)
        some = judged_rows(out, MAX_CHOICE_TOUCHES)
        judged, places = Validator(out.select(some)), rows[some]
        others = np.setdiff1d(np.arange(len(features)), rows)
        for one, codes in _fit(felt, seen, others, features.owner, settings):
            touch, photo = shown[one.directions]
            found[one].append((judged.touches(codes.cosines(touch[places], photo[places])), codes))
    aucs = {one: float(np.mean([auc for auc, _ in each])) for one, each in found.items()}
    best = max(aucs, key=lambda one: (aucs[one], one))
    parts = [
        held_out(features.select(rows), codes, *(part[rows] for part in shown[best.directions]))
        for rows, (_, codes) in zip(rows_of, found[best], strict=True)
    ]
    every = np.arange(len(features))
    codes = dict(_fit(felt, seen, every, features.owner, [best]))[best]
    maps = felt.map(best.directions), seen.map(best.directions)
    return Choice(best, aucs[best], Codes(maps[0].then(codes.touch), maps[1].then(codes.photo)), parts)


def held_out(
    features: "Features", codes: Codes, touch: NDArray[np.floating], photo: NDArray[np.floating]
) -> FeltTouches:
    """Touches (n, k) and photos (n, k') of objects that the codes have not seen: of each object at most
    `MAX_CALIBRATION_TOUCHES` grasps, evenly spaced."""
    rows = judged_rows(features, MAX_CALIBRATION_TOUCHES * len(set(features.object_ids)))
    owner, own = features.owner[rows], np.eye(len(rows), dtype=np.bool_)
    judged = JudgedTouches(codes.cosines(touch[rows], photo[rows]), owner, owner, own)
    return FeltTouches(judged, unit_rows(codes.touch(touch[rows])))


class CcaTowers(Method):
    """CCA on the features of towers that stand side by side: a pair's score is the cosine of its two codes.

    Settings are chosen by ranking on validation objects; where all objects teach, by cross-validation within them, and
    the same held-out objects say what a cosine means (the "posterior" among what was chosen).

    Where features of a reference touch stand behind those of each photo, a catalogue's entry is both. A touch's cosine
    with the photo and its cosine with the reference, which is encoded as a touch, are then weighed as the log-odds of
    one object on validation objects say.
    """

    is_seeded = False

    def _fit(self, train: "Features", validation: "Features") -> None:
        blocks = blocks_of(self.setting.config, train)
        self._width = sum(blocks[1])
        seen, shown = (replace(part, photo=part.photo[:, : self._width]) for part in (train, validation))
        known, folds = seen.joined(shown), [tuple(sorted(set(shown.object_ids)))]
        if self.setting.all_teach:
            folds = held_out_folds(known, self.setting.kind_of, seed=self.setting.seed)
        choice = choose(known, blocks, folds)
        self._codes = choice.codes
        self.chosen = {**choice.settings._asdict(), "validation_auc": choice.auc}
        self._weights: list[float] | None = None
        with_references = self._width < train.photo.shape[1]
        if with_references or not self.setting.all_teach:
            codes = dict(fit_codes(_rows(seen), seen.photo, seen.owner, blocks, [choice.settings]))[choice.settings]
            if with_references:
                self._weights = _weights(codes, Validator.of(validation).features, self._width)
                self.chosen |= dict(zip(("photo_weight", "reference_weight"), self._weights, strict=True))
            if not self.setting.all_teach:
                self._codes = codes
        else:
            with suppress(BadInput):  # too few held-out objects, or one photo of each
                posterior = fit_posterior(*(part.judged for part in choice.held_out))
                self.chosen["posterior"] = posterior.to_dict()

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
        matcher = config.matcher
        widths = widths_of(build_tower(matcher.tower, matcher.tower_output, matcher.architectures))
    felt, seen = widths * features.touch.shape[1], widths * len(config.preprocessing.views)
    wanted, got = (sum(felt), sum(seen)), (_rows(features).shape[1], features.photo.shape[1])
    shown = {sum(seen) + sum(felt): seen, sum(felt): felt, sum(seen): seen}
    if wanted[0] != got[0] or got[1] not in shown:
        raise BadInput(
            f"features must be those of the towers {config.matcher.tower} ({config.matcher.tower_output}), "
            f"{wanted[0]} of a touch and {wanted[1]} of a photo; got {got[0]} and {got[1]}; encode with these"
        )
    return felt, shown[got[1]]
