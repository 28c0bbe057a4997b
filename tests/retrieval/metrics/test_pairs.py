"""Calibration of match logits and measures of pairs: by hand, by grids and loops, and where logits are extreme."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retrieval.metrics.pairs import (
    SLOPE_BOUNDS,
    fit_calibration,
    pair_accuracy,
    pair_auc,
    reliability_bins,
)

FLOAT32_MAX = float(np.finfo(np.float32).max)


def overlapping(count=200, offset=0.0, scale=1.0):
    """Return logits and labels; half of the pairs are true, their logits one deviation higher."""
    labels = np.arange(count) % 2
    return scale * (np.random.default_rng(0).normal(size=count) + labels) + offset, labels


def smoothed_loss(logits, labels, slope, intercept):
    """Return the objective of the fit, pair by pair: classes of equal weight, Platt's targets."""
    total, positives, negatives = 0.0, sum(labels), len(labels) - sum(labels)
    for logit, label in zip(logits, labels, strict=True):
        target = (positives + 1) / (positives + 2) if label else 1 / (negatives + 2)
        x = slope * logit + intercept
        loss = target * np.logaddexp(0, -x) + (1 - target) * np.logaddexp(0, x)
        total += 0.5 / (positives if label else negatives) * loss
    return total


@pytest.mark.parametrize(
    ("logits", "labels"),
    [
        ([-1.0, 0.5, 0.2, 2.0, -0.3, 1.0], [0, 0, 1, 1, 0, 1]),
        ([3.0, 1.0, 2.0, 6.0], [0, 1, 0, 1]),
        ([-2.0, -1.0, 0.0, 1.0, 5.0], [0, 0, 0, 0, 1]),
    ],
)
def test_no_point_of_a_fine_grid_has_a_smaller_loss(logits, labels):
    slope, intercept = fit_calibration(logits, labels)
    best = smoothed_loss(logits, labels, slope, intercept)
    grid = smoothed_loss(logits, labels, np.geomspace(*SLOPE_BOUNDS, 61)[:, None], np.linspace(-12, 12, 97))
    near = np.array([-1e-3, 0, 1e-3])
    nearby = smoothed_loss(logits, labels, slope + near[:, None], intercept + near)
    assert best <= grid.min()
    assert best <= nearby.min() + 1e-15  # float64 rounding of a loss below 1


@pytest.mark.parametrize(("scale", "bound"), [(1e-3, 1), (1e3, 0), (1e30, 0)])
def test_a_slope_beyond_its_bounds_is_exactly_the_bound(scale, bound):
    assert fit_calibration(*overlapping(scale=scale))[0] == SLOPE_BOUNDS[bound]


finite_logits = st.floats(-FLOAT32_MAX, FLOAT32_MAX, width=32)


@settings(max_examples=60)
@given(st.lists(st.tuples(finite_logits, st.integers(0, 1)), max_size=20), finite_logits, finite_logits)
def test_any_finite_logits_of_both_classes_can_be_calibrated(pairs, one, two):
    slope, intercept = fit_calibration(*zip(*pairs, (one, 0), (two, 1), strict=True))
    assert math.isfinite(intercept)
    assert SLOPE_BOUNDS[0] <= slope <= SLOPE_BOUNDS[1]


def test_pair_accuracy_and_auc_equal_those_by_hand_and_count_zero_and_a_tie_as_one_half():
    assert pair_accuracy([2.0, -1.0, 0.0, 3.0], [1, 1, 1, 0]) == (1 + 0 + 0.5 + 0) / 4
    assert pair_accuracy([-0.0, 1e-30, -1e-30, 1e30], [1, 1, 0, 1]) == 3.5 / 4
    assert pair_auc([2.0, 1.0, 0.0, 0.0], [1, 1, 1, 0]) == pytest.approx(2.5 / 3)  # a tie counts half


def test_reliability_bins_and_their_error_by_hand():
    """Bins of width 1/15: .1 alone; .30 and .32 in one, half of them true; 1.0 in the last."""
    found = reliability_bins([0.1, 0.3, 0.32, 1.0], [0, 1, 0, 1])
    assert found["bins"] == [
        {"probability": pytest.approx(0.1), "frequency": 0, "count": 1},
        {"probability": pytest.approx(0.31), "frequency": 0.5, "count": 2},
        {"probability": 1.0, "frequency": 1, "count": 1},
    ]
    assert found["ece"] == pytest.approx((0.1 + 2 * 0.19 + 0) / 4)
