"""Photos and presses of simulated objects, with their labels."""

import json

import cv2
import numpy as np
import pytest

from robot.errors import RecordingError, RobotConfigError
from robot.rig import load_rig
from robot.sim.pictures import collect_pictures


def rows(folder):
    return [json.loads(line) for line in (folder / "metadata.jsonl").read_text().splitlines()]


def files(folder):
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_every_object_has_a_photo_and_its_labels(tmp_path):
    assert collect_pictures("photo", tmp_path / "p", objects=3, seed=5) == 3
    rig, found = load_rig("sim", seed=5), rows(tmp_path / "p")
    assert [row["object_id"] for row in found] == rig.object_ids(3)
    for row in found:
        assert {name: row[name] for name in rig.labels(row["object_id"])} == rig.labels(row["object_id"])
        assert row["object_id"].startswith(f"{row['shape']}-{row['relief']}-")
        assert cv2.imread(str(tmp_path / "p" / row["file_name"])).shape == (256, 256, 3)


def test_a_photo_equals_that_of_the_rig(tmp_path):
    collect_pictures("photo", tmp_path / "p", objects=1, seed=5)
    rig, row = load_rig("sim", seed=5), rows(tmp_path / "p")[0]
    rig.prepare(row["object_id"], 0)
    with rig:
        photo = rig.camera.read(depth=False).colour
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "p" / row["file_name"]))[..., ::-1], photo)


def test_every_press_has_both_fingers_with_a_no_contact_frame(tmp_path):
    count = collect_pictures("touch", tmp_path / "t", objects=3, seed=5)
    found = rows(tmp_path / "t")
    assert count == len(found) == 6
    assert [row["finger"] for row in found] == ["a", "b"] * 3
    differences = []
    for row in found:
        pressed, before = (cv2.imread(str(tmp_path / "t" / row[name])) for name in ("file_name", "before_file_name"))
        assert pressed.shape == before.shape == (240, 320, 3)
        differences.append(np.abs(pressed.astype(int) - before).max())
    assert max(differences) > 40


def test_a_press_renders_no_camera_image():
    rig = load_rig("sim", seed=5)
    rig.press(rig.object_ids(1)[0], 0)
    assert rig.sim_state.current_scene().passes["view"] == rig.sim_state.current_scene().passes["photo"] == 0


def test_an_interrupted_run_continues_and_writes_the_same_files(tmp_path):
    collect_pictures("photo", tmp_path / "whole", objects=4, seed=5)
    collect_pictures("photo", tmp_path / "parts", objects=2, seed=5)
    with open(tmp_path / "parts" / "metadata.jsonl", "a") as file:
        file.write('{"file_name": "ima')
    assert collect_pictures("photo", tmp_path / "parts", objects=4, seed=5, jobs=2) == 4
    assert files(tmp_path / "parts") == files(tmp_path / "whole")


@pytest.mark.parametrize("left", [".metadata.jsonl.0a.tmp", ".pictures.json.0a.tmp"])
def test_a_run_killed_while_creating_its_folder_can_be_started_again(tmp_path, left):
    (tmp_path / left).write_bytes(b'{"ki')
    assert collect_pictures("photo", tmp_path, objects=1, seed=5) == 1


def test_pictures_of_other_settings_and_other_folders_are_not_changed(tmp_path):
    collect_pictures("photo", tmp_path / "p", objects=1, seed=5)
    before = files(tmp_path / "p")
    for kind, seed in (("photo", 6), ("touch", 5)):
        with pytest.raises(RecordingError, match="made with other settings"):
            collect_pictures(kind, tmp_path / "p", objects=1, seed=seed)
    assert files(tmp_path / "p") == before
    (tmp_path / "p" / "metadata.jsonl").write_text("{}\n")
    with pytest.raises(RecordingError, match="does not describe a picture"):
        collect_pictures("photo", tmp_path / "p", objects=1, seed=5)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("hello")
    with pytest.raises(RecordingError, match="something else"):
        collect_pictures("photo", tmp_path / "other", objects=1, seed=5)


def test_an_unknown_kind_of_picture_is_refused(tmp_path):
    with pytest.raises(RobotConfigError, match="kind photo or touch"):
        collect_pictures("depth", tmp_path / "p", objects=1, seed=5)


def test_progress_counts_objects(tmp_path):
    reports = []
    collect_pictures("photo", tmp_path / "p", objects=2, seed=5, progress=lambda *counts: reports.append(counts))
    assert reports == [(1, 2), (2, 2)]
