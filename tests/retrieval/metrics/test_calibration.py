"""Calibration of match logits and the two pair metrics: by hand, by grids and loops, and where logits are extreme."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retrieval.errors import BadInput, NumericalError
from retrieval.metrics.pairs import (
    SLOPE_BOUNDS,
    Calibration,
    fit_calibration,
    negative_log_likelihood,
    pair_accuracy,
    pair_auc,
)

FLOAT32_MAX = float(np.finfo(np.float32).max)


def overlapping(count=200, offset=0.0, scale=1.0, seed=0):
    """Return logits and labels; half of the pairs are true, their logits one deviation higher."""
    labels = np.arange(count) % 2
    return scale * (np.random.default_rng(seed).normal(size=count) + labels) + offset, labels


def softplus(x):
    """Return log(1 + e^x) without overflow."""
    return max(x, 0.0) + math.log1p(math.exp(-abs(x)))


def smoothed_loss(logits, labels, slope, intercept, smooth=True):
    """Return the objective of the fit, pair by pair: classes of equal weight, Platt's targets (or 1 and 0)."""
    counts = {1: sum(labels), 0: len(labels) - sum(labels)}
    target = {1: (counts[1] + 1) / (counts[1] + 2), 0: 1 / (counts[0] + 2)} if smooth else {1: 1.0, 0: 0.0}
    total = 0.0
    for logit, label in zip(logits, labels, strict=True):
        x, t = slope * logit + intercept, target[label]
        total += 0.5 / counts[label] * (t * softplus(-x) + (1 - t) * softplus(x))
    return total


# Input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("function", [fit_calibration, pair_accuracy, pair_auc])
@pytest.mark.parametrize(
    ("labels", "counts"),
    [
        ([1, 1, 1], "of 3, 3 are 1 and 0 0"),
        ([0, 0, 0], "of 3, 0 are 1 and 3 0"),
        ([0, 1, 2], "of 3, 1 are 1 and 1 0"),
        ([0, 1, 0.5], "of 3, 1 are 1 and 1 0"),
        ([0, 1, math.nan], "of 3, 1 are 1 and 1 0"),
    ],
)
def test_pairs_of_both_classes_and_no_other_labels_are_required(function, labels, counts):
    with pytest.raises(BadInput, match=f"pairs of both classes are needed, labelled 0 and 1; {counts}"):
        function([0.1, 0.2, 0.3], labels)


@pytest.mark.parametrize("function", [fit_calibration, pair_accuracy, pair_auc])
def test_empty_input_and_unequal_shapes_are_refused(function):
    with pytest.raises(BadInput, match="of 0, 0 are 1 and 0 0"):
        function([], [])
    with pytest.raises(BadInput, match=r"vectors of one length; got \(2,\) and \(3,\)"):
        function([1.0, 2.0], [0, 1, 1])
    with pytest.raises(BadInput, match="vectors of one length"):
        function([[1.0, 2.0]], [[0, 1]])


@pytest.mark.parametrize("function", [fit_calibration, pair_accuracy, pair_auc])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e39])
def test_a_logit_that_is_not_a_finite_float32_is_refused_and_named(function, bad):
    with pytest.raises(NumericalError, match=r"must be a finite float32; pair 2 has "):
        function([0.1, 0.2, bad, bad], [0, 1, 0, 1])


# The fit ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("logits", "labels"),
    [
        ([-1.0, 0.5, 0.2, 2.0, -0.3, 1.0], [0, 0, 1, 1, 0, 1]),
        ([3.0, 1.0, 2.0, 6.0], [0, 1, 0, 1]),
        ([-2.0, -1.0, 0.0, 1.0, 5.0], [0, 0, 0, 0, 1]),
        ([0.2, 0.4], [0, 1]),
    ],
)
def test_no_point_of_a_fine_grid_has_a_smaller_loss(logits, labels):
    fitted = fit_calibration(logits, labels)
    best = smoothed_loss(logits, labels, fitted.slope, fitted.intercept)
    grid = min(
        smoothed_loss(logits, labels, slope, intercept)
        for slope in np.geomspace(*SLOPE_BOUNDS, 61)
        for intercept in np.linspace(-12, 12, 97)
    )
    nearby = min(
        smoothed_loss(logits, labels, fitted.slope + a, fitted.intercept + b)
        for a in (-1e-3, 0, 1e-3)
        for b in (-1e-3, 0, 1e-3)
    )
    assert best <= grid
    assert best <= nearby + 1e-15  # float64 rounding of a loss below 1


def test_one_pair_of_each_class_gives_its_smoothed_targets():
    """Two parameters fit two targets: (1 + 1) / (1 + 2) for the true pair, 1 / (1 + 2) for the false one."""
    fitted = fit_calibration([-1.0, 3.0], [0, 1])
    np.testing.assert_allclose(fitted.probability([-1.0, 3.0]), [1 / 3, 2 / 3], rtol=1e-9)
    assert fitted.slope == pytest.approx(2 * math.log(2) / 4)


def test_separable_logits_have_a_finite_fit_although_the_plain_likelihood_has_none():
    logits = np.concatenate([np.linspace(-9, -6, 50), np.linspace(6, 9, 50)])
    labels = [0] * 50 + [1] * 50
    plain = [smoothed_loss(logits, labels, slope, 0.0, smooth=False) for slope in (0.5, 1, 2, 4)]
    assert plain == sorted(plain, reverse=True)  # naive: always better with a steeper slope
    assert plain[-1] < 1e-9
    fitted = fit_calibration(logits, labels)
    assert SLOPE_BOUNDS[0] < fitted.slope < 1
    assert abs(fitted.intercept) < 0.1
    # 50 pairs without an error: the smoothed target, 51 / 52, lies between the least and the most certain of them.
    assert fitted.probability(6.0) < 51 / 52 < fitted.probability(9.0) < 0.999


def test_rarer_true_pairs_do_not_shift_the_probability_because_the_odds_are_even():
    logits, labels = overlapping(400)
    rare = np.concatenate([np.flatnonzero(labels == 0), np.flatnonzero(labels == 1)[:40]])
    even, few = fit_calibration(logits, labels), fit_calibration(logits[rare], labels[rare])
    # Naively, the log-odds at any logit would fall by log(5) = 1.6 with the fraction of true pairs.
    assert abs(few.log_odds(0.5) - even.log_odds(0.5)) < 0.5


def test_the_fit_recovers_the_true_odds():
    """Two normal distributions at distance 1 with deviation 1: the log-odds of a logit z are z - 1/2."""
    logits, labels = overlapping(100_000)
    fitted = fit_calibration(logits, labels)
    assert fitted.slope == pytest.approx(1.0, abs=0.03)  # the standard error is about 0.01
    assert fitted.intercept == pytest.approx(-0.5, abs=0.03)
    assert negative_log_likelihood(fitted.log_odds(logits), labels) < negative_log_likelihood(logits, labels)


# Extreme logits --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [1e3, -1e5, 1e6])
def test_an_offset_of_all_logits_changes_only_the_intercept(offset):
    """A quasi-Newton fit of both parameters gave slope 0.89 instead of 1.21 at an offset of 1000."""
    (logits, labels), plain = overlapping(), fit_calibration(*overlapping())
    fitted = fit_calibration(logits + offset, labels)
    assert fitted.slope == pytest.approx(plain.slope, rel=1e-6)
    np.testing.assert_allclose(fitted.log_odds(logits + offset), plain.log_odds(logits), atol=1e-6)  # 1e6 * 2^-52 * 1e3


@pytest.mark.parametrize("scale", [0.05, 7.0, 60.0])
def test_scaling_all_logits_scales_the_slope_and_preserves_the_probabilities(scale):
    (logits, labels), plain = overlapping(), fit_calibration(*overlapping())
    fitted = fit_calibration(scale * logits, labels)
    assert fitted.slope == pytest.approx(plain.slope / scale, rel=1e-6)
    np.testing.assert_allclose(fitted.probability(scale * logits), plain.probability(logits), rtol=1e-6)


@pytest.mark.parametrize(("scale", "bound"), [(1e-3, 1), (1e3, 0), (1e30, 0)])
def test_a_slope_beyond_its_bounds_is_exactly_the_bound(scale, bound):
    logits, labels = overlapping(scale=scale)
    assert fit_calibration(logits, labels).slope == SLOPE_BOUNDS[bound]


@pytest.mark.parametrize("value", [0.0, 5.0, -1e4, 1e30])
def test_constant_logits_make_both_answers_equally_likely(value):
    fitted = fit_calibration([value] * 6, [0, 1, 0, 1, 1, 0])
    assert fitted.slope == SLOPE_BOUNDS[0]
    assert fitted.probability(value) == 0.5


finite_logits = st.floats(-FLOAT32_MAX, FLOAT32_MAX, width=32)
pair_lists = st.lists(st.tuples(finite_logits, st.integers(0, 1)), min_size=1, max_size=20)


@settings(max_examples=150)
@given(pairs=pair_lists, one=finite_logits, two=finite_logits)
def test_any_finite_logits_of_both_classes_can_be_calibrated(pairs, one, two):
    logits, labels = zip(*pairs, (one, 0), (two, 1), strict=True)
    fitted = fit_calibration(logits, labels)
    assert all(math.isfinite(value) for value in dataclasses.asdict(fitted).values())
    assert SLOPE_BOUNDS[0] <= fitted.slope <= SLOPE_BOUNDS[1]
    assert (np.diff(fitted.log_odds(np.sort(logits))) >= 0).all()


# Use -------------------------------------------------------------------------------------------------------


FITTED = Calibration(2.0, -0.5)


def test_log_odds_and_probability_equal_the_formula():
    assert FITTED.log_odds(1.25) == 2.0
    assert FITTED.probability(1.25) == pytest.approx(1 / (1 + math.exp(-2)))
    np.testing.assert_array_equal(FITTED.log_odds([0.0, 1.0]), [-0.5, 1.5])


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_logit_that_is_not_finite_has_no_odds(bad):
    """A NaN is never above a threshold: it would silently count as "no match"."""
    assert not math.nan >= 0.0
    for function in (FITTED.log_odds, FITTED.probability):
        with pytest.raises(NumericalError, match="every logit must be finite to be calibrated; got"):
            function([0.0, bad])


# Metrics ---------------------------------------------------------------------------------------------------


def auc_by_loops(logits, labels):
    wins, total = 0.0, 0
    for true, label in zip(logits, labels, strict=True):
        for false, other in zip(logits, labels, strict=True):
            if label == 1 and other == 0:
                wins += 1.0 if true > false else 0.5 if true == false else 0.0
                total += 1
    return wins / total


few_values = st.sampled_from([-1e30, -1.0, 0.0, 1e-30, 1.0, 2.0])


@settings(max_examples=200)
@given(
    pairs=st.lists(st.tuples(few_values, st.integers(0, 1)), max_size=30),
    one=few_values,
    two=few_values,
)
def test_the_auc_is_the_fraction_of_won_comparisons_with_ties_as_one_half(pairs, one, two):
    logits, labels = zip(*pairs, (one, 0), (two, 1), strict=True)
    assert pair_auc(logits, labels) == pytest.approx(auc_by_loops(logits, labels), abs=1e-15)


@pytest.mark.parametrize(("true", "false"), [(1, 1), (3, 7), (50, 1), (333, 1001)])
def test_a_constant_scorer_has_exactly_an_auc_of_one_half(true, false):
    labels = [1] * true + [0] * false
    assert pair_auc([2.5] * len(labels), labels) == 0.5
    assert pair_auc([2.5] * len(labels), labels[::-1]) == 0.5
    # Naively, after a sort of the pairs, the constant scorer's AUC is that of their input order.
    order = np.argsort(np.full(len(labels), -2.5), kind="stable")
    below = [sum(labels[j] == 0 for j in order[place + 1 :]) for place, i in enumerate(order) if labels[i] == 1]
    assert sum(below) / (true * false) == 1.0


def test_pair_accuracy_equals_that_by_hand_and_counts_zero_as_one_half():
    assert pair_accuracy([2.0, -1.0, 0.0, 3.0], [1, 1, 1, 0]) == (1 + 0 + 0.5 + 0) / 4
    assert pair_accuracy([0.0] * 4, [0, 1, 1, 1]) == 0.5
    assert pair_accuracy([-0.0, 1e-30, -1e-30, 1e30], [1, 1, 0, 1]) == 3.5 / 4
