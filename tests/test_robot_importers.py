"""Importers of public data sets, on pictures made here; the real data only where it lies on this machine."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from robot.errors import ImporterError, RecordingError, UnknownName
from robot.importers import IMPORTERS, load_importer
from robot.importers.billets import import_billets
from robot.recording.folder import RecordingWriter, read_recording

DATA = Path(os.environ.get("TOUCH_DATA", Path(__file__).parents[2] / "shared" / "data"))


def picture(suffix, level):
    return cv2.imencode(suffix, np.full((3, 4, 3), level, np.uint8))[1].tobytes()


def billet(source, name, places):
    (source / name).mkdir(parents=True, exist_ok=True)
    for level, place in enumerate(places):
        (source / name / f"{place}_touch.png").write_bytes(picture(".png", level))
        (source / name / f"{place}_photo.jpg").write_bytes(picture(".jpg", level))
    return source


@pytest.mark.parametrize("name", IMPORTERS)
def test_every_name_loads_a_function(name):
    assert callable(load_importer(name))


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(UnknownName, match="'bilets'; known: billets") as caught:
        load_importer("bilets")
    assert caught.value.exit_code == 2


def test_a_place_becomes_an_object_and_its_billet_the_sequence(tmp_path):
    source = billet(billet(tmp_path / "src", "welded1", ["02", "01"]), "ground1", ["01"])
    (source / "LICENSE").write_text("GPL")
    recording = import_billets(source, tmp_path / "out")
    assert [(grasp.grasp_id, grasp.object_id, grasp.sequence_id) for grasp in recording.grasps] == [
        ("ground1-01", "ground1-01", "ground1"),
        ("welded1-01", "welded1-01", "welded1"),
        ("welded1-02", "welded1-02", "welded1"),
    ]
    assert all(list(grasp.touches) == ["a"] for grasp in recording.grasps)


def test_the_files_are_copied_byte_for_byte(tmp_path):
    source = billet(tmp_path / "src", "welded1", ["01"])
    (grasp,) = import_billets(source, tmp_path / "out").grasps
    touch, photo = tmp_path / "out" / grasp.touches["a"], tmp_path / "out" / grasp.photo
    assert touch.read_bytes() == (source / "welded1/01_touch.png").read_bytes()
    assert photo.read_bytes() == (source / "welded1/01_photo.jpg").read_bytes()
    assert photo.suffix == ".jpg"


def test_the_recording_names_the_licence_and_the_trap(tmp_path):
    recording = import_billets(billet(tmp_path / "src", "welded1", ["01"]), tmp_path / "out")
    assert "GPL-3.0" in recording.info["licence"]
    assert "capture leaking" in recording.info["notes"][0]
    assert "capture leaking" in recording.notes[-1]


def test_incomplete_and_damaged_places_are_skipped_and_told(tmp_path):
    source = billet(tmp_path / "src", "welded1", ["01", "02", "03"])
    (source / "welded1/01_photo.jpg").unlink()
    (source / "welded1/02_touch.png").write_bytes(b"no picture")
    recording = import_billets(source, tmp_path / "out")
    assert [grasp.grasp_id for grasp in recording.grasps] == ["welded1-03"]
    assert recording.notes[0] == "skipped welded1/01_touch.png: its photo or touch is missing"
    assert recording.notes[1].startswith("skipped welded1-02: touch_a must be a PNG or JPEG file")
    assert recording.notes[0] in recording.info["notes"]


def test_two_places_that_would_have_one_name_are_not_mixed(tmp_path):
    source = billet(billet(tmp_path / "src", "a-b", ["c"]), "a", ["b-c"])
    recording = import_billets(source, tmp_path / "out")
    assert [grasp.sequence_id for grasp in recording.grasps] == ["a"]
    assert any("a-b-c" in note and "already" in note for note in recording.notes)


@pytest.mark.parametrize("fill", [False, True])
def test_a_source_without_a_pair_is_a_clear_error_and_makes_nothing(tmp_path, fill):
    if fill:
        (billet(tmp_path / "src", "welded1", ["01"]) / "welded1/01_photo.jpg").unlink()
    with pytest.raises(ImporterError, match=r"must hold pairs <billet>/<place>_touch\.png"):
        import_billets(tmp_path / "src", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_progress_is_told_after_each_grasp(tmp_path):
    calls = []
    source = billet(tmp_path / "src", "w", ["1", "2"])
    import_billets(source, tmp_path / "out", progress=lambda done, total: calls.append((done, total)))
    assert calls == [(1, 2), (2, 2)]


def test_an_import_goes_on_where_it_stopped(tmp_path):
    source = billet(tmp_path / "src", "w", ["1", "2"])

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_billets(source, tmp_path / "out", stop)
    assert len(read_recording(tmp_path / "out").grasps) == 1
    assert len(import_billets(source, tmp_path / "out").grasps) == 2
    again = import_billets(source, tmp_path / "out")
    assert len(again.grasps) == 2
    assert not any(note.startswith("skipped") for note in again.notes)


def test_an_import_does_not_mix_with_another_recording(tmp_path):
    RecordingWriter(tmp_path / "out", {"source": "sim", "sensor": "GelSight"}).close()
    with pytest.raises(RecordingError, match="was recorded with source 'sim'"):
        import_billets(billet(tmp_path / "src", "w", ["1"]), tmp_path / "out")


@pytest.mark.skipif(not (DATA / "billets").is_dir(), reason=f"no billets in {DATA}; set TOUCH_DATA")
def test_the_real_billets_import_whole(tmp_path):
    recording = import_billets(DATA / "billets", tmp_path / "out")
    assert len(recording.grasps) == 9 * 16
    assert len({grasp.sequence_id for grasp in recording.grasps}) == 9
    touch = cv2.imread(str(tmp_path / "out" / recording.grasps[0].touches["a"]))
    assert touch.shape == (240, 320, 3)
