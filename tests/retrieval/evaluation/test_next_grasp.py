"""Choice of the next grasp, replayed on recorded grasps: hand-made scores whose best choices are known."""

import math

import numpy as np
import pytest

from retrieval.evaluation.next_grasp import CATALOGUES, grasps_needed, replay, score_next_grasp
from retrieval.evaluation.predictions import Predictions
from retrieval.evaluation.queries import Queries
from retrieval.model.posterior import ScoredTouches

HEIGHTS_MM = [10.0, 11.0, 12.0, 13.0, 80.0, 14.0]
PLACES = np.array(HEIGHTS_MM * 3)[:, None]
"""Places of the touches of three objects."""


def scored(objects=3, seed=0, clear=(4,)):
    """Return six touches of each object and a photo of each.

    The logit of the true object is 5 higher after the grasps in `clear`; before them a wrong object leads by 1.
    """
    owner = np.repeat(np.arange(objects), len(HEIGHTS_MM))
    logits = np.zeros((len(owner), len(owner)))
    for row, name in enumerate(owner):
        logits[row, owner == (name + 1) % objects] = 1.0
        if row % len(HEIGHTS_MM) in clear:
            logits[row, owner == name] = 6.0
    return ScoredTouches(logits, owner, owner, np.eye(len(owner), dtype=bool))


def replayed(clear=(4,), seed=0):
    found = scored(clear=clear)
    return replay(found, PLACES, seed)


def test_the_spread_policy_takes_the_grasp_at_the_most_different_height():
    owner, correct = replayed()
    far = correct["spread"]
    # The grasp at 80 mm is clear; from any other one it is the farthest, unless its photo is the catalogue's.
    assert far[:, 1].mean() >= 0.6
    for policy in ("random", "repeated"):
        assert correct[policy][:, 1].sum() < far[:, 1].sum()
    assert len(owner) == len(far) == CATALOGUES * 15  # five grasps of each object; one gives the catalogue's photo


def test_places_may_have_several_coordinates():
    aside = np.column_stack([np.zeros(18), np.array([0.0, 0.0, 0.0, 0.0, 70.0, 0.0] * 3)])  # all at the same height
    _, by_height = replay(scored(), aside[:, :1], 0)
    _, by_place = replay(scored(), aside, 0)
    assert by_place["spread"][:, 1].sum() > by_height["spread"][:, 1].sum()


def test_the_upper_bound_takes_the_grasp_after_which_the_true_object_leads_by_most():
    _, correct = replayed(clear=(2,))  # 2 mm above the lowest: the spread policy does not go there second
    assert correct["upper_bound"][:, 1].sum() > correct["spread"][:, 1].sum()


def test_a_repeated_grasp_changes_nothing():
    _, correct = replayed(clear=(0, 1, 4))
    assert (correct["repeated"] == correct["repeated"][:, :1]).all()


def test_all_policies_have_the_same_first_grasps():
    _, correct = replayed(clear=(0, 4))
    assert len({each[:, 0].tobytes() for each in correct.values()}) == 1


def test_a_touch_is_not_compared_with_the_photo_of_its_own_grasp():
    found = scored(clear=())
    logits = found.logits + 100.0 * found.own  # with its own photo, each touch would find its object
    _, correct = replay(ScoredTouches(logits, found.touch_owner, found.photo_owner, found.own), PLACES, 0)
    assert not correct["upper_bound"].any()


@pytest.mark.parametrize(
    ("accuracy", "expected"),
    [([0.9, 0.95], 1.0), ([0.7, 0.9], 1.5), ([0.6, 0.7, 0.8], 3.0), ([0.5, 0.6], math.inf)],
)
def test_the_number_of_grasps_to_80_percent_is_interpolated(accuracy, expected):
    assert grasps_needed(np.array(accuracy)) == pytest.approx(expected)


def evaluated(heights_mm, clear=(4,)):
    found = scored(clear=clear)
    places = np.arange(len(found.touch_owner))
    names = tuple(f"object-{number}" for number in range(3))
    queries = Queries(places, places, places, found.touch_owner, found.photo_owner, names, ("test",) * 3, {})
    return score_next_grasp(queries, [Predictions(found.logits.astype(np.float32), {}, {}, {})], heights_mm, 0)


def test_the_results_give_each_policy_its_accuracy_and_the_grasps_that_it_needs():
    found = evaluated(HEIGHTS_MM * 3, clear=(0, 1, 2, 3, 4, 5))
    assert (found["candidates"], found["objects"], found["sequences"]) == (3, 3, CATALOGUES * 15)
    assert found["policies"]["random"]["accuracy"] == [[1.0, 1.0, 1.0]] * 5
    assert found["policies"]["spread"]["grasps_needed"] == {"value": 1.0, "low": 1.0, "high": 1.0}
    assert found["policies"]["spread"]["relative_to_random"]["value"] == 1.0


def test_an_accuracy_that_is_not_reached_needs_no_number_of_grasps():
    found = evaluated(HEIGHTS_MM * 3, clear=())["policies"]["repeated"]
    assert found["grasps_needed"] == found["relative_to_random"] == {"value": None, "low": None, "high": None}


def test_a_policy_that_alone_reaches_the_accuracy_has_no_ratio_to_random():
    found = evaluated(HEIGHTS_MM * 3, clear=(4,))["policies"]
    assert found["random"]["grasps_needed"]["value"] is None
    assert found["upper_bound"]["relative_to_random"]["value"] is None


def test_without_heights_there_is_nothing_to_choose():
    assert evaluated([None] * 18) is None
