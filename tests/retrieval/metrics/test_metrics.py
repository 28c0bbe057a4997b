"""Top-n curves against an enumeration of every draw, and intervals against published values."""

from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retrieval.errors import BadInput
from retrieval.metrics.intervals import binomial_interval, grouped_interval
from retrieval.metrics.ranking import k_way_accuracies


def curve(true_score, others, k):
    others = np.array(others)
    counts = [np.array([np.sum(other)]) for other in (others > true_score, others == true_score)]
    return k_way_accuracies(*counts, len(others), k)[0]


def curve_by_enumeration(true_score, others, k):
    """Return how often the true photo is among the first n, over every set of rivals and every order of ties."""
    found, cases = np.zeros(k), 0
    for rivals in combinations(range(len(others)), k - 1):
        scores = [true_score, *(others[rival] for rival in rivals)]
        for order in permutations(range(k)):
            ranked = sorted(range(k), key=lambda place: (-scores[place], order[place]))
            found[ranked.index(0) :] += 1
            cases += 1
    return found / cases


@settings(max_examples=40)
@given(st.integers(0, 3), st.lists(st.integers(0, 3), min_size=3, max_size=5), st.integers(1, 4))
def test_the_curve_equals_that_over_every_draw_and_every_order_of_ties(true_score, others, k):
    np.testing.assert_allclose(curve(true_score, others, k), curve_by_enumeration(true_score, others, k), atol=1e-12)


def test_curves_of_many_queries_equal_those_of_single_queries():
    rng = np.random.default_rng(0)
    scores = rng.integers(0, 4, (30, 9))
    higher, equal = (scores[:, 1:] > scores[:, :1]).sum(1), (scores[:, 1:] == scores[:, :1]).sum(1)
    expected = [curve(row[0], row[1:], 4) for row in scores]
    np.testing.assert_array_equal(k_way_accuracies(higher, equal, 8, 4), expected)


def test_too_few_rivals_are_refused():
    with pytest.raises(BadInput, match="needs k >= 1 and 4 other candidates; got 3"):
        curve(0.0, np.zeros(3), 5)


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (0, 10, 0.0, 0.3084971078),  # 1 - 0.025 ** (1 / 10)
        (10, 10, 0.6915028922, 1.0),
        (4, 20, 0.0573, 0.4366),  # four digits in printed tables of the method
    ],
)
def test_the_interval_equals_that_of_clopper_and_pearson(successes, trials, low, high):
    assert binomial_interval(successes, trials) == pytest.approx((low, high), abs=5e-5)


def test_an_interval_needs_trials():
    with pytest.raises(BadInput):
        binomial_interval(1, 0)


def test_answers_that_are_uncorrelated_within_groups_count_in_full():
    assert grouped_interval([[True, False]] * 10) == pytest.approx(binomial_interval(10, 20))
    assert grouped_interval([[True] * 7, [True] * 5]) == binomial_interval(12, 12)
    assert grouped_interval([[True] * 3 + [False]]) == binomial_interval(3, 4)


def test_groups_that_are_entirely_right_or_wrong_count_as_one_answer_each():
    """Ten groups of 50, five of them all wrong: by hand the design effect is 50 * 10 / 9, so 9 answers remain.

    4.5 of these are right. As 500 independent answers, the interval would be seven times too narrow.
    """
    low, high = grouped_interval([[True] * 50] * 5 + [[False] * 50] * 5)
    assert binomial_interval(4, 9)[0] < low < binomial_interval(5, 9)[0]
    assert binomial_interval(4, 9)[1] < high < binomial_interval(5, 9)[1]
    naive = binomial_interval(250, 500)
    assert high - low > 7 * (naive[1] - naive[0])


def test_a_grouped_interval_needs_answers():
    with pytest.raises(BadInput):
        grouped_interval([])
