"""CCA of towers side by side, for few objects: what `retrieve adapt` fits.

Features of each tower are first reduced to their widest directions, every tower weighing the same; then come canonical
correlations with a ridge (`retrieval.methods.cca`). On a few dozen objects nothing with more freedom did better
(docs/adapting.md). A map of maps is one matrix, so that the result is stored as the projections of an ordinary matcher.

Settings are chosen from `GRID` by training objects that are held out (`select_settings`), never by objects that test.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby, product
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput
from retrieval.methods.cca import (
    MAX_DIRECTIONS,
    CcaView,
    canonical_correlations,
    cosine,
    decompose,
    decompose_standardised,
    unit_rows,
)
from retrieval.methods.method import Array, Method
from retrieval.methods.selection import Validator, held_out_folds, validation_rows
from retrieval.methods.standardise import Standardiser
from retrieval.model.config import Config
from retrieval.model.posterior import ScoredTouches, fit_posterior
from retrieval.model.reference_calibration import ReferenceTouches
from retrieval.model.towers import build_tower
from retrieval.model.towers.concatenated import feature_counts_of

if TYPE_CHECKING:
    from retrieval.training.features import Features

Matrix = NDArray[np.float64]
Rows = NDArray[np.float32]
Numbers = NDArray[np.int64]
TowerWidths = tuple[Sequence[int], Sequence[int]]
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
MAX_GRID_DIRECTIONS = max(one.directions for one in GRID)


class AffineMap(NamedTuple):
    """`x @ weight + bias`: weight (F, k), bias (k,)."""

    weight: Matrix
    bias: Matrix

    def __call__(self, x: NDArray[np.floating]) -> Matrix:
        """(n, k) of rows x (n, F)."""
        return np.asarray(x @ self.weight + self.bias)

    def compose(self, other: "AffineMap") -> "AffineMap":
        """This map and another after it, as one."""
        return AffineMap(self.weight @ other.weight, self.bias @ other.weight + other.bias)


class CcaProjections(NamedTuple):
    """How touches and photos become codes whose cosine is high where they show one object."""

    touch: AffineMap
    photo: AffineMap

    def cosines(self, touch: NDArray[np.floating], photo: NDArray[np.floating]) -> Rows:
        """(T, N) of features (T, F) and (N, F')."""
        return unit_rows(self.touch(touch)) @ unit_rows(self.photo(photo)).T


@dataclass(frozen=True, eq=False)
class ReducedFeatures:
    """One modality of n items in the widest directions of each tower's features.

    views: a decomposition for each tower, of `MAX_GRID_DIRECTIONS` directions at most. widths: how wide each tower's features are.
    """

    views: tuple[CcaView, ...]
    widths: tuple[int, ...]

    @classmethod
    def of(cls, x: Rows, blocks: Sequence[int], most: int = MAX_GRID_DIRECTIONS) -> Self:
        """The reduction of features x (n, F), which come from towers that stand side by side, as wide as `blocks`
        say.
        """
        parts = np.split(x, np.cumsum(blocks)[:-1], axis=1)
        return cls(tuple(decompose(part, most) for part in parts), tuple(blocks))

    def items(self, directions: int) -> Matrix:
        """(n, k): the items in so many directions of each tower, the variances of each tower adding up to 1."""
        shown = slice(directions)
        parts = [view.left[:, shown] * view.singular[shown] / _size(view, directions) for view in self.views]
        return np.concatenate(parts, axis=1)

    def map(self, directions: int) -> AffineMap:
        """The map from features to `items`."""
        ranks = [min(view.rank, directions) for view in self.views]
        weight, bias = np.zeros((sum(self.widths), sum(ranks))), []
        row = column = 0
        for view, width, rank in zip(self.views, self.widths, ranks, strict=True):
            part = view.right[:rank].T / view.standardise.scale[:, None] / _size(view, directions)
            weight[row + view.standardise.columns, column : column + rank] = part
            bias.append(-(view.standardise.mean @ part))
            row, column = row + width, column + rank
        return AffineMap(weight, np.concatenate(bias))


def _size(view: CcaView, directions: int) -> float:
    return float(np.sqrt((view.singular[:directions] ** 2).sum() / len(view.left)))


def fit_projections(
    touch: Rows, photo: Rows, owner: Numbers, blocks: TowerWidths, settings: Sequence[CcaSettings] = GRID
) -> Iterator[tuple[CcaSettings, CcaProjections]]:
    """Codes of each of the settings, from features of grasps: touch (n, F), photo (n, F'), owner (n,) objects from 0.

    blocks: how wide the towers' features are that stand side by side, of touches and of photos.
    """
    most = max(one.directions for one in settings)
    touch_view, photo_view = ReducedFeatures.of(touch, blocks[0], most), ReducedFeatures.of(photo, blocks[1], most)
    for one, projections in _fit(touch_view, photo_view, np.arange(len(owner)), owner, settings):
        maps = touch_view.map(one.directions), photo_view.map(one.directions)
        yield one, CcaProjections(maps[0].compose(projections.touch), maps[1].compose(projections.photo))


def _fit(
    touch: ReducedFeatures, photo: ReducedFeatures, rows: Numbers, owner: Numbers, settings: Sequence[CcaSettings]
) -> Iterator[tuple[CcaSettings, CcaProjections]]:
    """Codes of reduced items, from some of their rows."""
    for directions, some in groupby(sorted(settings, key=lambda one: one.directions), lambda one: one.directions):
        items = [part.items(directions)[rows] for part in (touch, photo)]
        means = [part.mean(0) for part in items]
        touch_view, photo_view = (_centred_view(part - mean) for part, mean in zip(items, means, strict=True))
        for (ridge, photo_ridge), alike in groupby(sorted(some), lambda one: one[:2]):
            found = canonical_correlations(touch_view, photo_view, owner[rows], ridge, photo_ridge)
            for one in alike:
                weights = found.correlations[:COMPONENTS] ** one.power
                variates = (each[:, :COMPONENTS] * weights for each in (found.touch_weights, found.photo_weights))
                yield (
                    one,
                    CcaProjections(
                        *(AffineMap(each, -mean @ each) for each, mean in zip(variates, means, strict=True))
                    ),
                )


def _centred_view(x: Matrix) -> CcaView:
    """The decomposition of items that are centred already and are not to be scaled: their spread has a meaning."""
    return decompose_standardised(
        x, Standardiser(np.arange(x.shape[1]), np.zeros(x.shape[1]), np.ones(x.shape[1])), MAX_DIRECTIONS
    )


@dataclass(frozen=True, eq=False)
class CcaSelection:
    """Settings that were chosen by objects held out of a fit.

    auc: their mean AUC on these. codes: fitted to all objects. held_out: for each fold, cosines of its touches with its
    photos by codes that its objects did not teach, and the codes of these touches, as a posterior and the worth of
    reference touches are fitted on them.
    """

    settings: CcaSettings
    auc: float
    projections: CcaProjections
    held_out_touches: list[ReferenceTouches]


def select_settings(
    features: "Features", blocks: TowerWidths, folds: Sequence[Sequence[str]], settings: Sequence[CcaSettings] = GRID
) -> CcaSelection:
    """Choose the settings that rank photos of held-out objects best; of equals the largest.

    folds: objects of `features` that are held out together; the others are fitted on. Only the reduction to the widest
    directions, which knows no object, sees all of them.
    """
    touch_view, photo_view = (
        ReducedFeatures.of(_rows(features), blocks[0]),
        ReducedFeatures.of(features.photo, blocks[1]),
    )
    shown = {one: (touch_view.items(one), photo_view.items(one)) for one in {each.directions for each in settings}}
    found: dict[CcaSettings, list[tuple[float, CcaProjections]]] = {one: [] for one in settings}
    rows_of = [np.flatnonzero(np.isin(features.object_ids, fold)) for fold in folds]
    for rows in rows_of:
        out = features.select(rows)
        some = validation_rows(out, MAX_CHOICE_TOUCHES)
        scored, places = Validator(out.select(some)), rows[some]
        others = np.setdiff1d(np.arange(len(features)), rows)
        for one, projections in _fit(touch_view, photo_view, others, features.owner, settings):
            touch, photo = shown[one.directions]
            found[one].append((scored.touch_auc(projections.cosines(touch[places], photo[places])), projections))
    aucs = {one: float(np.mean([auc for auc, _ in each])) for one, each in found.items()}
    best = max(aucs, key=lambda one: (aucs[one], one))
    parts = [
        held_out_touches(features.select(rows), projections, *(part[rows] for part in shown[best.directions]))
        for rows, (_, projections) in zip(rows_of, found[best], strict=True)
    ]
    every = np.arange(len(features))
    projections = dict(_fit(touch_view, photo_view, every, features.owner, [best]))[best]
    maps = touch_view.map(best.directions), photo_view.map(best.directions)
    return CcaSelection(
        best, aucs[best], CcaProjections(maps[0].compose(projections.touch), maps[1].compose(projections.photo)), parts
    )


def held_out_touches(
    features: "Features", projections: CcaProjections, touch: NDArray[np.floating], photo: NDArray[np.floating]
) -> ReferenceTouches:
    """Touches (n, k) and photos (n, k') of objects that the codes have not seen: of each object at most
    `MAX_CALIBRATION_TOUCHES` grasps, evenly spaced.
    """
    rows = validation_rows(features, MAX_CALIBRATION_TOUCHES * len(set(features.object_ids)))
    owner, own = features.owner[rows], np.eye(len(rows), dtype=np.bool_)
    scored = ScoredTouches(projections.cosines(touch[rows], photo[rows]), owner, owner, own)
    return ReferenceTouches(scored, unit_rows(projections.touch(touch[rows])))


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
        blocks = tower_widths(self.settings.config, train)
        self._width = sum(blocks[1])
        photo_view, shown = (replace(part, photo=part.photo[:, : self._width]) for part in (train, validation))
        known, folds = photo_view.concatenate(shown), [tuple(sorted(set(shown.object_ids)))]
        if self.settings.fit_on_validation:
            folds = held_out_folds(known, self.settings.kind_of, seed=self.settings.seed)
        choice = select_settings(known, blocks, folds)
        self._projections = choice.projections
        self.best_params = {**choice.settings._asdict(), "validation_auc": choice.auc}
        self._weights: list[float] | None = None
        with_references = self._width < train.photo.shape[1]
        if with_references or not self.settings.fit_on_validation:
            projections = dict(
                fit_projections(_rows(photo_view), photo_view.photo, photo_view.owner, blocks, [choice.settings])
            )[choice.settings]
            if with_references:
                self._weights = _weights(projections, Validator.of(validation).features, self._width)
                self.best_params |= dict(zip(("photo_weight", "reference_weight"), self._weights, strict=True))
            if not self.settings.fit_on_validation:
                self._projections = projections
        else:
            with suppress(BadInput):  # too few held-out objects, or one photo of each
                posterior = fit_posterior(*(part.scored for part in choice.held_out_touches))
                self.best_params["posterior"] = posterior.to_dict()

    def _encode_touch(self, touch: Array) -> Array:
        code = unit_rows(self._projections.touch(touch.reshape(len(touch), -1)))
        return code if self._weights is None else np.tile(code, 2)

    def _encode_photo(self, photo: Array) -> Array:
        code = unit_rows(self._projections.photo(photo[:, : self._width]))
        if self._weights is None:
            return code
        reference = unit_rows(self._projections.touch(photo[:, self._width :]))
        return np.concatenate([weight * one for weight, one in zip(self._weights, (code, reference), strict=True)], 1)

    def _score(self, touch_encodings: Array, photo_encodings: Array) -> Array:
        return cosine(touch_encodings, photo_encodings)


def _rows(features: "Features") -> Rows:
    return features.touch.reshape(len(features), -1)


def _weights(projections: CcaProjections, shown: "Features", width: int) -> list[float]:
    """What the cosine with a photo and that with a reference touch add to the log-odds of one object: logistic
    regression over all pairs of a touch and an entry, where pairs of one object weigh as much as the others. No weight
    is negative.
    """
    from sklearn.linear_model import LogisticRegression  # slow to import

    touch, entries = _rows(shown), shown.photo
    touch_view = unit_rows(projections.touch(touch))
    cosines = (
        projections.cosines(touch, entries[:, :width]),
        touch_view @ unit_rows(projections.touch(entries[:, width:])).T,
    )
    same = shown.owner[:, None] == shown.owner
    found = LogisticRegression(C=1e4, class_weight="balanced").fit(np.stack(cosines, -1).reshape(-1, 2), same.ravel())
    return [max(0.0, float(weight)) for weight in found.coef_[0]]


def tower_widths(config: Config, features: "Features") -> TowerWidths:
    """How wide the features of each tower of `config` are, of a touch and of a photo, without those of a reference
    touch behind a photo; touches alone may stand in place of photos. Raises BadInput for features that are not of these
    towers.
    """
    import torch

    with torch.device("meta"):
        matcher = config.matcher
        widths = feature_counts_of(build_tower(matcher.tower, matcher.tower_output, matcher.architectures))
    touch_view, photo_view = widths * features.touch.shape[1], widths * len(config.preprocessing.views)
    wanted, got = (sum(touch_view), sum(photo_view)), (_rows(features).shape[1], features.photo.shape[1])
    shown = {sum(photo_view) + sum(touch_view): photo_view, sum(touch_view): touch_view, sum(photo_view): photo_view}
    if wanted[0] != got[0] or got[1] not in shown:
        raise BadInput(
            f"features must be those of the towers {config.matcher.tower} ({config.matcher.tower_output}), "
            f"{wanted[0]} of a touch and {wanted[1]} of a photo; got {got[0]} and {got[1]}; encode with these"
        )
    return touch_view, shown[got[1]]
