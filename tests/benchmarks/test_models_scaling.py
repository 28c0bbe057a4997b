"""A small run of the scaling experiment."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.models import scaling
from retrieval.metrics.table import ScoreTable
from retrieval.training.features import Features
from tests import synthetic
from tests.labelled_pictures import label_recording


def test_every_training_set_is_scored_on_the_same_unseen_objects(recording, tmp_path, capsys):
    unseen = synthetic.write_recording(tmp_path / "unseen", synthetic.make_objects(11, seed=5), 2)
    sizes = ("--objects", "4", "100", "--grasps", "1", "3", "--validation", "3", "--iterations", "2")
    options = ("--preset", "tiny", "--init", "random", "--methods", "late_fusion", "cca")
    assert scaling.main([str(recording), str(unseen), "--out", str(tmp_path / "out"), *options, *sizes]) == 0
    points = json.loads((tmp_path / "out" / "scaling.json").read_text())["points"]
    measured = [(point["method"], point["objects"], point["grasps"], point["touches"]) for point in points]
    # 12 objects less 3 for validation leave 9, so 100 becomes 9.
    expected = [(4, 3, 12), (9, 3, 27), (9, 1, 9)]
    assert measured == [(method, *size) for size in expected for method in ("late_fusion", "cca")]
    assert all(point["topn_k10"]["queries"] == 22 and point["topn_k10"]["objects"] == 11 for point in points)
    assert capsys.readouterr().out.count("| late_fusion | 9 | 3 |") == 2  # once when it is measured, once in the table
    assert (tmp_path / "out" / "scaling.png").stat().st_size > 10_000


def test_numbers_of_touched_and_photo_only_objects_are_combined(recording, tmp_path):
    unseen = synthetic.write_recording(tmp_path / "unseen", synthetic.make_objects(11, seed=5), 2)
    apart = synthetic.write_recording(tmp_path / "apart", synthetic.make_objects(6, seed=7), 1)
    pictures = [word for name, folder in label_recording(apart, tmp_path).items() for word in (f"--{name}", folder)]
    sizes = ("--objects", "0", "4", "--photographed", "0", "4", "99", "--grasps", "2", "--validation", "3")
    options = ("--preset", "tiny", "--init", "random", "--methods", "cca", *sizes, *pictures)
    assert scaling.main([str(recording), str(unseen), "--out", str(tmp_path / "out"), *options]) == 0
    points = json.loads((tmp_path / "out" / "scaling.json").read_text())["points"]
    measured = [(point["objects"], point["photographed"], point["touches"]) for point in points]
    assert measured == [(0, 4, 4), (0, 6, 6), (4, 0, 8), (4, 4, 12), (4, 6, 14)]
    assert (tmp_path / "out" / "scaling.png").stat().st_size > 10_000


def test_randomised_methods_are_trained_for_each_seed_and_their_numbers_are_means(recording, tmp_path):
    unseen = synthetic.write_recording(tmp_path / "unseen", synthetic.make_objects(11, seed=5), 2)
    sizes = ("--objects", "9", "--grasps", "2", "--validation", "3", "--iterations", "2")
    options = ("--preset", "tiny", "--init", "random", "--methods", "late_fusion", "cca", *sizes)
    points = {}
    for seeds in ("1", "2"):
        out = tmp_path / seeds
        assert scaling.main([str(recording), str(unseen), "--out", str(out), "--seeds", seeds, *options]) == 0
        points[seeds] = {point["method"]: point for point in json.loads((out / "scaling.json").read_text())["points"]}
    assert {name: point["seeds"] for name, point in points["2"].items()} == {"late_fusion": 2, "cca": 1}
    assert points["2"]["cca"]["topn_k5"] == points["1"]["cca"]["topn_k5"]
    assert points["1"]["late_fusion"]["together"]["topn_k5"] == points["1"]["late_fusion"]["topn_k5"]
    assert points["2"]["late_fusion"]["topn_k5"]["value"] != points["1"]["late_fusion"]["topn_k5"]["value"]


def test_the_scores_of_several_trainings_are_averaged():
    owner, own = np.array([0, 1]), np.eye(2, dtype=bool)
    tables = [
        ScoreTable(np.array(scores, np.float32), owner, owner, own) for scores in ([[1, 2], [3, 4]], [[3, 0], [5, 2]])
    ]
    assert scaling.mean_scores(tables).scores.tolist() == [[2, 1], [4, 3]]


def test_with_known_relief_photos_of_another_relief_come_last():
    constant = SimpleNamespace(
        encode_touch=lambda touch: touch,
        encode_photo=lambda photo: photo,
        score=lambda touch, photo: np.tile(np.arange(len(photo), dtype=np.float32), (len(touch), 1)),
    )
    names = ("mug-ribs-0-1", "tin-ribs-0-2", "tin-dots-0-3")
    features = Features(names, names, np.zeros((3, 1, 1), np.float32), np.zeros((3, 1), np.float32))
    ranked = [
        np.argsort(-scaling.scores_of(constant, features, known).scores, axis=1).tolist()
        for known in (None, "relief", "shape", "both")
    ]
    assert ranked == [
        [[2, 1, 0], [2, 1, 0], [2, 1, 0]],
        [[1, 0, 2], [1, 0, 2], [2, 1, 0]],
        [[0, 2, 1], [2, 1, 0], [2, 1, 0]],
        [[0, 2, 1], [1, 2, 0], [2, 1, 0]],
    ]


def test_the_opening_of_the_jaws_is_one_more_feature_of_each_finger(tmp_path, monkeypatch):
    lines = [SimpleNamespace(grasp_id="g1", opening_mm=31.5), SimpleNamespace(grasp_id="g2", opening_mm=7.0)]
    monkeypatch.setattr(scaling, "read_recording", lambda folder: SimpleNamespace(grasps=lines))
    touches, photos = np.ones((2, 2, 1), np.float32), np.zeros((2, 4), np.float32)
    touch = scaling.with_opening(Features(("g2", "g1"), ("a", "b"), touches, photos), tmp_path).touch
    assert touch.dtype == np.float32
    assert touch.tolist() == [[[1, 7], [1, 7]], [[1, 31.5], [1, 31.5]]]


@pytest.mark.parametrize(("maximum", "rows"), [(1, [0, 1]), (2, [0, 1, 2, 3]), (9, [0, 1, 2, 3, 4])])
def test_the_first_grasps_of_each_object_are_selected(maximum, rows):
    touch, photo = np.zeros((5, 2, 3), np.float32), np.zeros((5, 4), np.float32)
    features = Features(tuple("vwxyz"), ("b", "a", "a", "b", "a"), touch, photo)
    assert scaling.first_grasps(features, maximum).grasp_ids == tuple("vwxyz"[row] for row in rows)
