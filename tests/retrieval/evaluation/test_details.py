"""Calibrated probabilities of a method: drawn tests, hard scores, transfer to other objects."""

import numpy as np
import pytest

from retrieval.evaluation.details import draw_k_way_tests, reliability
from retrieval.evaluation.queries import fit_posterior
from tests.retrieval.metrics.test_registry import table_of


def planted(objects=20, grasps=10, seed=0):
    """Return scores N(1, 2) with the row's object and N(-1, 2) with others, which are the log-odds of a match."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(objects), grasps)
    noise = rng.normal(size=(len(owner), objects))[:, owner]  # equal for all photos of an object
    return table_of(np.where(owner[:, None] == owner, 1, -1) + np.sqrt(2) * noise, owner)


def test_drawn_tests_have_the_true_object_first_and_rivals_without_replacement():
    owner = np.repeat(np.arange(7), 3)
    scores = draw_k_way_tests(table_of(np.tile(owner, (21, 1)), owner), 4, 0)
    assert scores.shape == (4 * 21, 4)
    np.testing.assert_array_equal(scores[:21, 0], owner)
    assert all(len(set(row)) == 4 for row in scores.tolist())
    counts = np.bincount(scores[:, 1:].astype(int).ravel(), minlength=7)
    assert counts.min() > 18  # 36 each on average


@pytest.mark.parametrize("value", [0.0, 1e6, -1e6, 3e38])
def test_constant_scores_get_chance_probabilities(value):
    owner = np.repeat(np.arange(6), 4)
    table = table_of(np.full((24, 24), value), owner)
    found = reliability(fit_posterior(table), table)
    assert list(found) == ["k5"]  # there are too few objects for ten candidates
    assert found["k5"]["bins"] == [{"probability": pytest.approx(0.2), "frequency": pytest.approx(0.2), "count": 96}]


def test_a_calibration_transfers_to_objects_with_the_same_score_distribution_and_needs_three_objects():
    posterior = fit_posterior(planted())
    assert posterior.slope == pytest.approx(1, rel=0.15)
    found = reliability(posterior, planted(seed=7))
    assert list(found) == ["k5", "k10"]
    assert found["k5"]["ece"] < 0.05
    assert fit_posterior(planted(objects=2)) is None
