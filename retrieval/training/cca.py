"""Canonical correlation analysis (Hotelling, Biometrika 1936) of the features of touches and photos.

A ridge makes it a strong baseline: with fewer grasps than features the plain analysis fits noise with correlation 1.
The fit is in float64, from the singular value decomposition of the centred data. Only `leading_svd` uses X'X, which
squares the condition number.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from retrieval.errors import BadInput, NumericalError

Array = NDArray[np.float32]
Matrix = NDArray[np.float64]

RANK_CUT = 1e-7
"""Directions below this fraction of the widest one are rounding errors of float32 features."""
LEADING_CUT = 1e-6
"""The same for singular values from a squared matrix."""
MAX_ROWS, MAX_DIRECTIONS = 2048, 512
"""With more than MAX_ROWS items, only MAX_DIRECTIONS are used: all would take minutes, and a ridge damps the others."""
MIN_RELATIVE_SPREAD = 1e-6
"""Features whose spread is below this fraction of their size are constant in float32, and dropped."""


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
    x = np.asarray(x)
    return np.asarray(x.reshape(len(x), int(np.prod(x.shape[1:]))), dtype=np.float64)


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


def leading_svd(x: Matrix, max_directions: int = MAX_DIRECTIONS) -> tuple[Matrix, Matrix, Matrix]:
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
