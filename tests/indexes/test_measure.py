"""Recall and time of an index."""

import numpy as np
import pytest

import indexes
from indexes.errors import ParameterError
from indexes.kinds.measure import recall_against_exact, sample_queries
from indexes.kinds.vector_index import VectorIndex
from tests.indexes.test_search import unit

AXES = np.eye(6, dtype=np.float32)
# A query with the scores 0.8, 0.48, 0.36, 0, 0, 0 against the axes.
QUERY = np.array([[0.8, 0.48, 0.36, 0, 0, 0]], np.float32)


class Fixed(VectorIndex):
    """An index that always returns the rows in its name."""

    def _search(self, queries, k):
        rows = np.tile(np.array(list(map(int, self.kind.split(","))))[:k], (len(queries), 1))
        return np.take_along_axis(queries @ self.vectors.T, rows, axis=1), rows


@pytest.mark.parametrize(
    ("rows", "recall"), [("0,1,2", 1.0), ("0,1,3", 2 / 3), ("3,4,5", 0.0), ("2,1,0", 1.0), ("0,1,-1", 2 / 3)]
)
def test_recall_is_the_fraction_of_the_best_that_is_found(rows, recall):
    assert recall_against_exact(Fixed(AXES, rows), QUERY, 3) == pytest.approx(recall)


def test_recall_counts_a_tie_partner_as_found_and_k_is_at_most_the_count():
    assert recall_against_exact(Fixed(AXES, "0,1,2,5"), QUERY, 4) == 1.0
    assert recall_against_exact(indexes.build(AXES), QUERY, 50) == 1.0
    with pytest.raises(ParameterError, match="at least one query"):
        recall_against_exact(indexes.build(AXES), np.empty((0, 6), np.float32))


def test_sampled_queries_are_unit_vectors_near_the_data_and_always_the_same():
    vectors = unit(100, 64)
    queries = sample_queries(vectors)
    np.testing.assert_allclose(np.linalg.norm(queries, axis=1), 1, atol=1e-6)
    nearest = (queries @ vectors.T).max(axis=1)
    assert 0.8 < nearest.min() < nearest.max() < 0.98
    assert np.array_equal(queries, sample_queries(vectors))
