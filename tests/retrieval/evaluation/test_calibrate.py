"""Calibration of pairs, sums of grasps and objects: planted odds are recovered; hard scores."""

import json
import math

import numpy as np
import pytest
from scipy.special import expit

from retrieval.errors import BadInput
from retrieval.evaluation.calibrate import (
    KWayTest,
    calibrate,
    calibrate_pairs,
    draw_k_way_tests,
    draw_pairs,
    pair_threshold,
    posterior_questions,
    reliability,
)
from retrieval.metrics.pairs import reliability_bins
from retrieval.metrics.protocols import pair_accuracy
from retrieval.metrics.table import ScoreTable
from retrieval.model.posterior import Posterior


def table_of(scores, owner, rows=None, own=None):
    rows = owner if rows is None else rows
    own = np.eye(len(rows), len(owner), dtype=bool) if own is None else own
    return ScoreTable(np.asarray(scores, dtype=np.float32), np.array(rows), np.array(owner), own)


def planted(objects=20, grasps=10, seed=0, scale=1.0):
    """Return scores N(1, 2) of true pairs and N(-1, 2) of false ones: the log-odds equal the score."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(objects), grasps)
    signs = np.where(owner[:, None] == owner, 1, -1)
    return table_of(scale * (signs + np.sqrt(2) * rng.normal(size=signs.shape)), owner)


def sets_of(table, grasps, shared, seed=0):
    """Return scores of sums of grasps; a fraction `shared` of the error variance is common to all grasps."""
    rng = np.random.default_rng(seed)
    owner = table.photo_owner
    signs = np.where(owner[:, None] == owner, 1, -1)
    common = np.sqrt(2 * shared) * rng.normal(size=signs.shape) * grasps
    single = np.sqrt(2 * (1 - shared) * grasps) * rng.normal(size=signs.shape)
    return table_of(grasps * signs + common + single, owner)


# Pair threshold -----------------------------------------------------------------------------------


def test_fewer_than_ten_objects_give_no_threshold_but_a_reason():
    found = pair_threshold({}, planted(objects=9))
    assert (found.at, found.source) == (None, None)
    assert "one fitted on at least 10 validation objects; the split has 9" in found.reason


def test_ten_objects_give_a_threshold_at_log_odds_0():
    table = planted(objects=10)
    found = pair_threshold({}, table)
    assert found.source == "validation objects"
    assert calibrate_pairs(table).log_odds(found.at) == pytest.approx(0, abs=1e-9)


def test_a_checkpoints_own_threshold_has_priority():
    for objects in (2, 20):
        found = pair_threshold({"pair_threshold": 1.5}, planted(objects=objects))
        assert (found.at, found.source, found.reason) == (1.5, "the checkpoint", None)
        # By hand: a match scores above 1.5; exactly 1.5 counts 1/2.
        table = table_of([[9, 2.0], [1.5, 1]], [0, 1], own=np.zeros((2, 2), bool))
        assert pair_accuracy(table, found.at).values.ravel().tolist() == [(1 + 0) / 2, (0 + 0.5) / 2]


# Drawn pairs and tests ---------------------------------------------------------------------------------------------


def test_drawn_pairs_are_balanced_in_every_row_and_exclude_the_own_photo():
    """Each score encodes its row and column, so every pair is identified."""
    owner = np.repeat([0, 1, 2], [3, 4, 12])
    table = table_of(np.arange(19 * 19).reshape(19, 19), owner)
    scores, labels = draw_pairs(table, seed=0)
    rows, columns = np.divmod(scores.astype(int), 19)
    assert (rows != columns).all()
    np.testing.assert_array_equal(labels, owner[rows] == owner[columns])
    assert len(np.unique(scores[labels == 1])) == labels.sum()  # without replacement
    for row in range(19):
        expected = min(8, np.sum(owner == owner[row]) - 1)
        assert [np.sum((rows == row) & (labels == label)) for label in (0, 1)] == [expected, expected]


def test_drawn_tests_have_the_true_object_first_and_rivals_without_replacement():
    owner = np.repeat(np.arange(7), 3)
    scores = draw_k_way_tests(table_of(np.tile(owner, (21, 1)), owner), KWayTest(4, photos=2), seed=0)
    assert scores.shape == (4 * 21, 4)
    np.testing.assert_array_equal(scores[:21, 0], owner)
    assert all(len(set(row)) == 4 for row in scores.tolist())
    counts = np.bincount(scores[:, 1:].astype(int).ravel(), minlength=7)
    assert counts.min() > 18  # 36 each on average


def test_a_test_has_at_most_as_many_candidates_as_objects():
    assert draw_k_way_tests(planted(objects=3), KWayTest(10), seed=0).shape[1] == 3
    with pytest.raises(BadInput, match="at least 2 objects, got 1"):
        draw_k_way_tests(table_of(np.zeros((2, 2)), [0, 0]), KWayTest(5), seed=0)
    with pytest.raises(BadInput, match="at least 2 objects, got 1"):
        draw_pairs(table_of(np.zeros((2, 2)), [0, 0]), seed=0)


# Pairs and sums --------------------------------------------------------------------------------------------


def test_sums_of_grasps_with_common_errors_get_a_smaller_slope():
    """Common errors: the sum of 5 is 5 times one, its slope 1/5. Independent errors: log-odds add."""
    one = planted()
    for shared, slope in ((1.0, 0.2), (0.0, 1.0), (0.5, 1 / 3)):
        fitted = calibrate_pairs(sets_of(one, 5, shared))
        assert fitted.slope == pytest.approx(slope, rel=0.15)
    # Naive: with the calibration of one grasp, a sum with common errors is overconfident.
    sums = sets_of(one, 5, 1.0, seed=1)
    scores, labels = draw_pairs(sums, seed=0)
    single = calibrate_pairs(one)
    added = expit(single.slope * scores + 5 * single.intercept)
    probabilities = (added, calibrate_pairs(sets_of(one, 5, 1.0)).probability(scores))
    naive, ours = (reliability_bins(probability, labels)["ece"] for probability in probabilities)
    assert ours < 0.04 < 0.08 < naive


# Objects, and none -------------------------------------------------------------------------------------------


def views(objects=20, grasps=10, seed=0, scale=1.0, shift=0.0):
    """Return `planted` scores that are equal for all photos of an object, so the posterior is as planted."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(objects), grasps)
    noise = rng.normal(size=(len(owner), objects))[:, owner]
    return table_of(scale * (np.where(owner[:, None] == owner, 1, -1) + np.sqrt(2) * noise) + shift, owner)


def test_the_posterior_combines_the_photos_of_a_candidate():
    """Photos score 3 and 0: the posterior gives the log of the mean of e^3 and 1; the plain mean is 1.5."""
    owner = np.repeat([0, 1], 2)
    table = table_of(np.tile([3.0, 0.0, 0.0, 3.0], (4, 1)), owner, own=np.zeros((4, 4), dtype=bool))
    pooled = draw_k_way_tests(table, KWayTest(2, photos=2), 0, Posterior())
    assert pooled == pytest.approx(np.full((16, 2), math.log((math.exp(3) + 1) / 2)))
    assert draw_k_way_tests(table, KWayTest(2, photos=2), 0) == pytest.approx(np.full((16, 2), 1.5))
    np.testing.assert_allclose(
        draw_k_way_tests(table, KWayTest(2), 0, Posterior()), draw_k_way_tests(table, KWayTest(2), 0), atol=1e-12
    )


@pytest.mark.parametrize("value", [0.0, 1e6, -1e6, 3e38])
def test_constant_scores_get_chance_probabilities(value):
    table = constant(value)
    for photos in (1, 3):
        found = reliability(calibrate({1: table}), {1: table}, [KWayTest(5, photos=photos)])
        assert found["k5"]["ece"] == pytest.approx(0, abs=1e-12)
        only = {"probability": pytest.approx(0.2), "frequency": pytest.approx(0.2), "count": 4 * 24}
        assert found["k5"]["bins"] == [only]
        assert found["pairs"]["ece"] == pytest.approx(0, abs=1e-12)


def constant(value):
    owner = np.repeat(np.arange(6), 4)
    return table_of(np.full((24, 24), value), owner)


def test_two_objects_give_a_pair_calibration_but_no_posterior():
    fitted = calibrate({1: planted(objects=2)})
    assert list(fitted.pairs) == [1]
    assert fitted.posteriors == {}
    assert set(reliability(fitted, {1: planted(objects=2)}, [KWayTest(2)])) == {"pairs"}
    with pytest.raises(BadInput, match="at least three objects"):
        posterior_questions(planted(objects=2))


# Reliability -----------------------------------------------------------------------------------------------


def test_bins_and_their_error_by_hand():
    """Bins of width 1/15: .1 alone; .30 and .32 in one, half of them true; 1.0 in the last."""
    found = reliability_bins([0.1, 0.3, 0.32, 1.0], [0, 1, 0, 1])
    assert found["bins"] == [
        {"probability": pytest.approx(0.1), "frequency": 0, "count": 1},
        {"probability": pytest.approx(0.31), "frequency": 0.5, "count": 2},
        {"probability": 1.0, "frequency": 1, "count": 1},
    ]
    assert found["ece"] == pytest.approx((0.1 + 2 * 0.19 + 0) / 4)


def test_a_calibration_transfers_to_objects_with_the_same_score_distribution():
    fitted = calibrate({1: views(), 5: views(scale=5)})
    tests = {1: views(seed=7), 5: views(scale=5, seed=7)}
    found = reliability(fitted, tests, [KWayTest(5), KWayTest(5, 5, 3)])
    assert list(found) == ["pairs", "k5", "k5_g5"]
    assert all(found[name]["ece"] < 0.05 for name in found)
    assert set(fitted.to_dict()) == {"pairs", "posteriors"}
    assert Posterior.from_dict(fitted.to_dict()["posteriors"]["5"]) == fitted.posteriors[5]
    assert json.loads(json.dumps(found, allow_nan=False)) == found
