"""Canonical correlation analysis (Hotelling, Biometrika 1936) for retrieval.

Three additions make it a strong baseline: a ridge (with fewer grasps than features the plain method fits any noise with
correlation 1), dimensions weighted by rho^p (Gong et al., IJCV 2014: a plain cosine would give noise dimensions full
weight), and settings chosen by ranking on validation objects. The fit is in float64, from the singular value
decomposition of the centred data. Only `leading_svd` uses X'X, which squares the condition number.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from retrieval.errors import BadInput, NumericalError
from retrieval.methods.method import Array, Method
from retrieval.methods.selection import Validator
from retrieval.methods.standardise import Standardiser

if TYPE_CHECKING:
    from retrieval.training.features import Features

Matrix = NDArray[np.float64]

RANK_CUT = 1e-7
"""Directions below this fraction of the widest one are rounding errors of float32 features."""
LEADING_CUT = 1e-6
"""The same for singular values from a squared matrix."""
MAX_ROWS, MAX_DIRECTIONS = 2048, 512
"""With more than MAX_ROWS items, only MAX_DIRECTIONS are used: all would take minutes, and a ridge damps the others."""
RIDGES = (1e-3, 1e-2, 1e-1, 1e0, 1e1, 1e2)
COMPONENTS = (8, 16, 32, 64, 128, 256)
POWERS = (0, 1, 2, 4)


@dataclass(frozen=True, eq=False)
class CcaView:
    """One modality of n items, standardised and decomposed: `left * singular @ right` of rank r.

    Attributes:
        standardise: The standardisation of the features.
        left: (n, r) left singular vectors.
        singular: (r,) singular values, descending.
        right: (r, F') right singular vectors.
    """

    standardise: Standardiser
    left: Matrix
    singular: Matrix
    right: Matrix

    @property
    def rank(self) -> int:
        """Number of directions in which the items vary."""
        return len(self.singular)

    def regularised_deviations(self, ridge: float) -> Matrix:
        """Return standard deviations (r,) after a ridge of `ridge` times the mean variance of the features."""
        variance = self.singular**2 / len(self.left)
        return np.asarray(np.sqrt(variance + ridge * variance.sum() / self.right.shape[1]))


@dataclass(frozen=True, eq=False)
class CanonicalCorrelations:
    """Result of a canonical correlation analysis.

    In each column the weight of largest absolute value, touch or photo, is positive.

    Attributes:
        correlations: (k,) within 0..1, descending.
        touch_weights: (F', k) from standardised features to variates.
        photo_weights: (F', k) the same for photos.
    """

    correlations: Matrix
    touch_weights: Matrix
    photo_weights: Matrix


def decompose(x: NDArray[Any], max_directions: int | None = None) -> CcaView:
    """Standardise and decompose items.

    Args:
        x: (n, ...) items.
        max_directions: Number of the widest directions to keep; None for all.

    Raises:
        NumericalError: A feature is not finite.
        BadInput: No feature varies.
    """
    if not np.isfinite(x).all():
        raise NumericalError("features must be finite for a correlation; got a NaN or infinite one")
    return decompose_standardised(x, Standardiser.fit(x), max_directions)


def decompose_standardised(x: NDArray[Any], standardise: Standardiser, max_directions: int | None = None) -> CcaView:
    """Decompose finite items with a given standardisation, as `decompose` does.

    Equal items, such as a photo of several grasps, are decomposed once, weighted by their number.
    """
    first, place, counts = _distinct(x)
    weight = np.sqrt(counts)[:, None]
    scaled = standardise(x[first]) * weight
    exact = max_directions is None and len(x) <= MAX_ROWS
    left, singular, right = svd(scaled) if exact else leading_svd(scaled, max_directions or MAX_DIRECTIONS)
    rank = int((singular > (RANK_CUT if exact else LEADING_CUT) * singular[0]).sum())
    rank = min(rank, max_directions or len(singular))
    return CcaView(standardise, (left[:, :rank] / weight)[place], singular[:rank], right[:rank])


def _distinct(x: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the first row of each distinct item, the index of every item among these, and their counts."""
    index_of: dict[bytes, int] = {}
    place = np.array([index_of.setdefault(row.tobytes(), len(index_of)) for row in np.ascontiguousarray(x)])
    first = np.unique(place, return_index=True)[1]
    return first, place, np.bincount(place)


def canonical_correlations(
    touch: CcaView, photo: CcaView, owner: NDArray[np.int64], ridge: float = 0.0, photo_ridge: float | None = None
) -> CanonicalCorrelations:
    """Return the canonical correlations of touches with photos, each touch paired with every photo of its object.

    A pair of an object with m grasps has weight 1/m, so every grasp has the same total weight. Pairing is the block
    average B = E'E, E (objects, n) with 1/sqrt(m) at an object's grasps: the cross-covariance X'BY needs only object
    means, and its rank is below the number of objects. Its whitened form is factored by QR of both sides.

    Args:
        touch: Decomposed touches.
        photo: Decomposed photos.
        owner: (n,) object of each row, from 0; `arange(n)` pairs row with row.
        ridge: Ridge, as a fraction of the mean variance.
        photo_ridge: Ridge of the photos, if it differs from that of the touches.

    Raises:
        BadInput: A ridge is negative, or the numbers of rows differ.
    """
    photo_ridge = ridge if photo_ridge is None else photo_ridge
    if min(ridge, photo_ridge) < 0 or not len(touch.left) == len(photo.left) == len(owner):
        raise BadInput(
            "canonical correlations need a ridge of at least 0 and one owner per row; got ridge "
            f"{min(ridge, photo_ridge)}, {len(touch.left)} touches, {len(photo.left)} photos and {len(owner)} owners"
        )
    touch_q, touch_r = np.linalg.qr(_whitened_means(touch, owner, ridge))
    photo_q, photo_r = np.linalg.qr(_whitened_means(photo, owner, photo_ridge))
    left, rho, right = svd(touch_r @ photo_r.T)
    count = min(len(rho), len(np.unique(owner)) - 1)  # the means of centred data have one dimension less
    weights = (
        touch.right.T @ ((touch_q @ left)[:, :count] / touch.regularised_deviations(ridge)[:, None]),
        photo.right.T @ ((photo_q @ right.T)[:, :count] / photo.regularised_deviations(photo_ridge)[:, None]),
    )
    signs = _signs(np.concatenate(weights))
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


def _signs(weights: Matrix) -> Matrix:
    largest = np.abs(weights).argmax(0)
    return np.where(weights[largest, np.arange(weights.shape[1])] < 0, -1.0, 1.0)


def unit_rows(x: Matrix) -> Array:
    """Return the rows at norm 1, float32; a row of zeros stays zero."""
    norms = np.linalg.norm(x, axis=1, keepdims=True)
    return np.asarray(x / np.where(norms > 0, norms, 1.0), dtype=np.float32)


def cosine(touch_encodings: Array, photo_encodings: Array) -> Array:
    """Return cosines (T, N) of unit encodings."""
    return touch_encodings @ photo_encodings.T


class Cca(Method):
    """Cosine of canonical variates weighted by rho^p; ranking on validation objects chooses ridge, components and p.

    A subclass may set `max_directions`: then only that many principal components of touch and of photo are used. A few
    dozen objects do not determine which of a thousand features correlate across touch and photo. The ridge damps the
    narrow directions; principal components drop them, which is faster.
    """

    is_seeded = False
    max_directions: ClassVar[int | None] = None

    def _fit(self, train: "Features", validation: "Features") -> None:
        touch, photo = (decompose(part, self.max_directions) for part in (train.touch, train.photo))
        self._standardise = touch.standardise, photo.standardise
        # The decompositions are made once; a ridge only damps them.
        found = {ridge: canonical_correlations(touch, photo, train.owner, ridge) for ridge in RIDGES}
        validator = Validator.of(validation)
        cells = {
            (ridge, *cell): auc for ridge, one in found.items() for cell, auc in self._cells(one, validator).items()
        }
        ridge, components, power = choice = max(cells, key=cells.__getitem__)
        correlations = found[ridge]
        if self.settings.fit_on_validation:
            known = train.concatenate(validation)
            touch, photo = (decompose(part, self.max_directions) for part in (known.touch, known.photo))
            self._standardise = touch.standardise, photo.standardise
            correlations = canonical_correlations(touch, photo, known.owner, ridge)
        weights = correlations.correlations[:components] ** power
        self._maps = tuple(
            each[:, :components] * weights for each in (correlations.touch_weights, correlations.photo_weights)
        )
        self.best_params = {
            "ridge": ridge,
            "components": components,
            "max_components": len(correlations.correlations),
            "power": power,
            "validation_auc": cells[choice],
            "rank": {"touch": touch.rank, "photo": photo.rank},
        }

    def _cells(self, found: CanonicalCorrelations, validator: Validator) -> dict[tuple[int, int], float]:
        """Return the AUC on validation objects of each number of components and power."""
        touch = self._standardise[0](validator.features.touch) @ found.touch_weights
        photo = self._standardise[1](validator.features.photo) @ found.photo_weights
        limit, aucs = len(found.correlations), {}
        for components in sorted({min(count, limit) for count in COMPONENTS}):
            for power in POWERS:
                weights = found.correlations[:components] ** power
                encodings = unit_rows(touch[:, :components] * weights), unit_rows(photo[:, :components] * weights)
                aucs[components, power] = validator.touch_auc(cosine(*encodings))
        return aucs

    def _encode_touch(self, touch: Array) -> Array:
        return unit_rows(self._standardise[0](touch) @ self._maps[0])

    def _encode_photo(self, photo: Array) -> Array:
        return unit_rows(self._standardise[1](photo) @ self._maps[1])

    def _score(self, touch_encodings: Array, photo_encodings: Array) -> Array:
        return cosine(touch_encodings, photo_encodings)
