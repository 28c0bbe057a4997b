"""Measures of a ranking, over every order of ties and every draw of rivals."""

from itertools import combinations, pairwise, permutations
from math import comb

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retrieval.metrics.ranking import average_precision, k_way_accuracies, recall_at


def measures(scores, relevant):
    """Return all measures of one row."""
    scores, relevant = np.array([scores], dtype=float), np.array([relevant], dtype=bool)
    shown = np.ones_like(relevant)
    found = {k: float(recall_at(k, scores, relevant, shown)[0]) for k in (1, 2, 3, 5)}
    found["map"] = float(average_precision(scores, relevant, shown)[0])
    return found


def measures_of_order(relevant_in_order):
    """Return the measures of a ranking without ties, by two plain loops."""
    first = next(place for place, good in enumerate(relevant_in_order, 1) if good)
    precisions, count = [], 0
    for place, good in enumerate(relevant_in_order, 1):
        count += good
        if good:
            precisions.append(count / place)
    found = {k: float(first <= k) for k in (1, 2, 3, 5)}
    return found | {"map": sum(precisions) / len(precisions)}


def measures_by_enumeration(scores, relevant):
    """Return the mean over every order that the scores allow, all equally likely."""
    orders = [
        order for order in permutations(range(len(scores))) if all(scores[a] >= scores[b] for a, b in pairwise(order))
    ]
    cases = [measures_of_order([relevant[item] for item in order]) for order in orders]
    return {name: sum(case[name] for case in cases) / len(cases) for name in cases[0]}


@settings(max_examples=60)
@given(st.lists(st.tuples(st.integers(0, 2), st.booleans()), min_size=1, max_size=6))
def test_ties_count_by_the_mean_over_every_order(items):
    scores, relevant = zip(*items, strict=True)
    if not any(relevant):
        relevant = (True, *relevant[1:])
    found, expected = measures(scores, relevant), measures_by_enumeration(scores, relevant)
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-14)


def test_many_ties_neither_overflow_nor_lose_precision():
    """Five items before 4,000 equal ones, of which 44 are relevant: binomials of 4,000 items overflow a float."""
    with pytest.raises(OverflowError):
        float(comb(4000, 2000))
    scores, relevant = np.zeros((1, 4005)), np.zeros((1, 4005), dtype=bool)
    scores[:, :5], relevant[:, -44:] = 1, True
    expected = 1 - comb(4000 - 44, 5) / comb(4000, 5)
    assert recall_at(10, scores, relevant, np.ones_like(relevant))[0] == pytest.approx(expected, rel=1e-12)


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
