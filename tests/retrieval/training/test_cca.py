"""Canonical correlations against closed forms and plain loops; ill-conditioned features are in hard_linear.py."""

import numpy as np
import pytest
import scipy.linalg

from retrieval.errors import BadInput
from retrieval.training.cca import CanonicalCorrelations, Standardiser, canonical_correlations, decompose


def linked(rhos, n=200, touch=12, photo=10, seed=0):
    """Return two views whose sample canonical correlations are exactly `rhos` and 0: mixed orthogonal columns."""
    rng = np.random.default_rng(seed)
    columns = np.column_stack([np.ones(n), rng.standard_normal((n, touch + photo))])
    basis = np.linalg.qr(columns)[0][:, 1:] * np.sqrt(n)
    first, second = basis[:, :touch], basis[:, touch:].copy()
    rhos = np.asarray(rhos)
    second[:, : len(rhos)] = rhos * first[:, : len(rhos)] + np.sqrt(1 - rhos**2) * second[:, : len(rhos)]
    return first @ rng.standard_normal((touch, touch)), second @ rng.standard_normal((photo, photo))


def paired(x, y, ridge=0.0) -> CanonicalCorrelations:
    return canonical_correlations(decompose(x), decompose(y), np.arange(len(x)), ridge)


def test_planted_correlations_are_recovered():
    rhos = [0.95, 0.9, 0.8, 0.3]
    x, y = linked(rhos)
    found = paired(x, y)
    np.testing.assert_allclose(found.correlations[:4], rhos, atol=1e-6)
    np.testing.assert_allclose(found.correlations[4:], 0, atol=1e-6)
    a, b = Standardiser.fit(x)(x) @ found.touch_weights, Standardiser.fit(y)(y) @ found.photo_weights
    np.testing.assert_allclose([np.corrcoef(a[:, i], b[:, i])[0, 1] for i in range(4)], rhos, atol=1e-6)
    np.testing.assert_allclose(a.T @ a / len(a), np.eye(10), atol=1e-6)  # uncorrelated, variance 1


@pytest.mark.parametrize("ridges", [(0.0, 0.0), (0.5, 0.1)])
def test_the_correlations_solve_the_eigenproblem_of_the_covariances_over_every_pair_of_an_object(ridges):
    """Objects with 1 to 6 grasps; each pair of an object with m grasps has weight 1 / m."""
    rng = np.random.default_rng(5)
    owner = np.repeat(np.arange(9), [1, 2, 3, 6, 4, 4, 2, 5, 6])[rng.permutation(33)]
    latent = rng.standard_normal((9, 3))[owner]
    x, y = (latent @ rng.standard_normal((3, d)) + rng.standard_normal((33, d)) for d in (4, 5))
    found = canonical_correlations(decompose(x), decompose(y), owner, *ridges)
    x, y = Standardiser.fit(x)(x), Standardiser.fit(y)(y)
    cross, touch_own, photo_own = np.zeros((4, 5)), np.zeros((4, 4)), np.zeros((5, 5))
    for i in range(33):
        for j in range(33):
            if owner[i] == owner[j]:
                weight = 1 / np.sum(owner == owner[i]) / 33
                cross += weight * np.outer(x[i], y[j])
                touch_own += weight * np.outer(x[i], x[i])
                photo_own += weight * np.outer(y[j], y[j])
    roots = [
        np.linalg.inv(scipy.linalg.sqrtm(own + ridge * np.eye(len(own))))
        for own, ridge in zip((touch_own, photo_own), ridges, strict=True)
    ]
    expected = np.linalg.svd(roots[0] @ cross @ roots[1])[1]
    np.testing.assert_allclose(found.correlations, expected, atol=1e-9)


def test_a_constant_view_is_refused():
    with pytest.raises(BadInput, match="all 4 are constant over 50"):
        decompose(np.ones((50, 4)))


def test_if_the_fast_decomposition_fails_the_slow_one_is_used(monkeypatch):
    x, y = linked([0.95, 0.9, 0.8])
    expected = paired(x, y).correlations

    def failing(*args, **options):
        raise np.linalg.LinAlgError("SVD did not converge")

    monkeypatch.setattr(np.linalg, "svd", failing)
    np.testing.assert_allclose(paired(x, y).correlations, expected, atol=1e-12)
