"""CCA of concatenated towers, for few objects: the method that `retrieve adapt` fits.

The features of each tower are reduced to their widest directions, with equal weight for every tower. Canonical
correlations with a ridge follow (`retrieval.methods.cca`). On a few dozen objects no method with more freedom was
better (docs/measurements/adaptation.md). The maps of each modality compose to one affine map, so the result is stored
as the projections of an ordinary matcher.

Settings are chosen from `GRID` on held-out training objects (`select_settings`), never on test objects.
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
from retrieval.model.calibration_touches import CalibrationTouches
from retrieval.model.config import Config
from retrieval.model.posterior import ScoredTouches, fit_posterior
from retrieval.model.towers import build_tower
from retrieval.model.towers.concatenated import feature_counts_of

if TYPE_CHECKING:
    from retrieval.training.features import Features

Matrix = NDArray[np.float64]
Rows = NDArray[np.float32]
Numbers = NDArray[np.int64]
TowerWidths = tuple[Sequence[int], Sequence[int]]
"""Feature widths of concatenated towers, of a touch and of a photo."""
COMPONENTS = 64
MAX_CHOICE_TOUCHES = 240
"""Touches of a fold with which settings are chosen."""
MAX_CALIBRATION_TOUCHES = 60
"""Touches per object with which the calibrations are fitted."""


class CcaSettings(NamedTuple):
    """Settings of one fit.

    Attributes:
        ridge: Ridge of touches, as a fraction of the mean variance.
        photo_ridge: The same for photos.
        directions: Directions of each tower's features.
        power: Power of the correlation that weights a canonical variate.
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
        """Return (n, k) for rows x (n, F)."""
        return np.asarray(x @ self.weight + self.bias)

    def compose(self, other: "AffineMap") -> "AffineMap":
        """Return this map followed by another, as one map."""
        return AffineMap(self.weight @ other.weight, self.bias @ other.weight + other.bias)


class CcaProjections(NamedTuple):
    """Maps from touches and photos to encodings; the cosine is high if both show the same object."""

    touch: AffineMap
    photo: AffineMap

    def cosines(self, touch: NDArray[np.floating], photo: NDArray[np.floating]) -> Rows:
        """Return cosines (T, N) of features (T, F) and (N, F')."""
        return unit_rows(self.touch(touch)) @ unit_rows(self.photo(photo)).T


@dataclass(frozen=True, eq=False)
class ReducedFeatures:
    """One modality of n items in the widest directions of each tower's features.

    Attributes:
        views: A decomposition for each tower, of at most `MAX_GRID_DIRECTIONS` directions.
        widths: Feature width of each tower.
    """

    views: tuple[CcaView, ...]
    widths: tuple[int, ...]

    @classmethod
    def of(cls, x: Rows, blocks: Sequence[int], max_directions: int = MAX_GRID_DIRECTIONS) -> Self:
        """Return the reduction of features x (n, F) of concatenated towers, whose widths are `blocks`."""
        parts = np.split(x, np.cumsum(blocks)[:-1], axis=1)
        return cls(tuple(decompose(part, max_directions) for part in parts), tuple(blocks))

    def items(self, directions: int) -> Matrix:
        """Return the items (n, k) in `directions` directions of each tower; the variances of each tower add up to 1."""
        columns = slice(directions)
        parts = [view.left[:, columns] * view.singular[columns] / _size(view, directions) for view in self.views]
        return np.concatenate(parts, axis=1)

    def map(self, directions: int) -> AffineMap:
        """Return the map from features to `items`."""
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
    """Yield the projections of each of the settings.

    Args:
        touch: (n, F) touch features of grasps.
        photo: (n, F') photo features.
        owner: (n,) objects, from 0.
        blocks: Feature widths of the concatenated towers, of touches and of photos.
        settings: The settings to fit.
    """
    limit = max(one.directions for one in settings)
    touch_view, photo_view = ReducedFeatures.of(touch, blocks[0], limit), ReducedFeatures.of(photo, blocks[1], limit)
    for one, projections in _fit(touch_view, photo_view, np.arange(len(owner)), owner, settings):
        maps = touch_view.map(one.directions), photo_view.map(one.directions)
        yield one, CcaProjections(maps[0].compose(projections.touch), maps[1].compose(projections.photo))


def _fit(
    touch: ReducedFeatures, photo: ReducedFeatures, rows: Numbers, owner: Numbers, settings: Sequence[CcaSettings]
) -> Iterator[tuple[CcaSettings, CcaProjections]]:
    """Yield the projections of reduced items, fitted on the given rows."""
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
    """Decompose centred items without scaling them: their spread is meaningful."""
    return decompose_standardised(
        x, Standardiser(np.arange(x.shape[1]), np.zeros(x.shape[1]), np.ones(x.shape[1])), MAX_DIRECTIONS
    )


@dataclass(frozen=True, eq=False)
class CcaSelection:
    """Settings that were chosen on held-out objects.

    Attributes:
        settings: The chosen settings.
        auc: Their mean AUC over the folds.
        projections: The maps, fitted to all objects.
        held_out_touches: For each fold, the cosines of its touches with its photos by maps that were fitted without its
            objects, and the encodings of both: the input of the calibrations.
    """

    settings: CcaSettings
    auc: float
    projections: CcaProjections
    held_out_touches: list[CalibrationTouches]


def select_settings(
    features: "Features", blocks: TowerWidths, folds: Sequence[Sequence[str]], settings: Sequence[CcaSettings] = GRID
) -> CcaSelection:
    """Choose the settings that rank photos of held-out objects best; among ties, the largest.

    Only the reduction to the widest directions also sees the held-out grasps, but no object ids.

    Args:
        features: Features of grasps.
        blocks: Feature widths of the concatenated towers, of touches and of photos.
        folds: Objects of `features` that are held out together; the fit uses the others.
        settings: The settings to choose from.
    """
    touch_view, photo_view = (
        ReducedFeatures.of(_rows(features), blocks[0]),
        ReducedFeatures.of(features.photo, blocks[1]),
    )
    items = {one: (touch_view.items(one), photo_view.items(one)) for one in {each.directions for each in settings}}
    found: dict[CcaSettings, list[tuple[float, CcaProjections]]] = {one: [] for one in settings}
    rows_of = [np.flatnonzero(np.isin(features.object_ids, fold)) for fold in folds]
    for rows in rows_of:
        held_out = features.select(rows)
        some = validation_rows(held_out, MAX_CHOICE_TOUCHES)
        validator, places = Validator(held_out.select(some)), rows[some]
        others = np.setdiff1d(np.arange(len(features)), rows)
        for one, projections in _fit(touch_view, photo_view, others, features.owner, settings):
            touch, photo = items[one.directions]
            found[one].append((validator.touch_auc(projections.cosines(touch[places], photo[places])), projections))
    aucs = {one: float(np.mean([auc for auc, _ in each])) for one, each in found.items()}
    best = max(aucs, key=lambda one: (aucs[one], one))
    parts = [
        held_out_touches(features.select(rows), projections, *(part[rows] for part in items[best.directions]))
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
) -> CalibrationTouches:
    """Return touches of objects that the projections were fitted without, for the calibrations.

    Args:
        features: The grasps. Of each object at most `MAX_CALIBRATION_TOUCHES` are used, evenly spaced.
        projections: The maps.
        touch: (n, k) reduced touches.
        photo: (n, k') reduced photos.
    """
    rows = validation_rows(features, MAX_CALIBRATION_TOUCHES * len(set(features.object_ids)))
    owner, own = features.owner[rows], np.eye(len(rows), dtype=np.bool_)
    scored = ScoredTouches(projections.cosines(touch[rows], photo[rows]), owner, owner, own)
    return CalibrationTouches(
        scored, unit_rows(projections.touch(touch[rows])), unit_rows(projections.photo(photo[rows]))
    )


class CcaTowers(Method):
    """CCA on the features of concatenated towers: a pair's score is the cosine of its two encodings.

    Settings are chosen by ranking on validation objects. With `fit_on_validation` they are chosen by cross-validation
    within all objects, and the held-out objects also calibrate the cosines ("posterior" in `best_params`).

    If the features of a reference touch follow those of each photo, an entry of the catalogue has both. The touch's
    cosines with the photo and with the reference, which is encoded as a touch, are then weighted by logistic regression
    on validation objects.
    """

    is_seeded = False

    def _fit(self, train: "Features", validation: "Features") -> None:
        blocks = tower_widths(self.settings.config, train)
        self._width = sum(blocks[1])
        photos_only, held_out = (replace(part, photo=part.photo[:, : self._width]) for part in (train, validation))
        known, folds = photos_only.concatenate(held_out), [tuple(sorted(set(held_out.object_ids)))]
        if self.settings.fit_on_validation:
            folds = held_out_folds(known, self.settings.kind_of, seed=self.settings.seed)
        choice = select_settings(known, blocks, folds)
        self._projections = choice.projections
        self.best_params = {**choice.settings._asdict(), "validation_auc": choice.auc}
        self._weights: list[float] | None = None
        with_references = self._width < train.photo.shape[1]
        if with_references or not self.settings.fit_on_validation:
            projections = dict(
                fit_projections(_rows(photos_only), photos_only.photo, photos_only.owner, blocks, [choice.settings])
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
        encoding = unit_rows(self._projections.touch(touch.reshape(len(touch), -1)))
        return encoding if self._weights is None else np.tile(encoding, 2)

    def _encode_photo(self, photo: Array) -> Array:
        encoding = unit_rows(self._projections.photo(photo[:, : self._width]))
        if self._weights is None:
            return encoding
        reference = unit_rows(self._projections.touch(photo[:, self._width :]))
        parts = zip(self._weights, (encoding, reference), strict=True)
        return np.concatenate([weight * part for weight, part in parts], 1)

    def _score(self, touch_encodings: Array, photo_encodings: Array) -> Array:
        return cosine(touch_encodings, photo_encodings)


def _rows(features: "Features") -> Rows:
    return features.touch.reshape(len(features), -1)


def _weights(projections: CcaProjections, validation: "Features", width: int) -> list[float]:
    """Return the weights of the cosine with a photo and with a reference touch in the log-odds of one object.

    Logistic regression over all pairs of a touch and an entry; matching pairs have the same total weight as
    non-matching ones. No weight is negative.
    """
    from sklearn.linear_model import LogisticRegression  # slow to import

    touch, entries = _rows(validation), validation.photo
    touch_view = unit_rows(projections.touch(touch))
    cosines = (
        projections.cosines(touch, entries[:, :width]),
        touch_view @ unit_rows(projections.touch(entries[:, width:])).T,
    )
    same = validation.owner[:, None] == validation.owner
    found = LogisticRegression(C=1e4, class_weight="balanced").fit(np.stack(cosines, -1).reshape(-1, 2), same.ravel())
    return [max(0.0, float(weight)) for weight in found.coef_[0]]


def tower_widths(config: Config, features: "Features") -> TowerWidths:
    """Return the feature widths of each tower of `config`, of a touch and of a photo.

    Features of a reference touch after those of a photo are not counted. Touches may also take the place of photos.

    Raises:
        BadInput: The features are not from these towers.
    """
    import torch

    with torch.device("meta"):
        matcher = config.matcher
        widths = feature_counts_of(build_tower(matcher.tower, matcher.tower_output, matcher.architectures))
    touch_view, photo_view = widths * features.touch.shape[1], widths * len(config.preprocessing.views)
    expected, got = (sum(touch_view), sum(photo_view)), (_rows(features).shape[1], features.photo.shape[1])
    accepted = {sum(photo_view) + sum(touch_view): photo_view, sum(touch_view): touch_view, sum(photo_view): photo_view}
    if expected[0] != got[0] or got[1] not in accepted:
        raise BadInput(
            f"features must be those of the towers {config.matcher.tower} ({config.matcher.tower_output}), "
            f"{expected[0]} of a touch and {expected[1]} of a photo; got {got[0]} and {got[1]}; use these towers"
        )
    return touch_view, accepted[got[1]]
