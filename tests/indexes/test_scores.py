"""Scores that do not depend on the order of a sum, compared with naive ones that do."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from indexes.kinds.scores import error_bound, grid_scores, scan, to_grid, top_k


def unit(count: int, dim: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, dim))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def test_a_score_is_the_sum_of_products_by_hand():
    query = np.array([[0.6, 0.8]], np.float32)
    vectors = np.array([[1.0, 0.0], [0.0, 1.0], [-0.6, 0.8]], np.float32)
    scores = grid_scores(to_grid(query), to_grid(vectors))
    np.testing.assert_allclose(scores, [[0.6, 0.8, 0.28]], rtol=0, atol=2**-24)  # one rounding to float32


@pytest.mark.parametrize("dim", [1, 2, 7, 64, 512, 1000])
def test_every_order_of_the_sum_gives_the_same_bits(dim):
    rng = np.random.default_rng(dim)
    query, vectors = unit(1, dim, seed=1), unit(50, dim, seed=2)
    must = grid_scores(to_grid(query), to_grid(vectors))
    for _ in range(5):
        order = rng.permutation(dim)
        assert np.array_equal(must, grid_scores(to_grid(query[:, order]), to_grid(vectors[:, order])))
    one_by_one = [grid_scores(to_grid(query), to_grid(vector[None]))[0, 0] for vector in vectors]
    assert np.array_equal(must[0], one_by_one)


@settings(max_examples=50)
@given(dim=st.integers(1, 600), seed=st.integers(0, 10**6), scale=st.sampled_from([0.999, 1.0, 1.001]))
def test_the_gridded_sum_is_exact_and_near_the_true_one(dim, seed, scale):
    left, right = unit(1, dim, seed)[0] * np.float32(scale), unit(1, dim, seed + 1)[0]
    counted = to_grid(left).astype(object) * to_grid(right).astype(object)
    whole = sum(int(product) for product in counted)  # Python's integers are exact
    score = grid_scores(to_grid(left), to_grid(right[None]))[0]
    assert score == np.float32(whole * 2.0**-52)
    true = math.fsum(float(a) * float(b) for a, b in zip(left, right, strict=True))
    assert abs(whole * 2.0**-52 - true) <= 2.0**-26 * 1.002 * math.sqrt(dim)


@pytest.mark.parametrize("dim", [2, 64, 512])
def test_the_error_bound_covers_float32_products(dim):
    queries, vectors = unit(20, dim, seed=3), unit(200, dim, seed=4)
    off = np.abs((queries @ vectors.T) - grid_scores(to_grid(queries), to_grid(vectors)))
    assert off.max() <= error_bound(dim) < 1e-3


def test_the_worst_case_of_the_grid_is_within_the_error_bound():
    # Every component is half a step off the grid, so all rounding has the same sign.
    dim = 4096
    vector = np.full((1, dim), 1 / 64 + 2.0**-28, np.float32)
    exact = dim * float(vector[0, 0]) ** 2
    assert abs(float(grid_scores(to_grid(vector), to_grid(vector))[0, 0]) - exact) <= error_bound(dim)


def test_the_best_are_ordered_by_score_and_then_slot():
    scores = np.array([0.5, 0.9, 0.5, 0.9, 0.1], np.float32)
    slots = np.array([7, 4, 2, 1, 0])
    got = top_k(scores, slots, 4)
    assert got[1].tolist() == [1, 4, 2, 7]
    assert got[0].tolist() == np.array([0.9, 0.9, 0.5, 0.5], np.float32).tolist()


def test_a_scan_agrees_with_two_plain_loops():
    queries, vectors = unit(7, 5, seed=5), unit(40, 5, seed=6)
    scores, slots = scan(vectors, queries, 6)
    for query, row_scores, row_slots in zip(queries, scores, slots, strict=True):
        pairs = []
        for slot, vector in enumerate(vectors):
            total = 0.0
            for a, b in zip(query, vector, strict=True):
                total += float(a) * float(b)
            pairs.append((-total, slot))
        expected = sorted(pairs)[:6]
        assert row_slots.tolist() == [slot for _, slot in expected]
        # The grid of 2^-26 and one rounding to float32.
        np.testing.assert_allclose(row_scores, [-score for score, _ in expected], rtol=0, atol=2e-7)
