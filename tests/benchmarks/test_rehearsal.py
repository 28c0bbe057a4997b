"""The rehearsal: every command accepts the recording of a rig of real drivers unchanged."""

import pytest

from benchmarks.rehearsal import rehearse
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.build.build_index import build_index
from retrieval.search.defaults import shipped_model
from retrieval.search.query.searcher import Searcher
from robot.recording.folder import read_info, read_recording


@pytest.mark.slow
def test_a_replayed_recording_gives_the_same_search_results_as_its_source(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    source, made = rehearse(tmp_path, objects=8, grasps=1)
    replayed = {grasp.grasp_id: grasp for grasp in read_recording(source).grasps}
    recorded = read_recording(made).grasps
    info = read_info(made)
    assert info["rig"] == "real"
    assert info["devices"]["WSG-50"]["info"]["serial"] == 20260101
    assert sum(bool(grasp.grasped) for grasp in recorded) == 8
    build_index(tmp_path / "catalog", load_checkpoint(shipped_model()), tmp_path / "shipped-index")
    searcher = Searcher.open(tmp_path / "shipped-index")
    answers = 0
    for grasp in recorded:
        before = replayed[grasp.grasp_id]
        assert (grasp.outcome == "held") == (before.outcome == "held")  # a slip is emulated as a miss
        assert set(grasp.touches_after) == {"a", "b"}
        if grasp.outcome != "held":
            continue
        assert abs(grasp.opening_mm - before.opening_mm) < 1.0
        top1_objects = []
        for folder, each in ((source, before), (made, grasp)):
            touch = [folder / each.touches[finger] for finger in "ab"]
            top1_objects.append([found.object_id for found in searcher.query([touch], top=1).results])
        assert top1_objects[0] == top1_objects[1]
        answers += len(top1_objects[0])
    assert answers >= 6  # the shipped checkpoint may take a weak press for no contact
