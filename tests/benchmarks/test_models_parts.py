"""Benchmarks of the parts of a training, of errors, and of sequential verification: hand-made values."""

import numpy as np
import pytest

from benchmarks.models.failures import accuracy_table, between, rival_table
from benchmarks.models.parts import PARTS, WHOLE, first_objects
from benchmarks.models.verify import decisions
from retrieval.data.dataset import Grasp
from retrieval.data.labelled_pictures import ObjectLabels
from retrieval.model.config import load_config
from retrieval.model.verification import DecisionBounds, ErrorRate
from retrieval.training.features import Features


def test_each_part_that_is_left_out_is_one_change_of_the_configuration():
    config = load_config("relief-large")
    changed = {name: change(config) for name, change in PARTS.items()}
    assert changed.pop(WHOLE) == config
    tables = {
        name: [getattr(one, part) != getattr(config, part) for part in vars(config)] for name, one in changed.items()
    }
    assert all(sum(differs) == 1 for differs in tables.values())


def test_the_objects_of_a_smaller_training_are_among_those_of_a_larger_one():
    names = tuple(f"o{number}" for number in (3, 1, 1, 2, 0))
    features = Features(tuple("abcde"), names, np.zeros((5, 1, 2), np.float32), np.zeros((5, 2), np.float32))
    assert first_objects(features, 2).object_ids == ("o3", "o1", "o1")
    assert first_objects(features, 9) is features


ANY = ErrorRate(0.1, 0.0, 0.2)


def test_a_sequence_is_decided_at_the_first_bound_that_it_reaches():
    bounds = DecisionBounds(3.0, -1.0, ANY, ANY, ANY, (0.5, 0.6, 0.7, 0.8))
    ratios = np.array(
        [
            [3.5, 0.0, 0.0, 0.0],  # accepted at once
            [1.0, 2.0, 3.0, -9.0],  # accepted after three grasps
            [-1.0, 9.0, 9.0, 9.0],  # rejected at once: the later grasps are not made
            [0.0, 1.0, 2.0, 2.5],  # no bound is reached: rejected after the last grasp
        ]
    )
    accepted, grasps = decisions(bounds, ratios)
    assert accepted.tolist() == [True, True, False, False]
    assert grasps.tolist() == [1, 3, 1, 4]


LABELS = {
    "ribbed mug": ObjectLabels(("ribs", "mug"), (3.0, 0.5, 1.0, 0.5)),
    "dotted mug": ObjectLabels(("dots", "mug"), (9.0, 0.1, 1.0, 0.5)),
    "ribbed tin": ObjectLabels(("ribs", "tin"), (3.0, 0.5, 1.0, 0.5)),
    "smooth tin": ObjectLabels(("smooth", "tin"), (3.0, 0.0, 1.0, 0.5)),
}


def test_errors_are_counted_by_property_and_by_what_the_confused_objects_share(tmp_path):
    grasps = [Grasp(name, name, None, tmp_path, (), ()) for name in LABELS]
    first = np.array([2, 1, 1, 3])  # ribbed mug -> ribbed tin, ribbed tin -> dotted mug, the others are right
    table = "\n".join(accuracy_table(grasps, first, LABELS))
    assert "| relief | ribs | 2 | 0.000 [0.000, 0.000] |" in table
    assert "| relief | smooth | 1 | 1.000" in table
    assert "| pitch | 2 to 4 mm | 2 | 0.000 [0.000, 0.000] |" in table
    rivals = rival_table(grasps, first, LABELS)
    assert rivals[2:] == [
        "| relief and shape | 0.00 | 0.00 |",
        "| relief, another shape | 0.50 | 0.17 |",
        "| shape, another relief | 0.00 | 0.33 |",
        "| neither | 0.50 | 0.50 |",
    ]


@pytest.mark.parametrize(("length", "expected"), [(1.0, "0 to 2 mm"), (2.5, "2 to 4 mm"), (9.0, "above 4 mm")])
def test_a_length_lies_between_two_limits(length, expected):
    assert between(length, (2.0, 4.0)) == expected
