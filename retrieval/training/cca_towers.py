"""CCA of concatenated towers, for few objects: what `retrieve adapt` fits.

The features of each tower are reduced to their widest directions, with equal weight for every tower. Canonical
correlations with a ridge follow (`retrieval.training.cca`). On a few dozen objects nothing with more freedom was
better (docs/measurements/adaptation.md). The maps of each modality compose to one affine map, so the result is stored
as the projections of an ordinary matcher.

Settings are chosen from `GRID` on held-out training objects (`select_settings`), never on test objects.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, product
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.errors import BadInput
from retrieval.model.config import Config
from retrieval.model.fusion import Matcher
from retrieval.training.calibration.touches import ScoredTouches
from retrieval.training.cca import MAX_DIRECTIONS, CcaView, Standardiser, canonical_correlations, decompose, unit_rows
from retrieval.training.features import Features
from retrieval.training.selection import ranking_auc, validation_rows

Matrix = NDArray[np.float64]
Rows = NDArray[np.float32]
Numbers = NDArray[np.int64]
COMPONENTS = 64
MAX_CHOICE_TOUCHES = 240
"""Touches of a fold with which settings are chosen."""
MAX_CALIBRATION_TOUCHES = 60
"""Touches per object with which the calibrations are fitted."""


class TowerWidths(NamedTuple):
    """Feature widths of concatenated towers.

    Attributes:
        touch: Of each touch tower for the first finger, then for the next one.
        photo: Of each photo tower for the first view, then for the next one.
        touch_towers: Number of touch towers.
    """

    touch: Sequence[int]
    photo: Sequence[int]
    touch_towers: int = 1


class CcaSettings(NamedTuple):
    """Settings of one fit.

    Attributes:
        ridge: Ridge of touches, as a fraction of the mean variance.
        photo_ridge: The same for photos.
        directions: Directions of each tower's features.
        power: Power of the correlation that weights a canonical variate.
        last_tower: Use only the last of the touch towers.
    """

    ridge: float = 0.3
    photo_ridge: float = 1.0
    directions: int = 256
    power: int = 1
    last_tower: bool = False


GRID = tuple(CcaSettings(*one) for one in product((0.1, 0.3, 1.0), (0.3, 1.0, 3.0), (64, 128, 256), (1, 2)))


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
            rank = min(len(view.singular), directions)
            part = view.right[:rank].T / view.standardise.scale[:, None] / _size(view, directions)
            columns = np.zeros((sum(self.widths), rank))
            columns[starts[place] + view.standardise.columns] = part
            weight.append(columns)
            bias.append(-(view.standardise.mean @ part))
        return AffineMap(np.concatenate(weight, axis=1), np.concatenate(bias))


def _size(view: CcaView, directions: int) -> float:
    return float(np.sqrt((view.singular[:directions] ** 2).sum() / len(view.left)))


class CcaProjections(NamedTuple):
    """Maps from touches and photos to encodings; the cosine is high if both show the same object."""

    touch: AffineMap
    photo: AffineMap

    def cosines(self, touch: NDArray[np.floating], photo: NDArray[np.floating]) -> Rows:
        """Return cosines (T, N) of features (T, F) and (N, F')."""
        return unit_rows(self.touch(touch)) @ unit_rows(self.photo(photo)).T


def fit_projections(
    features: Features, widths: TowerWidths, settings: Sequence[CcaSettings] = GRID
) -> dict[CcaSettings, CcaProjections]:
    """Return the projections of grasps for each of the settings; `widths` are those of their towers."""
    reduced, every = _Reduced.of(features, widths, settings), np.arange(len(features))
    return {one: reduced.of_features(one, projections) for one, projections in reduced.fit(every, settings)}


@dataclass(frozen=True, eq=False)
class _Reduced:
    """Grasps in the widest directions of each tower's features, and their objects (n,)."""

    touch: ReducedFeatures
    photo: ReducedFeatures
    owner: Numbers

    @classmethod
    def of(cls, features: Features, widths: TowerWidths, settings: Sequence[CcaSettings]) -> Self:
        limit = max(one.directions for one in settings)
        touch = ReducedFeatures.of(touch_rows(features), widths.touch, limit, towers=widths.touch_towers)
        return cls(touch, ReducedFeatures.of(features.photo, widths.photo, limit), features.owner)

    def items(self, settings: CcaSettings) -> tuple[Matrix, Matrix]:
        """Return the reduced touches (n, k) and photos (n, k')."""
        touch = self.touch.items(settings.directions, last_tower=settings.last_tower)
        return touch, self.photo.items(settings.directions)

    def fit(self, rows: Numbers, settings: Sequence[CcaSettings]) -> Iterator[tuple[CcaSettings, CcaProjections]]:
        """Yield the projections of reduced items, fitted on the given rows, for each of the settings."""
        for _, some in groupby(sorted(settings, key=_reduction), _reduction):
            alike = sorted(some)
            items = [part[rows] for part in self.items(alike[0])]
            means = [part.mean(0) for part in items]
            touch, photo = (_centred_view(part - mean) for part, mean in zip(items, means, strict=True))
            for (ridge, photo_ridge), powers in groupby(alike, lambda one: one[:2]):
                found = canonical_correlations(touch, photo, self.owner[rows], ridge, photo_ridge)
                for one in powers:
                    weights = found.correlations[:COMPONENTS] ** one.power
                    variates = (each[:, :COMPONENTS] * weights for each in (found.touch_weights, found.photo_weights))
                    maps = (AffineMap(each, -mean @ each) for each, mean in zip(variates, means, strict=True))
                    yield one, CcaProjections(*maps)

    def of_features(self, settings: CcaSettings, projections: CcaProjections) -> CcaProjections:
        """Return the projections of features, given those of reduced items."""
        touch = self.touch.map(settings.directions, last_tower=settings.last_tower)
        photo = self.photo.map(settings.directions)
        return CcaProjections(touch.compose(projections.touch), photo.compose(projections.photo))


def _reduction(settings: CcaSettings) -> tuple[int, bool]:
    return settings.directions, settings.last_tower


def _centred_view(x: Matrix) -> CcaView:
    """Decompose centred items without scaling them: their spread is meaningful."""
    unscaled = Standardiser(np.arange(x.shape[1]), np.zeros(x.shape[1]), np.ones(x.shape[1]))
    return decompose(x, MAX_DIRECTIONS, unscaled)


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
    held_out_touches: list[ScoredTouches]


def select_settings(
    features: Features,
    widths: TowerWidths,
    folds: Sequence[Sequence[str]],
    settings: Sequence[CcaSettings] | None = None,
) -> CcaSelection:
    """Choose the settings that rank photos of held-out objects best; among ties, the largest.

    Only the reduction to the widest directions also sees the held-out grasps, but no object ids.

    Args:
        features: Features of grasps.
        widths: Feature widths of the concatenated towers.
        folds: Objects of `features` that are held out together; the fit uses the others.
        settings: The settings to choose from. Default: `GRID`, and with several touch towers the same for the last one.
    """
    if settings is None:
        settings = GRID if widths.touch_towers == 1 else (*GRID, *(one._replace(last_tower=True) for one in GRID))
    reduced = _Reduced.of(features, widths, settings)
    items = {_reduction(one): reduced.items(one) for one in settings}
    found: dict[CcaSettings, list[tuple[float, CcaProjections]]] = {one: [] for one in settings}
    rows_of = [np.flatnonzero(np.isin(features.object_ids, fold)) for fold in folds]
    for rows in rows_of:
        held_out = features.select(rows)
        some = validation_rows(held_out, MAX_CHOICE_TOUCHES)
        owner, places = held_out.select(some).owner, rows[some]
        others = np.setdiff1d(np.arange(len(features)), rows)
        for one, projections in reduced.fit(others, settings):
            touch, photo = items[_reduction(one)]
            found[one].append((ranking_auc(projections.cosines(touch[places], photo[places]), owner), projections))
    aucs = {one: float(np.mean([auc for auc, _ in each])) for one, each in found.items()}
    best = max(aucs, key=lambda one: (aucs[one], one))
    touch, photo = items[_reduction(best)]
    parts = [
        held_out_touches(features.select(rows), projections, touch[rows], photo[rows])
        for rows, (_, projections) in zip(rows_of, found[best], strict=True)
    ]
    projections = dict(reduced.fit(np.arange(len(features)), [best]))[best]
    return CcaSelection(best, aucs[best], reduced.of_features(best, projections), parts)


def held_out_touches(
    features: Features, projections: CcaProjections, touch: NDArray[np.floating], photo: NDArray[np.floating]
) -> ScoredTouches:
    """Return touches of objects that the projections were fitted without, for the calibrations.

    Args:
        features: The grasps. Of each object at most `MAX_CALIBRATION_TOUCHES` are used, evenly spaced.
        projections: The maps.
        touch: (n, k) reduced touches.
        photo: (n, k') reduced photos.
    """
    rows = validation_rows(features, MAX_CALIBRATION_TOUCHES * len(set(features.object_ids)))
    owner, own = features.owner[rows], np.eye(len(rows), dtype=np.bool_)
    embeddings = unit_rows(projections.touch(touch[rows])), unit_rows(projections.photo(photo[rows]))
    return ScoredTouches(projections.cosines(touch[rows], photo[rows]), owner, owner, own, *embeddings)


def touch_rows(features: Features) -> Rows:
    """Return touch features (n, fingers * F)."""
    return features.touch.reshape(len(features), -1)


def tower_widths(config: Config, features: Features) -> TowerWidths:
    """Return the feature widths of each tower of `config`, of a touch and of a photo.

    Raises:
        BadInput: The features are not from these towers.
    """
    with torch.device("meta"):
        matcher = Matcher(config.matcher)
    towers = [part.feature_count for part in matcher.touch_tower.backbones]
    touch_view = towers * features.touch.shape[1]
    photo_view = [part.feature_count for part in matcher.photo_tower.backbones] * len(config.preprocessing.views)
    expected, got = (sum(touch_view), sum(photo_view)), (touch_rows(features).shape[1], features.photo.shape[1])
    if expected != got:
        raise BadInput(
            f"features must be those of the towers {config.matcher.tower} ({config.matcher.tower_output}), "
            f"{expected[0]} of a touch and {expected[1]} of a photo; got {got[0]} and {got[1]}; use these towers"
        )
    return TowerWidths(touch_view, photo_view, len(towers))
