"""Calibration of pairs, of sums of grasps and of choices: true odds found again, and hard scores."""

import json
import math

import numpy as np
import pytest
from scipy.special import softmax

from retrieval.calibration import SLOPE_BOUNDS, fit_calibration
from retrieval.errors import BadInput, NumericalError
from retrieval.evaluation.calibrate import (
    Choice,
    calibrate,
    drawn_choices,
    drawn_pairs,
    fit_slope,
    log_odds_among,
    reliability,
    reliability_bins,
)
from retrieval.evaluation.table import ScoreTable


def table_of(scores, owner, rows=None, own=None):
    rows = owner if rows is None else rows
    own = np.eye(len(rows), len(owner), dtype=bool) if own is None else own
    return ScoreTable(np.asarray(scores, dtype=np.float32), np.array(rows), np.array(owner), own)


def planted(objects=20, grasps=10, seed=0, scale=1.0):
    """True pairs score N(1, 2), false ones N(-1, 2): the log-odds of a score are the score itself."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(objects), grasps)
    signs = np.where(owner[:, None] == owner, 1, -1)
    return table_of(scale * (signs + np.sqrt(2) * rng.normal(size=signs.shape)), owner)


def sets_of(table, grasps, shared, seed=0):
    """Scores of sums of grasps whose errors are the same to the share `shared`."""
    rng = np.random.default_rng(seed)
    owner = table.photo_owner
    signs = np.where(owner[:, None] == owner, 1, -1)
    common = np.sqrt(2 * shared) * rng.normal(size=signs.shape) * grasps
    single = np.sqrt(2 * (1 - shared) * grasps) * rng.normal(size=signs.shape)
    return table_of(grasps * signs + common + single, owner)


# What is drawn ---------------------------------------------------------------------------------------------


def test_drawn_pairs_are_even_in_every_row_and_hold_no_own_photo():
    """Scores name row and column, so every pair can be told."""
    owner = np.repeat([0, 1, 2], [3, 4, 12])
    table = table_of(np.arange(19 * 19).reshape(19, 19), owner)
    scores, labels = drawn_pairs(table, seed=0)
    rows, columns = np.divmod(scores.astype(int), 19)
    assert (rows != columns).all()
    np.testing.assert_array_equal(labels, owner[rows] == owner[columns])
    assert len(np.unique(scores[labels == 1])) == labels.sum()  # without replacement
    for row in range(19):
        wanted = min(8, np.sum(owner == owner[row]) - 1)
        assert [np.sum((rows == row) & (labels == label)) for label in (0, 1)] == [wanted, wanted]


def test_the_object_of_a_false_pair_is_drawn_before_its_photo():
    owner = np.repeat([0, 1, 2], [9, 2, 90])
    scores, labels = drawn_pairs(table_of(np.tile(owner, (101, 1)), owner), seed=0)
    assert np.mean(scores[labels == 0][:72] == 1) == pytest.approx(0.5, abs=0.2)  # naively, by photos, 2 / 92


def test_drawn_choices_have_the_true_object_first_and_rivals_without_replacement():
    owner = np.repeat(np.arange(7), 3)
    scores = drawn_choices(table_of(np.tile(owner, (21, 1)), owner), Choice(4, photos=2), seed=0)
    assert scores.shape == (4 * 21, 4)
    np.testing.assert_array_equal(scores[:21, 0], owner)
    assert all(len(set(row)) == 4 for row in scores.tolist())
    counts = np.bincount(scores[:, 1:].astype(int).ravel(), minlength=7)
    assert counts.min() > 18  # 36 each on average


def test_with_few_objects_a_choice_is_among_those_that_there_are():
    assert drawn_choices(planted(objects=3), Choice(10), seed=0).shape[1] == 3
    with pytest.raises(BadInput, match="two objects at least; got 1"):
        drawn_choices(table_of(np.zeros((2, 2)), [0, 0]), Choice(5), seed=0)
    with pytest.raises(BadInput, match="two objects at least; got 1"):
        drawn_pairs(table_of(np.zeros((2, 2)), [0, 0]), seed=0)


# Pairs and sums --------------------------------------------------------------------------------------------


def test_true_odds_of_pairs_are_found_again_at_any_scale():
    for scale in (1.0, 5.0, 0.2):
        fitted = calibrate({1: planted(scale=scale)}, ()).pairs[1]
        assert fitted.slope * scale == pytest.approx(1, abs=0.08)
        assert fitted.intercept == pytest.approx(0, abs=0.15)


def test_sums_of_grasps_that_err_alike_get_a_smaller_slope_than_the_sum_of_log_odds_would_have():
    """Errors wholly shared: the sum of 5 is 5 times one, and its slope a fifth; wholly apart: log-odds add up."""
    one = planted()
    for shared, slope in ((1.0, 0.2), (0.0, 1.0), (0.5, 1 / 3)):
        tables = {1: one, 5: sets_of(one, 5, shared)}
        fitted = calibrate(tables, ())
        assert fitted.pairs[5].slope == pytest.approx(slope, rel=0.15)
    # Naively, by one grasp's calibration, a sum of alike ones is far too sure of itself.
    sums = sets_of(one, 5, 1.0, seed=1)
    scores, labels = drawn_pairs(sums, seed=0)
    naive = reliability_bins(fitted.pairs[1].probability(scores, grasps=5), labels)["ece"]
    ours = reliability_bins(calibrate({1: one, 5: sets_of(one, 5, 1.0)}, ()).pairs[5].probability(scores), labels)[
        "ece"
    ]
    assert ours < 0.04 < 0.08 < naive


# Choices ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [2, 5, 10])
@pytest.mark.parametrize("slope", [0.05, 1.0, 7.0])
def test_the_temperature_that_made_choices_is_found_again(k, slope):
    rng = np.random.default_rng(0)
    scores = rng.normal(size=(4000, k)) * 2 / slope
    chances = softmax(slope * scores, axis=1)
    true = (rng.random((4000, 1)) > np.cumsum(chances, axis=1)).sum(1)
    order = np.argsort(np.arange(k) != true[:, None], axis=1, kind="stable")
    assert fit_slope(np.take_along_axis(scores, order, 1)) == pytest.approx(slope, rel=0.1)


def smoothed_loss(scores, slope):
    """What the fit makes small, one test at a time."""
    total, (tests, k) = 0.0, scores.shape
    for row in scores:
        peak = max(slope * row)
        log_sum = peak + math.log(sum(math.exp(value - peak) for value in slope * row))
        for place, value in enumerate(slope * row):
            target = (tests + 1 if place == 0 else 1) / (tests + k)
            total += target * (log_sum - value)
    return total


def test_no_slope_of_a_fine_grid_has_a_smaller_loss():
    scores = np.random.default_rng(0).normal([1, 0, 0, 0], size=(30, 4))
    best = smoothed_loss(scores, fit_slope(scores))
    assert best <= min(smoothed_loss(scores, slope) for slope in np.geomspace(*SLOPE_BOUNDS, 200)) + 1e-9


def test_scores_that_never_err_still_have_a_finite_slope_where_the_plain_likelihood_has_none():
    scores = np.tile([3.0, 0, 0, 0, 0], (100, 1))
    slope = fit_slope(scores)
    said = softmax(slope * scores[0])[0]
    assert said == pytest.approx(101 / 105)
    plain = [-np.log(softmax(factor * scores[0])[0]) for factor in (1, 3, 9)]
    assert plain == sorted(plain, reverse=True)


@pytest.mark.parametrize("value", [0.0, 1e6, -1e6, 3e38])
def test_constant_scores_say_nothing_and_get_even_chances(value):
    scores = np.full((50, 5), value)
    assert fit_slope(scores) == SLOPE_BOUNDS[0]
    found = reliability(calibrate({1: constant(value)}, [Choice(5)]), {1: constant(value)})
    assert found["k5"]["ece"] == pytest.approx(0, abs=1e-12)
    assert found["k5"]["bins"] == [{"probability": pytest.approx(0.2), "share": pytest.approx(0.2), "count": 4 * 24}]
    assert found["pairs"]["ece"] == pytest.approx(0, abs=1e-12)


def constant(value):
    owner = np.repeat(np.arange(6), 4)
    return table_of(np.full((24, 24), value), owner)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_choice_with_a_score_that_is_not_finite_is_refused_and_named(bad):
    with pytest.raises(NumericalError, match="every score of a choice must be finite; choice 1"):
        fit_slope([[1.0, 0.0], [bad, 0.0]])


def test_scores_that_say_the_opposite_get_the_smallest_slope():
    assert fit_slope(np.tile([-3.0, 0, 0], (40, 1))) == SLOPE_BOUNDS[0]


@pytest.mark.parametrize("scale", [1e-6, 1e6, 1e37])
def test_scores_of_any_size_give_finite_probabilities(scale):
    table = planted(scale=scale)
    fitted = calibrate({1: table}, [Choice(5), Choice(10)])
    found = reliability(fitted, {1: planted(seed=1, scale=scale)})
    json.dumps(found, allow_nan=False)
    assert all(SLOPE_BOUNDS[0] <= slope <= SLOPE_BOUNDS[1] for slope in fitted.slopes.values())
    assert all(0 <= found[name]["ece"] <= 1 for name in ("pairs", "k5", "k10"))


def test_the_prior_of_k_candidates_moves_log_odds_by_log_of_k_less_1():
    """Evidence that doubles the odds, among 5: 2 to 4, so 1/3."""
    odds = float(log_odds_among(math.log(2), 5))
    assert 1 / (1 + math.exp(-odds)) == pytest.approx(1 / 3)
    assert log_odds_among(0.7, 2) == 0.7


# Reliability -----------------------------------------------------------------------------------------------


def test_bins_and_their_error_by_hand():
    """Bins of a 15th: .1 alone; .30 and .32 in one, half of them true; 1.0 in the last."""
    found = reliability_bins([0.1, 0.3, 0.32, 1.0], [0, 1, 0, 1])
    assert found["bins"] == [
        {"probability": pytest.approx(0.1), "share": 0, "count": 1},
        {"probability": pytest.approx(0.31), "share": 0.5, "count": 2},
        {"probability": 1.0, "share": 1, "count": 1},
    ]
    assert found["ece"] == pytest.approx((0.1 + 2 * 0.19 + 0) / 4)


def test_the_error_is_that_which_the_fit_of_a_checkpoint_states():
    scores, labels = drawn_pairs(planted(), seed=0)
    fitted = fit_calibration(scores, labels)
    assert reliability_bins(fitted.probability(scores), labels)["ece"] == pytest.approx(fitted.ece_after, abs=1e-12)


def test_equals_count_by_their_share():
    assert reliability_bins([0.25, 0.25], [0.25, 0.25])["ece"] == 0


def test_no_probabilities_and_impossible_ones_are_refused():
    for bad in ([], [1.2], [math.nan], [-0.1]):
        with pytest.raises(BadInput, match="between 0 and 1"):
            reliability_bins(bad, [1.0] * len(bad))


def test_what_was_fitted_on_validation_objects_holds_on_others_where_scores_are_made_alike():
    fitted = calibrate({1: planted(), 5: sets_of(planted(), 5, 0.5)}, [Choice(5), Choice(5, 5, 3)])
    found = reliability(fitted, {1: planted(seed=7), 5: sets_of(planted(), 5, 0.5, seed=7)})
    assert list(found) == ["pairs", "k5", "k5_g5", "calibration"]
    assert all(found[name]["ece"] < 0.05 for name in ("pairs", "k5", "k5_g5"))
    # That one candidate is true is knowledge, and pairs on their own do not have it.
    assert found["k5"]["ece"] < found["k5"]["ece_of_pairs"]
    assert found["calibration"]["choices"]["k5"]["temperature"] == pytest.approx(1, abs=0.15)
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_a_choice_that_the_test_objects_cannot_fill_is_left_out():
    fitted = calibrate({1: planted(objects=4)}, [Choice(5), Choice(3), Choice(5, 8, 3)])
    assert set(fitted.slopes) == {Choice(5), Choice(3)}
    found = reliability(fitted, {1: planted(objects=4, seed=1)})
    assert "k3" in found
    assert "k5" not in found
