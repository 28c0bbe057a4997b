"""The scaling experiment, in small."""

import json

import numpy as np
import pytest

from retrieval.training.features import Features
from tests import scaling, synthetic
from tests.labelled import label_recording


def test_every_training_set_is_judged_on_the_same_unseen_objects(recording, tmp_path, capsys):
    unseen = synthetic.write_recording(tmp_path / "unseen", synthetic.make_objects(11, seed=5), 2)
    sizes = ("--objects", "4", "100", "--grasps", "1", "3", "--validation", "3", "--iterations", "2")
    options = ("--preset", "tiny", "--init", "random", "--methods", "late_fusion", "cca")
    assert scaling.main([str(recording), str(unseen), "--out", str(tmp_path / "out"), *options, *sizes]) == 0
    points = json.loads((tmp_path / "out" / "scaling.json").read_text())["points"]
    asked = [(point["method"], point["objects"], point["grasps"], point["touches"]) for point in points]
    # 12 objects less 3 of validation: 100 are not there, 9 are.
    wanted = [(4, 3, 12), (9, 3, 27), (9, 1, 9)]
    assert asked == [(method, *size) for size in wanted for method in ("late_fusion", "cca")]
    assert all(point["guesses_k10"]["queries"] == 22 and point["guesses_k10"]["objects"] == 11 for point in points)
    assert capsys.readouterr().out.count("| late_fusion | 9 | 3 |") == 2  # when it is there, and in the table
    assert (tmp_path / "out" / "scaling.png").stat().st_size > 10_000


def test_felt_and_photographed_objects_are_crossed(recording, tmp_path):
    unseen = synthetic.write_recording(tmp_path / "unseen", synthetic.make_objects(11, seed=5), 2)
    apart = synthetic.write_recording(tmp_path / "apart", synthetic.make_objects(6, seed=7), 1)
    pictures = [word for name, folder in label_recording(apart, tmp_path).items() for word in (f"--{name}", folder)]
    sizes = ("--objects", "0", "4", "--photographed", "0", "4", "99", "--grasps", "2", "--validation", "3")
    options = ("--preset", "tiny", "--init", "random", "--methods", "cca", *sizes, *pictures)
    assert scaling.main([str(recording), str(unseen), "--out", str(tmp_path / "out"), *options]) == 0
    points = json.loads((tmp_path / "out" / "scaling.json").read_text())["points"]
    asked = [(point["objects"], point["photographed"], point["touches"]) for point in points]
    assert asked == [(0, 4, 4), (0, 6, 6), (4, 0, 8), (4, 4, 12), (4, 6, 14)]
    assert (tmp_path / "out" / "scaling.png").stat().st_size > 10_000


@pytest.mark.parametrize(("most", "kept"), [(1, [0, 1]), (2, [0, 1, 2, 3]), (9, [0, 1, 2, 3, 4])])
def test_the_first_grasps_of_each_object_are_kept(most, kept):
    touch, photo = np.zeros((5, 2, 3), np.float32), np.zeros((5, 4), np.float32)
    features = Features(tuple("vwxyz"), ("b", "a", "a", "b", "a"), touch, photo)
    assert scaling.first_grasps(features, most).grasp_ids == tuple("vwxyz"[row] for row in kept)
