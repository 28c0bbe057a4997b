"""Score tables, measures, and the photos that represent an object."""

from itertools import product

import numpy as np
import pytest

from retrieval.metrics.measure import Measure, pooled
from retrieval.metrics.table import object_scores
from tests.retrieval.metrics.test_registry import table_of


def test_an_object_is_represented_by_its_own_photos_equally_often_and_never_by_the_row_s_own():
    """Scores are powers of two, so the mean of three photos, drawn without replacement, identifies them."""
    owner = np.repeat([0, 1], 6)
    table = table_of(np.tile(2.0 ** np.arange(12), (12, 1)), owner)
    drawn = np.rint(object_scores(table, 3, 1000, seed=0) * 3).astype(int)
    bits = drawn[..., None] >> np.arange(12) & 1
    assert (bits.sum(-1) == 3).all()
    for row, name in product(range(12), (0, 1)):
        allowed = [column for column in range(6 * name, 6 * name + 6) if column != row]
        expected = np.zeros(12)
        expected[allowed] = 3 / len(allowed)
        np.testing.assert_allclose(bits[:, row, name].mean(0), expected, atol=0.1)  # six standard errors


def test_queries_of_several_galleries_are_pooled_under_their_units():
    one = Measure(np.array([[0.5], [1.0]]), np.array([3, 7]), np.array([0.25]), "four")
    two = Measure(np.array([[0.0]]), np.array([3]), np.array([0.5]), "two")
    whole = pooled([one, two], {3: 1, 7: 0})
    assert whole.owner.tolist() == [0, 1, 1]
    assert whole.values.ravel().tolist() == [1.0, 0.5, 0.0]
    assert whole.chance.tolist() == [pytest.approx((0.25 + (0.25 + 0.5) / 2) / 2)]  # equal unit weights
