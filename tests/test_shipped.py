"""The shipped checkpoint, judged in small."""

import json

import pytest

from tests import shipped


@pytest.mark.slow
def test_the_shipped_checkpoint_is_far_above_chance_on_objects_it_never_saw(tmp_path, monkeypatch):
    monkeypatch.setattr(shipped, "FITTED", 3)
    assert shipped.main(["score", str(tmp_path), "--objects", "13", "--grasps", "2", "--jobs", "1"]) == 0
    measures = json.loads((tmp_path / "report" / "results.json").read_text())["methods"]["late_fusion"]["measures"]
    assert measures["guesses_k5"]["objects"] == 7
    assert measures["guesses_k5"]["value"][0] > 0.4  # chance 0.2
