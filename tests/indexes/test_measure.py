"""Recall, and the check of search results against the reference."""

import numpy as np
import pytest

from indexes import load_kind
from indexes.errors import ParameterError
from indexes.kinds.exact import ExactIndex
from indexes.kinds.measure import query_ms, recall_against_exact, sample_queries
from indexes.kinds.vector_index import VectorIndex
from tests.oracle import disagreements

AXES = np.eye(6, dtype=np.float32)


def unit(count: int, dim: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, dim))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def claimed(slots: list[list[int]], queries: np.ndarray, vectors: np.ndarray) -> list[str]:
    """Disagreements if each claimed slot has its true score."""
    table = np.array(slots)
    scores = np.take_along_axis(queries @ vectors.T, np.maximum(table, 0), axis=1)
    return disagreements(vectors, queries, scores, table, 1e-6)


# A query with the scores 0.8, 0.48, 0.36, 0, 0, 0 against the axes.
QUERY = np.array([[0.8, 0.48, 0.36, 0, 0, 0]], np.float32)


def test_the_true_results_are_accepted():
    assert claimed([[0, 1, 2]], QUERY, AXES) == []


def test_a_wrong_slot_is_rejected_at_k_of_one():
    assert claimed([[1]], QUERY, AXES) == ["query 0, rank 1: 0.48 is not the best left"]


def test_a_wrong_slot_is_rejected_at_the_last_rank():
    assert claimed([[0, 1, 3]], QUERY, AXES) == ["query 0, rank 3: 0 is not the best left"]


def test_a_wrong_score_is_rejected():
    found = disagreements(AXES, QUERY, np.array([[0.8, 0.4]], np.float32), np.array([[0, 1]]), 1e-6)
    assert found[0] == "query 0, rank 2: slot 1 does not score 0.4"


def test_a_nan_score_is_rejected():
    assert disagreements(AXES, QUERY, np.array([[np.nan]], np.float32), np.array([[0]]), 1e-6)


@pytest.mark.parametrize("last", [3, 4, 5])
def test_every_tie_partner_is_accepted_at_the_last_rank(last):
    assert claimed([[0, 1, 2, last]], QUERY, AXES) == []


def test_a_repeated_slot_is_rejected_even_with_a_sufficient_score():
    assert claimed([[0, 1, 2, 4, 4]], QUERY, AXES) == ["query 0: a slot comes twice in [0, 1, 2, 4, 4]"]


@pytest.mark.parametrize("slot", [-1, 6])
def test_padding_and_slots_that_do_not_exist_are_rejected(slot):
    found = disagreements(AXES, QUERY, np.array([[0.8, 0.48]], np.float32), np.array([[0, slot]]), 1e-6)
    assert found == [f"query 0: slots must be in 0..5; got [0, {slot}]"]


def test_results_of_another_shape_are_rejected():
    assert "shape" in disagreements(AXES, QUERY, np.zeros((1, 2), np.float32), np.zeros((1, 3), int), 1e-6)[0]


class Fixed(VectorIndex):
    """An index that always returns the same slots, with their true scores."""

    kind = "fixed"

    def _search(self, queries, k, live):
        slots = np.tile(np.array(self.seed)[:k], (len(queries), 1))
        return np.take_along_axis(queries @ self._vectors.T, slots, axis=1), slots


@pytest.mark.parametrize(
    ("slots", "recall"), [([0, 1, 2], 1.0), ([0, 1, 3], 2 / 3), ([3, 4, 5], 0.0), ([2, 1, 0], 1.0)]
)
def test_recall_is_the_fraction_of_the_best_that_is_found(slots, recall):
    assert recall_against_exact(Fixed(AXES, None, slots, None), QUERY, 3) == pytest.approx(recall)


def test_recall_counts_a_tie_partner_as_found():
    assert recall_against_exact(Fixed(AXES, None, [0, 1, 2, 5], None), QUERY, 4) == 1.0


def test_recall_with_k_above_the_count_is_over_all_slots():
    assert recall_against_exact(ExactIndex.build(AXES), QUERY, 50) == 1.0


def test_recall_without_queries_raises():
    with pytest.raises(ParameterError, match="at least one query"):
        recall_against_exact(ExactIndex.build(AXES), np.empty((0, 6), np.float32))


def test_recall_of_the_whole_is_the_mean_over_any_partition():
    vectors = unit(800, 16)
    index = load_kind("ivf_flat").build(vectors).with_settings(probes=1)
    queries = sample_queries(vectors, 60)
    parts = [recall_against_exact(index, queries[start : start + 20]) for start in (0, 20, 40)]
    assert np.mean(parts) == pytest.approx(recall_against_exact(index, queries))


def test_sampled_queries_are_unit_vectors_near_the_data_and_follow_the_seed():
    vectors = unit(100, 64)
    queries = sample_queries(vectors, 50, seed=3)
    np.testing.assert_allclose(np.linalg.norm(queries, axis=1), 1, atol=1e-6)
    nearest = (queries @ vectors.T).max(axis=1)
    assert 0.8 < nearest.min() < nearest.max() < 0.98
    assert np.array_equal(queries, sample_queries(vectors, 50, seed=3))
    assert not np.array_equal(queries, sample_queries(vectors, 50, seed=4))


def test_the_time_of_a_query_is_the_median_without_the_first():
    ticks = iter([0.0, 0.001, 1.0, 1.009, 2.0, 2.002])
    assert query_ms(ExactIndex.build(AXES), AXES[:3], 2, clock=lambda: next(ticks)) == pytest.approx(2.0)
