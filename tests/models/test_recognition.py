"""Recognition among many objects: sets of grasps, and the table of a model compared with itself."""

import json

import numpy as np

from models import recognition
from retrieval.data.dataset import load_grasps
from retrieval.metrics.registry import k_way
from retrieval.metrics.table import ScoreTable


def test_a_set_has_one_object_and_leaves_enough_photos():
    owner = np.array([0, 0, 0, 1, 1])
    sets = recognition.grasp_sets(owner, 2, photos=1)
    assert sets.shape == (recognition.SETS, 2)
    assert all(set(rows) < {0, 1, 2} and len(set(rows)) == 2 for rows in sets.tolist())
    assert recognition.grasp_sets(owner, 1, photos=1).tolist() == [[0], [1], [2], [3], [4]]
    assert recognition.grasp_sets(owner, 1, photos=2).tolist() == [[0], [1], [2]]


def test_top1_equals_the_accuracy_of_k_way_tests_also_with_ties():
    rng = np.random.default_rng(0)
    owner = np.arange(12)
    for levels in (2, 1000):  # many ties, and hardly any
        scores = rng.integers(levels, size=(12, 12)).astype(np.float32)
        scored = ScoreTable(scores, owner, owner, np.zeros((12, 12), dtype=bool))
        expected = k_way(scored, 5, draws=1).values[:, 0]
        np.testing.assert_allclose(recognition.top1(scored, 5, 1).values[:, 0], expected, rtol=1e-9)


def test_a_model_does_not_differ_from_itself(recording, model, tmp_path, monkeypatch, capsys):
    for name, value in {"CANDIDATES": (5,), "CATALOGUE": 5, "QUERIES": ((1, 1), (2, 1))}.items():
        monkeypatch.setattr(recognition, name, value)
    models = ("--model", f"one={model}", "--model", f"other={model}")
    assert recognition.main([str(recording), *models, "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "recognition.json").read_text())
    assert rows["one"].keys() == rows["other"].keys() >= {"K = 5, 1 grasp, 1 photo", "K = 5, 2 grasps, 1 photo"}
    measured = rows["other"]["K = 5, 1 grasp, 1 photo"]
    assert measured["chance"] == [0.2]
    assert measured["against_first"]["value"] == 0
    assert measured["queries"] == len(load_grasps(recording))
    assert "| K = 5, 1 grasp, 1 photo | 0.200 |" in capsys.readouterr().out
