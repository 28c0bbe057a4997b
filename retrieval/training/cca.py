"""Canonical correlation analysis (Hotelling, Biometrika 1936) of the features of touches and photos.

A ridge makes it a strong baseline: with fewer grasps than features the plain analysis fits noise with correlation 1.
The fit is in float64, from the singular value decomposition of the centred data. Only `leading_svd` uses X'X, which
squares the condition number.

For few objects and concatenated towers (`retrieve train`), the features of each tower are first reduced to their widest
directions, with equal weight for every tower. The maps of each modality compose to one affine map, so the result is
stored as the projections of an ordinary matcher. Settings are chosen from `GRID` on held-out training objects
(`select_settings`), never on test objects.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, product
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import torch
from numpy.typing import NDArray

from retrieval.errors import BadInput, NumericalError
from retrieval.model.config import Config
from retrieval.model.fusion import Matcher
from retrieval.training.calibration.scores import ScoredTouches
from retrieval.training.features import Features
from retrieval.training.selection import ranking_auc, validation_rows

Array = NDArray[np.float32]
Matrix = NDArray[np.float64]
Numbers = NDArray[np.int64]

RANK_CUT = 1e-7
"""Directions below this fraction of the widest one are rounding errors of float32 features."""
LEADING_CUT = 1e-6
"""The same for singular values from a squared matrix."""
MAX_ROWS, MAX_DIRECTIONS = 2048, 512
"""With more than MAX_ROWS items, only MAX_DIRECTIONS are used: all would take minutes, and a ridge damps the others."""
MIN_RELATIVE_SPREAD = 1e-6
"""Features whose spread is below this fraction of their size are constant in float32, and dropped."""
COMPONENTS = 64
"""Largest number of canonical variates of concatenated towers."""
MAX_CHOICE_TOUCHES = 240
"""Touches of a fold with which settings are chosen."""
MAX_CALIBRATION_TOUCHES = 60
"""Touches per object with which the calibrations are fitted."""


@dataclass(frozen=True, eq=False)
class Standardiser:
    """`(x - mean) / scale` of the features that vary: their indices, means and standard deviations, (F',) each."""

    columns: NDArray[np.int64]
    mean: NDArray[np.float64]
    scale: NDArray[np.float64]

    @classmethod
    def fit(cls, x: NDArray[Any]) -> "Standardiser":
        """Return the statistics of x (n, ...), flattened to (n, F), in float64. Raises BadInput if all are constant."""
        x = _flat(x)
        mean, scale = x.mean(0), x.std(0)
        columns = np.flatnonzero(scale > MIN_RELATIVE_SPREAD * np.abs(x).max(0))
        if not len(columns):
            raise BadInput(
                f"features must differ between grasps; all {x.shape[1]} are constant over {len(x)}; check images"
            )
        return cls(columns, mean[columns], scale[columns])

    def __call__(self, x: NDArray[Any]) -> NDArray[np.float64]:
        """Return standardised features (n, F') of x (n, ...)."""
        return (_flat(x)[:, self.columns] - self.mean) / self.scale


def _flat(x: NDArray[Any]) -> NDArray[np.float64]:
    return x.reshape(len(x), int(np.prod(x.shape[1:]))).astype(np.float64)


@dataclass(frozen=True, eq=False)
class CcaView:
    """One modality of n items, standardised and decomposed: `left * singular @ right`, shaped (n, r), (r,), (r, F')."""

    standardise: Standardiser
    left: Matrix
    singular: Matrix
    right: Matrix

    def regularised_deviations(self, ridge: float) -> Matrix:
        """Return standard deviations (r,) after a ridge of `ridge` times the mean variance of the features."""
        variance = self.singular**2 / len(self.left)
        return np.asarray(np.sqrt(variance + ridge * variance.sum() / self.right.shape[1]))


@dataclass(frozen=True, eq=False)
class CanonicalCorrelations:
    """Correlations (k,) within 0..1, descending, and weights (F', k) from standardised features to variates.

    In each column the weight of largest absolute value, touch or photo, is positive.
    """

    correlations: Matrix
    touch_weights: Matrix
    photo_weights: Matrix


def decompose(x: NDArray[Any], max_directions: int | None = None, standardise: Standardiser | None = None) -> CcaView:
    """Standardise and decompose items x (n, ...), with their own standardisation by default.

    Equal items, such as a photo of several grasps, are decomposed once, weighted by their number. At most
    `max_directions` of the widest directions are kept.

    Raises:
        NumericalError: A feature is not finite.
        BadInput: No feature varies.
    """
    if not np.isfinite(x).all():
        raise NumericalError("features must be finite for a correlation; got a NaN or infinite one")
    standardise = standardise or Standardiser.fit(x)
    index_of: dict[bytes, int] = {}
    place = np.array([index_of.setdefault(row.tobytes(), len(index_of)) for row in np.ascontiguousarray(x)])
    first, weight = np.unique(place, return_index=True)[1], np.sqrt(np.bincount(place))[:, None]
    scaled = standardise(x[first]) * weight
    exact = max_directions is None and len(x) <= MAX_ROWS
    left, singular, right = svd(scaled) if exact else leading_svd(scaled, max_directions or MAX_DIRECTIONS)
    rank = int((singular > (RANK_CUT if exact else LEADING_CUT) * singular[0]).sum())
    rank = min(rank, max_directions or len(singular))
    return CcaView(standardise, (left[:, :rank] / weight)[place], singular[:rank], right[:rank])


def canonical_correlations(
    touch: CcaView, photo: CcaView, owner: NDArray[np.int64], ridge: float = 0.0, photo_ridge: float | None = None
) -> CanonicalCorrelations:
    """Return the canonical correlations of touches with photos, each touch paired with every photo of its object.

    A pair of an object with m grasps has weight 1/m, so every grasp has the same total weight. Pairing is the block
    average B = E'E, E (objects, n) with 1/sqrt(m) at an object's grasps: the cross-covariance X'BY needs only object
    means, and its rank is below the number of objects. Its whitened form is factored by QR of both sides.

    `owner` (n,) is the object of each row, from 0; `arange(n)` pairs row with row. A ridge is a fraction of the mean
    variance; `photo_ridge` is that of the photos, if it differs from that of the touches.
    """
    photo_ridge = ridge if photo_ridge is None else photo_ridge
    touch_q, touch_r = np.linalg.qr(_whitened_means(touch, owner, ridge))
    photo_q, photo_r = np.linalg.qr(_whitened_means(photo, owner, photo_ridge))
    left, rho, right = svd(touch_r @ photo_r.T)
    count = min(len(rho), len(np.unique(owner)) - 1)  # the means of centred data have one dimension less
    weights = (
        touch.right.T @ ((touch_q @ left)[:, :count] / touch.regularised_deviations(ridge)[:, None]),
        photo.right.T @ ((photo_q @ right.T)[:, :count] / photo.regularised_deviations(photo_ridge)[:, None]),
    )
    both, columns = np.concatenate(weights), np.arange(count)
    signs = np.where(both[np.abs(both).argmax(0), columns] < 0, -1.0, 1.0)
    return CanonicalCorrelations(np.clip(rho[:count], 0.0, 1.0), weights[0] * signs, weights[1] * signs)


def svd(x: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """Return the thin singular value decomposition (left, singular values, right).

    LAPACK's fast driver, gesdd, does not converge on some finite matrices of low rank; its slow one, gesvd, does.
    """
    try:
        left, singular, right = np.linalg.svd(x, full_matrices=False)
    except np.linalg.LinAlgError:
        left, singular, right = scipy.linalg.svd(x, full_matrices=False, lapack_driver="gesvd")
    return left, singular, right


def leading_svd(x: Matrix, max_directions: int) -> tuple[Matrix, Matrix, Matrix]:
    """Return the thin decomposition in the widest directions of many items.

    It uses the eigenvectors of X'X or, if that is smaller, of XX'. The squared condition number affects only the
    narrowest directions, which `LEADING_CUT` removes later.
    """
    width = x.shape[1]
    if len(x) < width:
        right, singular, left = leading_svd(x.T, max_directions)
        return left.T, singular, right.T
    values, vectors = scipy.linalg.eigh(x.T @ x, subset_by_index=(max(width - max_directions, 0), width - 1))
    singular = np.sqrt(np.maximum(values[::-1], (RANK_CUT * RANK_CUT) * values[-1]))
    right = vectors.T[::-1]
    return x @ right.T / singular, singular, right


def _whitened_means(view: CcaView, owner: NDArray[np.int64], ridge: float) -> Matrix:
    """Return the transpose (r, objects) of E times the whitened left vectors."""
    objects, place, counts = np.unique(owner, return_inverse=True, return_counts=True)
    sums = np.eye(len(objects))[:, place] @ view.left
    shrink = view.singular / np.sqrt(len(view.left)) / view.regularised_deviations(ridge)
    return np.asarray((sums / np.sqrt(counts)[:, None] * shrink).T)


def unit_rows(x: Matrix) -> Array:
    """Return the rows at norm 1, float32; a row of zeros stays zero."""
    norms = np.linalg.norm(x, axis=1, keepdims=True)
    return np.asarray(x / np.where(norms > 0, norms, 1.0), dtype=np.float32)


# Concatenated towers ----------------------------------------------------------------------------------------


class TowerWidths(NamedTuple):
    """Feature widths of the touch towers, finger by finger, and of the photo towers, view by view."""

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


class CcaProjections(NamedTuple):
    """Maps from touches and photos to encodings; the cosine is high if both show the same object."""

    touch: AffineMap
    photo: AffineMap

    def cosines(self, touch: NDArray[np.floating], photo: NDArray[np.floating]) -> Array:
        """Return cosines (T, N) of features (T, F) and (N, F')."""
        return unit_rows(self.touch(touch)) @ unit_rows(self.photo(photo)).T


class Modality:
    """One modality of n items, with the features of each of `towers` towers (times fingers) decomposed."""

    def __init__(self, x: Array, widths: Sequence[int], max_directions: int, towers: int = 1) -> None:
        parts = np.split(x, np.cumsum(widths)[:-1], axis=1)
        self.views = [decompose(part, max_directions) for part in parts]
        self.widths, self.towers = widths, towers

    def _used(self, settings: CcaSettings) -> Iterator[tuple[int, CcaView, float]]:
        """Yield place, decomposition and size of each used tower: of all, or of the last one of each finger."""
        for place, view in enumerate(self.views):
            if not settings.last_tower or (place + 1) % self.towers == 0:
                variances = view.singular[: settings.directions] ** 2
                yield place, view, float(np.sqrt(variances.sum() / len(view.left)))

    def items(self, settings: CcaSettings) -> Matrix:
        """Return the items (n, k) in the widest directions of each tower; the variances of each tower add up to 1."""
        columns = slice(settings.directions)
        parts = [view.left[:, columns] * view.singular[columns] / size for _, view, size in self._used(settings)]
        return np.concatenate(parts, axis=1)

    def compose(self, settings: CcaSettings, other: AffineMap) -> AffineMap:
        """Return the map from features to `items`, followed by another, as one map."""
        weight, bias, starts = [], [], np.cumsum([0, *self.widths])
        for place, view, size in self._used(settings):
            part = view.right[: settings.directions].T / view.standardise.scale[:, None] / size
            columns = np.zeros((sum(self.widths), part.shape[1]))
            columns[starts[place] + view.standardise.columns] = part
            weight.append(columns)
            bias.append(-(view.standardise.mean @ part))
        return AffineMap(
            np.concatenate(weight, axis=1) @ other.weight, np.concatenate(bias) @ other.weight + other.bias
        )


class _Reduced:
    """Grasps in the widest directions of each tower's features."""

    def __init__(self, features: Features, widths: TowerWidths, settings: Sequence[CcaSettings]) -> None:
        limit, self.owner = max(one.directions for one in settings), features.owner
        self.touch = Modality(features.touch_rows, widths.touch, limit, widths.touch_towers)
        self.photo = Modality(features.photo, widths.photo, limit)

    def fit(self, rows: Numbers, settings: Sequence[CcaSettings]) -> Iterator[tuple[CcaSettings, CcaProjections]]:
        """Yield the projections of reduced items, fitted on the given rows, for each of the settings."""
        for _, some in groupby(sorted(settings, key=_reduction), _reduction):
            alike = sorted(some)
            items = [part.items(alike[0])[rows] for part in (self.touch, self.photo)]
            means = [part.mean(0) for part in items]
            touch, photo = (_centred_view(part - mean) for part, mean in zip(items, means, strict=True))
            for (ridge, photo_ridge), powers in groupby(alike, lambda one: one[:2]):
                found = canonical_correlations(touch, photo, self.owner[rows], ridge, photo_ridge)
                for one in powers:
                    weights = found.correlations[:COMPONENTS] ** one.power
                    variates = (each[:, :COMPONENTS] * weights for each in (found.touch_weights, found.photo_weights))
                    maps = (AffineMap(each, -mean @ each) for each, mean in zip(variates, means, strict=True))
                    yield one, CcaProjections(*maps)

    def fit_all(self, settings: Sequence[CcaSettings]) -> dict[CcaSettings, CcaProjections]:
        """Return the projections of features, fitted on all grasps, for each of the settings."""
        return {
            one: CcaProjections(self.touch.compose(one, found.touch), self.photo.compose(one, found.photo))
            for one, found in self.fit(np.arange(len(self.owner)), settings)
        }


def _reduction(settings: CcaSettings) -> tuple[int, bool]:
    return settings.directions, settings.last_tower


def _centred_view(x: Matrix) -> CcaView:
    """Decompose centred items without scaling them: their spread is meaningful."""
    unscaled = Standardiser(np.arange(x.shape[1]), np.zeros(x.shape[1]), np.ones(x.shape[1]))
    return decompose(x, MAX_DIRECTIONS, unscaled)


def fit_projections(
    features: Features, widths: TowerWidths, settings: Sequence[CcaSettings] = GRID
) -> dict[CcaSettings, CcaProjections]:
    """Return the projections of grasps for each of the settings; `widths` are those of their towers."""
    return _Reduced(features, widths, settings).fit_all(settings)


@dataclass(frozen=True, eq=False)
class CcaSelection:
    """Settings that were chosen on held-out objects, with their mean AUC over the folds.

    Attributes:
        projections: The maps, fitted to all objects.
        held_out_touches: For each fold, the cosines of its touches with its photos by maps that were fitted without its
            objects, and the encodings of both: the input of the calibrations. Of each object at most
            `MAX_CALIBRATION_TOUCHES` touches, evenly spaced.
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

    Only the reduction to the widest directions also sees the held-out grasps, but no object ids. The objects of each of
    `folds` are held out together. Default settings: `GRID`, and with several touch towers the same for the last one.
    """
    last_tower = (one._replace(last_tower=True) for one in GRID if widths.touch_towers > 1)
    settings = settings or (*GRID, *last_tower)
    reduced = _Reduced(features, widths, settings)
    items = {_reduction(one): (reduced.touch.items(one), reduced.photo.items(one)) for one in settings}
    found: dict[CcaSettings, list[tuple[float, CcaProjections]]] = {one: [] for one in settings}
    rows_of = [np.flatnonzero(np.isin(features.object_ids, fold)) for fold in folds]
    for rows in rows_of:
        places = rows[validation_rows(features.select(rows), MAX_CHOICE_TOUCHES)]
        owner = features.select(places).owner
        others = np.setdiff1d(np.arange(len(features)), rows)
        for one, projections in reduced.fit(others, settings):
            touch, photo = items[_reduction(one)]
            found[one].append((ranking_auc(projections.cosines(touch[places], photo[places]), owner), projections))
    aucs = {one: float(np.mean([auc for auc, _ in each])) for one, each in found.items()}
    best = max(aucs, key=lambda one: (aucs[one], one))
    touch, photo = items[_reduction(best)]
    parts = []
    for rows, (_, projections) in zip(rows_of, found[best], strict=True):
        held_out = features.select(rows)
        some = validation_rows(held_out, MAX_CALIBRATION_TOUCHES * len(set(held_out.object_ids)))
        owner, own, places = held_out.owner[some], np.eye(len(some), dtype=np.bool_), rows[some]
        encodings = unit_rows(projections.touch(touch[places])), unit_rows(projections.photo(photo[places]))
        parts.append(ScoredTouches(encodings[0] @ encodings[1].T, owner, owner, own, *encodings))
    return CcaSelection(best, aucs[best], reduced.fit_all([best])[best], parts)


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
    expected, got = (sum(touch_view), sum(photo_view)), (features.touch_rows.shape[1], features.photo.shape[1])
    if expected != got:
        raise BadInput(
            f"features must be those of the towers {config.matcher.tower} ({config.matcher.tower_output}), "
            f"{expected[0]} of a touch and {expected[1]} of a photo; got {got[0]} and {got[1]}; use these towers"
        )
    return TowerWidths(touch_view, photo_view, len(towers))
