"""Example queries, computed by hand: two grasps of each of five objects, one grasp with a wrong top-1."""

import numpy as np
import pytest

from retrieval.evaluation.example_grasps import example_queries
from retrieval.metrics.table import ScoreTable


@pytest.fixture(scope="module")
def table():
    """Grasps 2 n and 2 n + 1 are of object n. A touch finds its object's other photo, but touch 0 ranks b first."""
    owner = np.repeat(np.arange(5), 2)
    scores = 3.0 * (owner[:, None] == owner[None])
    scores[0, 2:4], scores[1, 3] = (5, 4), 2
    return ScoreTable(scores.astype(np.float32), owner, owner, np.eye(10, dtype=bool))


def examples(table, **options):
    names = [f"g{number}" for number in range(10)]
    return example_queries(table, "abcde", names, names, **options)


def test_one_of_each_lists_only_the_best_photo_of_each_object(table):
    worst = examples(table, one_of_each=True)["worst"][0]
    assert (worst["grasp_id"], worst["true_rank"]) == ("g0", 3)
    assert worst["ranked"][:2] == ["g2", "g1"]
    assert len(set(worst["ranked"])) == 5


def test_examples_have_different_objects_and_exclude_the_own_photo(table):
    found = examples(table)
    assert [one["object_id"] for one in found["best"]] == ["b", "c", "d", "e", "a"]
    worst = found["worst"][0]
    assert (worst["grasp_id"], worst["true_rank"], worst["ranked"][:3]) == ("g0", 3.0, ["g2", "g3", "g1"])
    assert all(one["grasp_id"] not in one["ranked"] for one in found["best"])
