"""Calibrated probabilities of a method: drawn pairs and tests, hard scores, transfer to other objects."""

import json
import math

import numpy as np
import pytest

from retrieval.evaluation.details import draw_k_way_tests, draw_pairs, reliability
from retrieval.evaluation.queries import fit_posterior
from retrieval.model.posterior import Posterior
from tests.retrieval.metrics.test_registry import table_of


def planted(objects=20, grasps=10, seed=0, scale=1.0):
    """Return scores N(1, 2) with the row's object and N(-1, 2) with others, equal for all photos of an object.

    At a scale of 1 the log-odds of a match equal the score.
    """
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(objects), grasps)
    noise = rng.normal(size=(len(owner), objects))[:, owner]
    return table_of(scale * (np.where(owner[:, None] == owner, 1, -1) + np.sqrt(2) * noise), owner)


def test_drawn_pairs_are_balanced_in_every_row_and_exclude_the_own_photo():
    """Each score encodes its row and column, so every pair is identified."""
    owner = np.repeat([0, 1, 2], [3, 4, 12])
    scores, labels = draw_pairs(table_of(np.arange(19 * 19).reshape(19, 19), owner), seed=0)
    rows, columns = np.divmod(scores.astype(int), 19)
    assert (rows != columns).all()
    np.testing.assert_array_equal(labels, owner[rows] == owner[columns])
    assert len(np.unique(scores[labels == 1])) == labels.sum()  # without replacement
    for row in range(19):
        expected = min(8, np.sum(owner == owner[row]) - 1)
        assert [np.sum((rows == row) & (labels == label)) for label in (0, 1)] == [expected, expected]


def test_drawn_tests_have_the_true_object_first_and_rivals_without_replacement():
    owner = np.repeat(np.arange(7), 3)
    scores = draw_k_way_tests(table_of(np.tile(owner, (21, 1)), owner), 4, 2, 0, Posterior())
    assert scores.shape == (4 * 21, 4)
    np.testing.assert_allclose(scores[:21, 0], owner)
    assert all(len(set(row)) == 4 for row in scores.tolist())
    counts = np.bincount(np.rint(scores[:, 1:]).astype(int).ravel(), minlength=7)
    assert counts.min() > 18  # 36 each on average


def test_the_posterior_combines_the_photos_of_a_candidate():
    """Photos score 3 and 0: the posterior gives the log of the mean of e^3 and 1; the plain mean is 1.5."""
    owner = np.repeat([0, 1], 2)
    table = table_of(np.tile([3.0, 0.0, 0.0, 3.0], (4, 1)), owner, own=np.zeros((4, 4), dtype=bool))
    expected = np.full((16, 2), math.log((math.exp(3) + 1) / 2))
    assert draw_k_way_tests(table, 2, 2, 0, Posterior()) == pytest.approx(expected)


@pytest.mark.parametrize("value", [0.0, 1e6, -1e6, 3e38])
def test_constant_scores_get_chance_probabilities(value):
    owner = np.repeat(np.arange(6), 4)
    table = table_of(np.full((24, 24), value), owner)
    found = reliability({1: fit_posterior(table)}, {1: table})
    assert list(found) == ["pairs", "k5"]  # there are too few objects for ten candidates
    assert found["k5"]["bins"] == [{"probability": pytest.approx(0.2), "frequency": pytest.approx(0.2), "count": 96}]


def test_two_objects_give_no_posterior_and_no_reliability():
    table = planted(objects=2)
    assert fit_posterior(table) is None
    assert reliability({}, {1: table}) == {}


def test_a_calibration_transfers_to_objects_with_the_same_score_distribution():
    fitted = {1: fit_posterior(planted()), 5: fit_posterior(planted(scale=5))}
    assert fitted[1].slope == pytest.approx(1, rel=0.15)
    assert fitted[5].slope == pytest.approx(1 / 5, rel=0.15)
    found = reliability(fitted, {1: planted(seed=7), 5: planted(scale=5, seed=7)})
    assert list(found) == ["pairs", "k5", "k10", "k5_g5"]
    assert all(found[name]["ece"] < 0.05 for name in ("pairs", "k5", "k5_g5"))
    assert json.loads(json.dumps(found, allow_nan=False)) == found
