"""Canonical correlation, whitening, standardising and cosines of degenerate features."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.training.cca import CanonicalCorrelations, Standardiser, canonical_correlations, decompose, unit_rows
from tests.hard_case import HardCase, error_of

Matrix = NDArray[np.float64]
_CCA, _COSINE = "CCA", "cosine"


def hard_cases() -> Iterator[HardCase]:
    """Cases of the linear methods."""
    yield _fewer_items_than_features()
    yield _duplicates_and_constants()
    yield _every_scale()
    yield _more_components_than_rank()
    yield _nan_feature()
    yield _narrow_direction()
    yield _constant_feature()
    yield _far_feature()
    yield _cosine_of_zero()
    yield from _cosine_of_extremes()


def _views(count: int, features: int, seed: int = 11) -> tuple[Matrix, Matrix]:
    """Return two views of `count` items with three common factors."""
    rng = np.random.default_rng([seed])
    factors = rng.normal(size=(count, 3))
    touch, photo = (factors @ rng.normal(size=(3, features)) + rng.normal(size=(count, features)) for _ in range(2))
    return touch, photo


def naive_correlations(touch: Matrix, photo: Matrix) -> Matrix:
    """Return the textbook canonical correlations: roots of the eigenvalues of Cxx^-1 Cxy Cyy^-1 Cyx."""
    x, y = touch - touch.mean(0), photo - photo.mean(0)
    cross = x.T @ y
    product = np.linalg.inv(x.T @ x) @ cross @ np.linalg.inv(y.T @ y) @ cross.T
    return np.asarray(np.sort(np.sqrt(np.linalg.eigvals(product).real))[::-1])


def _correlations(touch: Matrix, photo: Matrix) -> CanonicalCorrelations:
    return canonical_correlations(decompose(touch), decompose(photo), np.arange(len(touch)))


def _tried(work: Callable[[], Matrix]) -> Matrix:
    """Return the result of a naive formula; NaN where it raised."""
    try:
        return work()
    except np.linalg.LinAlgError:
        return np.full(1, np.nan)


def _text(values: Matrix) -> str:
    """Return the first three numbers as text."""
    return ", ".join(f"{value:.6g}" for value in values[:3])


# Canonical correlation ---------------------------------------------------------------------------------------


def _in_bounds(found: Matrix) -> bool:
    return bool((np.abs(found - 0.5) <= 0.5 + 1e-9).all())


def _fewer_items_than_features() -> HardCase:
    """Thirty items, fifty features: Cxx has no inverse."""
    views = _views(30, 50)
    naive, found = _tried(lambda: naive_correlations(*views)), _correlations(*views)
    holds = _in_bounds(found.correlations) and bool(np.isfinite(found.touch_weights).all())
    expected = "correlations within 0..1, finite weights"
    return HardCase(
        _CCA, "30 items, 50 features", expected, _text(naive), _text(found.correlations), holds, _in_bounds(naive)
    )


def _duplicates_and_constants() -> HardCase:
    """A duplicate feature, a near duplicate and a constant one must change nothing."""
    touch, photo = _views(200, 4)
    must = _correlations(touch, photo).correlations
    near = touch[:, :1] * (1 + 1e-9 * np.sign(touch[:, 1:2]))
    wide = np.concatenate([touch, touch[:, :1], near, np.full((200, 1), 7.0)], axis=1)
    naive, ours = _tried(lambda: naive_correlations(wide, photo)), _correlations(wide, photo).correlations
    correct = [bool(np.allclose(found[:3], must[:3], rtol=1e-6)) for found in (naive, ours)]
    case = "columns that are equal, nearly equal, constant"
    return HardCase(_CCA, case, f"{_text(must)}, as without", _text(naive), _text(ours), correct[1], correct[0])


def _every_scale() -> HardCase:
    """Units of features must not matter; X'X squares their range beyond float32."""
    touch, photo = _views(200, 6)
    must = _correlations(touch, photo).correlations
    scaled = touch * 10.0 ** np.linspace(-6, 6, 6)
    naive = _tried(lambda: _by_eigenvectors(scaled, photo))
    ours = _correlations(scaled, photo).correlations
    correct = [bool(np.allclose(found[:3], must[:3], rtol=1e-6)) for found in (naive, ours)]
    expected = f"{_text(must)}, as unscaled"
    return HardCase(
        _CCA, "features in units of 1e-6 to 1e6", expected, _text(naive), _text(ours), correct[1], correct[0]
    )


def _by_eigenvectors(touch: Matrix, photo: Matrix) -> Matrix:
    """Return canonical correlations from whitening by the eigenvectors of X'X, in the features' float32."""
    x, y = (whitened_by_eigenvectors((one - one.mean(0)).astype(np.float32)) for one in (touch, photo))
    return np.asarray(np.linalg.svd(x.T @ y)[1], np.float64)


def whitened_by_eigenvectors(x: NDArray[Any]) -> NDArray[Any]:
    """Return centred x (n, F) at unit covariance by (X'X)^-1/2; rounding of large eigenvalues hides the small ones."""
    values, vectors = np.linalg.eigh(x.T @ x)
    return np.asarray(x @ vectors / np.sqrt(values))


def _more_components_than_rank() -> HardCase:
    """Ten features of rank three: there are three correlations; dividing by the other deviations gives noise."""
    rng = np.random.default_rng([12])
    factors, photo = rng.normal(size=(100, 3)), rng.normal(size=(100, 10))
    touch = factors @ rng.normal(size=(3, 10))
    naive = _tried(lambda: naive_correlations(touch, photo))
    found = _correlations(touch, photo).correlations
    holds = len(found) == 3 and _in_bounds(found)
    expected = "3 correlations within 0..1"
    words, ours = f"{len(naive)}: {_text(naive)}", f"{len(found)}: {_text(found)}"
    naive_holds = len(naive) == 3 and _in_bounds(naive)
    return HardCase(_CCA, "10 components of rank 3", expected, words, ours, holds, naive_holds)


def _nan_feature() -> HardCase:
    touch, photo = _views(20, 4)
    touch[3, 1] = np.nan
    naive = _tried(lambda: naive_correlations(touch, photo))
    ours, holds = error_of(lambda: decompose(touch), "NaN")
    return HardCase(_CCA, "one feature is NaN", "refused", _text(naive), ours, holds, bool(np.isfinite(naive).all()))


# Whitening and standardising ---------------------------------------------------------------------------------


def _narrow_direction() -> HardCase:
    """Deviations of 1 to 1e-6 are all 1 after whitening. The covariance squares their ratio."""
    rng = np.random.default_rng([14])
    turn = np.linalg.qr(rng.normal(size=(5, 5)))[0]
    x = (rng.normal(size=(400, 5)) * [1, 1, 1e-2, 1e-4, 1e-6]) @ turn
    # With unit deviation in every feature, standardising changes only the mean.
    x = (x - x.mean(0)) / x.std(0)
    view = decompose(x)
    found = (whitened_by_eigenvectors(x), view.left / view.regularised_deviations(0.0) * view.singular)
    error = [float(np.abs(one.T @ one - np.eye(5) * (one.T @ one)[0, 0]).max() / (one.T @ one)[0, 0]) for one in found]
    naive, ours = (f"off by {value:.1e}" for value in error)
    expected = "covariance 1 to 1e-9"
    return HardCase("whitening", "deviations of 1 to 1e-6", expected, naive, ours, error[1] < 1e-9, error[0] < 1e-9)


def _constant_feature() -> HardCase:
    """A dead unit of a network: 0.1 for every item, except the last digit."""
    x = np.random.default_rng([15]).normal(size=(50, 2)).astype(np.float32)
    x[:, 1] = np.float32(0.1) * (1 + np.float32(6e-8) * (np.arange(50) % 2))
    naive = float(np.abs((x - x.mean(0)) / x.std(0)).max(0)[1])
    columns, case = Standardiser.fit(x).columns.tolist(), "a feature of 0.1 + rounding"
    words, ours = f"its last digit amplified to {naive:.3g} deviations", f"columns {columns}"
    return HardCase("standardising", case, "dropped", words, ours, columns == [0], naive < 1e-3)


def _far_feature() -> HardCase:
    """10,000 +- 0.1: the mean of squares minus the square of the mean cancels in float32."""
    x = (1e4 + 0.1 * np.random.default_rng([16]).normal(size=(400, 1))).astype(np.float32)
    naive = float(np.sqrt((x * x).mean() - x.mean() ** 2))
    ours, must = float(Standardiser.fit(x).scale[0]), float(x.astype(np.float64).std())
    words = [f"{value:.6g}" for value in (must, naive, ours)]
    correct = [abs(value - must) < 1e-6 * must for value in (ours, naive)]
    return HardCase("standardising", "a feature of 10000 +- 0.1", *words, *correct)


# Cosine ------------------------------------------------------------------------------------------------------


def _naive_cosine(x: NDArray[np.float32]) -> float:
    unit = x / np.sqrt((x * x).sum(axis=1, keepdims=True))
    return float((unit @ unit.T)[0, 1])


def _cosine_of_zero() -> HardCase:
    x = np.array([[0.0, 0.0], [1.0, 0.0]])
    naive, unit = _naive_cosine(x.astype(np.float32)), unit_rows(x)
    ours = float((unit @ unit.T)[0, 1])
    return HardCase(_COSINE, "with an encoding of zeros", "0", f"{naive}", f"{ours}", ours == 0, naive == 0)


def _cosine_of_extremes() -> Iterator[HardCase]:
    """Two equal vectors of float32's largest and smallest numbers: cosine 1."""
    for size in (3e38, 1e-30, 1e-42):
        x = np.full((2, 2), size, np.float32)
        unit, naive = unit_rows(x.astype(np.float64)), _naive_cosine(x)
        ours = float((unit @ unit.T)[0, 1])
        near = [abs(value - 1) < 1e-6 for value in (naive, ours)]
        yield HardCase(_COSINE, f"components of {size:g}", "1", f"{naive:g}", f"{ours:g}", near[1], near[0])
