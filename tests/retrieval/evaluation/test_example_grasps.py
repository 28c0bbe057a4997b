"""The grasps that a reader is shown for a number, by hand: two grasps of each of five objects, one grasp mistaken."""

import numpy as np
import pytest

from retrieval.evaluation.example_grasps import ExampleGrasps
from retrieval.metrics.table import ScoreTable

NAMES = ("a", "b", "c", "d", "e")


@pytest.fixture(scope="module")
def shown():
    """Grasps 2 n and 2 n + 1 are of object n. A touch finds its object's other photo, but touch 0 finds b's first."""
    every, owner = np.arange(10), np.repeat(np.arange(5), 2)
    scores = 3.0 * (owner[:, None] == owner[None])
    scores[0, 2:4], scores[1, 3] = (5, 4), 2
    table = ScoreTable(scores.astype(np.float32), owner, owner, np.eye(10, dtype=bool))
    names = [f"g{number}" for number in every]
    return ExampleGrasps(table, NAMES, names, names)


def test_of_every_object_that_is_found_the_best_photo_alone_is_shown_where_so_asked(shown):
    worst = shown.examples(one_of_each=True)["worst"][0]
    assert (worst["grasp_id"], worst["true_rank"]) == ("g0", 3)
    assert worst["ranked"][:2] == ["g2", "g1"]
    assert len(set(worst["ranked"])) == 5
    assert shown.examples()["worst"][0]["ranked"][:3] == ["g2", "g3", "g1"]


def test_of_a_confusion_the_touches_come_first_that_speak_most_for_it_with_the_photo_that_does(shown):
    assert shown.confusion_examples(0, 1) == [
        {"grasp_id": "g0", "object_id": "a", "found": "g2"},
        {"grasp_id": "g1", "object_id": "a", "found": "g3"},
    ]


def test_of_a_guess_those_are_shown_that_it_finds_one_of_an_object_and_none_that_another_guess_finds(shown):
    first, second, *others = shown.guessed(5, seed=0)
    assert [(one["grasp_id"], one["found"]) for one in first] == [
        ("g1", "g0"),
        ("g2", "g3"),
        ("g4", "g5"),
        ("g6", "g7"),
    ]
    assert second == [{"grasp_id": "g0", "object_id": "a", "found": "g2"}]
    assert others == [[], [], []]


def test_of_more_candidates_than_objects_none_are_shown(shown):
    assert shown.guessed(10, seed=0) == []


def test_the_best_and_the_worst_are_of_different_objects_and_no_photo_is_shown_to_its_own_touch(shown):
    found = shown.examples()
    assert [one["object_id"] for one in found["best"]] == ["b", "c", "d", "e", "a"]
    worst = found["worst"][0]
    assert (worst["grasp_id"], worst["true_rank"], worst["ranked"][:3]) == ("g0", 3.0, ["g2", "g3", "g1"])
    assert all(one["grasp_id"] not in one["ranked"] for one in found["best"])
