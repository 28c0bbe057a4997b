"""Example grasps, computed by hand: two grasps of each of five objects, one grasp with a wrong top-1."""

import numpy as np
import pytest

from retrieval.evaluation.example_grasps import ExampleGrasps
from retrieval.metrics.table import ScoreTable

NAMES = ("a", "b", "c", "d", "e")


@pytest.fixture(scope="module")
def examples():
    """Grasps 2 n and 2 n + 1 are of object n. A touch finds its object's other photo, but touch 0 ranks b first."""
    every, owner = np.arange(10), np.repeat(np.arange(5), 2)
    scores = 3.0 * (owner[:, None] == owner[None])
    scores[0, 2:4], scores[1, 3] = (5, 4), 2
    table = ScoreTable(scores.astype(np.float32), owner, owner, np.eye(10, dtype=bool))
    names = [f"g{number}" for number in every]
    return ExampleGrasps(table, NAMES, names, names)


def test_one_of_each_lists_only_the_best_photo_of_each_object(examples):
    worst = examples.examples(one_of_each=True)["worst"][0]
    assert (worst["grasp_id"], worst["true_rank"]) == ("g0", 3)
    assert worst["ranked"][:2] == ["g2", "g1"]
    assert len(set(worst["ranked"])) == 5
    assert examples.examples()["worst"][0]["ranked"][:3] == ["g2", "g3", "g1"]


def test_confusion_examples_are_sorted_by_margin_with_their_best_photo(examples):
    assert examples.confusion_examples(0, 1) == [
        {"grasp_id": "g0", "object_id": "a", "found": "g2"},
        {"grasp_id": "g1", "object_id": "a", "found": "g3"},
    ]


def test_examples_by_rank_list_one_touch_of_each_object_at_its_rank(examples):
    first, second, *others = examples.examples_by_rank(5, seed=0)
    assert [(one["grasp_id"], one["found"]) for one in first] == [
        ("g1", "g0"),
        ("g2", "g3"),
        ("g4", "g5"),
        ("g6", "g7"),
    ]
    assert second == [{"grasp_id": "g0", "object_id": "a", "found": "g2"}]
    assert others == [[], [], []]


def test_more_candidates_than_objects_give_no_examples(examples):
    assert examples.examples_by_rank(10, seed=0) == []


def test_examples_have_different_objects_and_exclude_the_own_photo(examples):
    found = examples.examples()
    assert [one["object_id"] for one in found["best"]] == ["b", "c", "d", "e", "a"]
    worst = found["worst"][0]
    assert (worst["grasp_id"], worst["true_rank"], worst["ranked"][:3]) == ("g0", 3.0, ["g2", "g3", "g1"])
    assert all(one["grasp_id"] not in one["ranked"] for one in found["best"])
