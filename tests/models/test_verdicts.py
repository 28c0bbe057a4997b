"""The table of verdicts of the shipped checkpoint, on a few objects."""

import json

import pytest

from models import verdicts


@pytest.mark.slow
def test_verdicts_are_counted_for_each_catalogue_and_kind_of_input(tmp_path, monkeypatch):
    smallest = {
        "TOUCHED": 3, "PHOTOGRAPHED": 6, "GRASPS": 3, "SIZES": (2, 4), "SET_SIZES": (1, 2), "INPUTS": 9, "DRAWS": 5,
        "OTHER_OBJECTS": 2,
    }  # fmt: skip
    for name, value in smallest.items():
        monkeypatch.setattr(verdicts, name, value)
    monkeypatch.setenv("TOUCH_DATA", str(tmp_path / "missing"))
    assert verdicts.main([str(tmp_path), "--jobs", "1"]) == 0
    made = json.loads((tmp_path / "verdicts.json").read_text())
    assert [(row["objects"], row["grasps"]) for row in made["catalogues"]] == [(2, 1), (4, 1), (2, 2), (4, 2)]
    assert all(0 <= row["match_and_right"][0] <= row["top1"][0] <= 1 for row in made["catalogues"])
    touches = next(row for row in made["inputs"] if row["input"] == "touches")
    assert touches["count"] == sum(touches["called"].values()) == 9
    assert (tmp_path / "verdicts.md").exists()
    assert (tmp_path / "risk.png").exists()
