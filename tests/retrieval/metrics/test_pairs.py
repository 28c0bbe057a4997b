"""Measures of pairs and of probabilities, by hand."""

import pytest

from retrieval.errors import BadInput, NumericalError
from retrieval.metrics.pairs import pair_accuracy, pair_auc, reliability_bins


def test_pair_accuracy_and_auc_equal_those_by_hand_and_count_zero_and_a_tie_as_one_half():
    assert pair_accuracy([2.0, -1.0, 0.0, 3.0], [1, 1, 1, 0]) == (1 + 0 + 0.5 + 0) / 4
    assert pair_accuracy([-0.0, 1e-30, -1e-30, 1e30], [1, 1, 0, 1]) == 3.5 / 4
    assert pair_auc([2.0, 1.0, 0.0, 0.0], [1, 1, 1, 0]) == pytest.approx(2.5 / 3)  # a tie counts half


def test_pairs_of_one_class_and_a_nan_are_refused():
    with pytest.raises(BadInput, match="of 2, 2 are 1 and 0 0"):
        pair_auc([0.0, 1.0], [1, 1])
    with pytest.raises(NumericalError, match="pair 1 has nan"):
        pair_accuracy([0.2, float("nan"), 0.9], [1, 1, 0])


def test_reliability_bins_and_their_error_by_hand():
    """Bins of width 1/15: .1 alone; .30 and .32 in one, half of them true; 1.0 in the last."""
    found = reliability_bins([0.1, 0.3, 0.32, 1.0], [0, 1, 0, 1])
    assert found["bins"] == [
        {"probability": pytest.approx(0.1), "frequency": 0, "count": 1},
        {"probability": pytest.approx(0.31), "frequency": 0.5, "count": 2},
        {"probability": 1.0, "frequency": 1, "count": 1},
    ]
    assert found["ece"] == pytest.approx((0.1 + 2 * 0.19 + 0) / 4)
