"""Canonical correlations: the solver."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff
from retrieval.frontier.sample import Sample
from retrieval.training.cca import canonical_correlations, decompose

Matrix = NDArray[np.float64]
Solver = Callable[["CcaProblem"], Matrix]
OURS = "SVD of the data, float64 (ours)"


@dataclass(frozen=True, eq=False)
class CcaProblem:
    """Two views (n, d) with known canonical correlations: mixed sources, `rho` (d,) decreasing."""

    x: Matrix
    y: Matrix
    rho: Matrix


def known_problem(rows: int, width: int, spread: float, seed: int = 0) -> CcaProblem:
    """Mix orthonormal sources U and V with U'V = diag(rho) by matrices whose singular values span `spread`."""
    rng = np.random.default_rng([seed, 3])
    drawn = rng.normal(size=(rows, 2 * width))
    sources = np.linalg.qr(drawn - drawn.mean(0))[0]
    rho = np.linspace(0.95, 0.05, width)
    left = sources[:, :width]
    right = left * rho + sources[:, width:] * np.sqrt(1 - rho**2)
    return CcaProblem(left @ _mixing(width, spread, rng), right @ _mixing(width, spread, rng), rho)


def _mixing(width: int, spread: float, rng: np.random.Generator) -> Matrix:
    turns = [np.linalg.qr(rng.normal(size=(width, width)))[0] for _ in range(2)]
    return np.asarray(turns[0] * np.geomspace(1.0, 1.0 / spread, width) @ turns[1])


def cca_solver(sample: Sample) -> ApproximationResult:
    """Compare our solver with the textbook's and scikit-learn's on a problem with a known answer."""
    size = (200, 12) if sample.scale.quick else (2000, 64)
    problem = known_problem(*size, spread=1e6)
    solvers: dict[str, Solver] = {
        OURS: _by_svd,
        "eigenvalues of X'X, float64": partial(_by_covariance, np.float64),
        "eigenvalues of X'X, float32": partial(_by_covariance, np.float32),
        "scikit-learn's NIPALS, first 8": _by_sklearn,
    }
    points = time_points(
        [_point(problem, name, solve) for name, solve in solvers.items()],
        [partial(solve, problem) for solve in solvers.values()],
        sample.scale.repeats,
    )
    panel = Panel(
        title=f"canonical correlations, {size[0]:,} pairs of {size[1]} features, condition number 1e6",
        time="fitting, one thread",
        unit="largest error of a correlation",
        reference="correlations known by construction",
        tolerance=1e-6,
        points=points,
    )
    return ApproximationResult(
        "CCA: solver",
        "X'X squares the condition number of the data; the singular value decomposition of X does not. scikit-learn's "
        "CCA iterates one component after the other (NIPALS); only its first eight are computed here.",
        (panel,),
    )


def _point(problem: CcaProblem, name: str, solve: Solver) -> Tradeoff:
    found = solve(problem)
    return Tradeoff(name, "", float(np.abs(found - problem.rho[: len(found)]).max()), is_default=name == OURS)


def _by_svd(problem: CcaProblem) -> Matrix:
    views = decompose(problem.x), decompose(problem.y)
    return _padded(canonical_correlations(*views, np.arange(len(problem.x))).correlations, len(problem.rho))


def _by_covariance(kind: type[np.floating], problem: CcaProblem) -> Matrix:
    """Whiten with eigenvalues of the covariance, as in textbooks; used only for this comparison."""
    x, y = (one.astype(kind) - one.astype(kind).mean(0) for one in (problem.x, problem.y))
    whitened = [one @ _root(one.T @ one) for one in (x, y)]
    found = np.linalg.svd(whitened[0].T @ whitened[1], compute_uv=False)
    return _padded(np.asarray(found, dtype=np.float64), len(problem.rho))


def _root(covariance: NDArray[np.floating]) -> NDArray[np.floating]:
    values, vectors = np.linalg.eigh(covariance)
    nonzero = values > np.finfo(values.dtype).eps * values[-1]
    return np.asarray(vectors[:, nonzero] / np.sqrt(values[nonzero]))


def _padded(found: Matrix, count: int) -> Matrix:
    """Count a correlation that was not found as 0; one above 1 stays wrong."""
    return np.pad(found[:count], (0, max(0, count - len(found))))


def _by_sklearn(problem: CcaProblem) -> Matrix:
    """Return its first eight components only, because each takes seconds."""
    from sklearn.cross_decomposition import CCA

    found = CCA(n_components=8, max_iter=5000).fit_transform(problem.x, problem.y)
    return np.array([abs(np.corrcoef(a, b)[0, 1]) for a, b in zip(found[0].T, found[1].T, strict=True)])
