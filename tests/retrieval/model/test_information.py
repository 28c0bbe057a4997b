"""Information of an answer and of the next grasp: expected values by hand."""

import math

import pytest

from retrieval.model.information import effective_grasps, information, next_grasp_bits, unlisted_probability
from retrieval.model.posterior import Posterior

HALF = Posterior(slope=2.0, offset=-1.0, dependence=0.5)
FOUR = {"objects": 4, "none_prior": 0.5}


def test_an_answer_over_four_objects_has_the_bits_of_a_calculation_by_hand():
    """None falls from 1/2 to 1/4, one object rises from 1/8 to 1/2, and three objects have 1/4 (before: 3/8)."""
    answer = information(HALF, 1, 0.25, [0.5], **FOUR)
    assert answer.gained_bits == pytest.approx(-0.25 + 1.0 + 0.25 * math.log2(2 / 3))
    assert answer.remaining_bits == pytest.approx(0.5 + 0.5 + 0.25 * math.log2(12))
    assert answer.possible_bits == 3.0
    assert answer.next_effective_grasps == pytest.approx(4 / 3)
    assert answer.next_grasp_bits == pytest.approx(answer.remaining_bits * (1 - math.exp(-1 / 3)))


def test_a_certain_object_gains_all_bits_and_leaves_none():
    answer = information(HALF, 2, 0.0, [1.0, 0.0], **FOUR)
    assert (answer.gained_bits, answer.remaining_bits, answer.next_grasp_bits) == (3.0, 0.0, 0.0)


def test_an_answer_like_the_prior_gains_nothing_whether_objects_are_listed_or_not():
    for listed in ([], [0.125], [0.125] * 4):
        answer = information(HALF, 1, 0.5, listed, **FOUR)
        assert answer.gained_bits == pytest.approx(0, abs=1e-12)
        assert answer.gained_bits >= 0
        assert answer.remaining_bits == pytest.approx(0.5 + 0.5 * 3)


def test_without_a_prior_of_none_the_possible_bits_are_those_of_the_objects():
    answer = information(HALF, 1, 0.0, [0.25] * 4, objects=4, none_prior=0.0)
    assert (answer.gained_bits, answer.remaining_bits, answer.possible_bits) == (0.0, 2.0, 2.0)


@pytest.mark.parametrize(("dependence", "expected"), [(0.0, [1, 2, 3]), (0.5, [1, 4 / 3, 1.5]), (1.0, [1, 1, 1])])
def test_dependent_grasps_are_equivalent_to_fewer_independent_ones(dependence, expected):
    found = [effective_grasps(Posterior(slope=0.3, dependence=dependence), grasps) for grasps in (1, 2, 3)]
    assert found == pytest.approx(expected)


def test_an_independent_grasp_leaves_one_part_in_e_and_a_fully_dependent_one_leaves_all():
    assert next_grasp_bits(Posterior(dependence=0.0), 1, 2.0) == pytest.approx(2 * (1 - 1 / math.e))
    assert next_grasp_bits(Posterior(dependence=1.0), 1, 2.0) == 0


def test_unlisted_objects_have_the_rest_of_the_probability():
    assert unlisted_probability(0.25, [0.5, 0.125]) == 0.125
    assert unlisted_probability(0.5, [0.3, 0.2000000001]) == 0.0
