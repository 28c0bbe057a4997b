"""Importer of billets; test_importers.py tests the common behaviour."""

import cv2
import pytest

from robot.errors import ImporterError, RecordingError
from robot.importers.billets import import_billets
from robot.recording.folder import RecordingWriter
from tests.data import touch_data
from tests.miniatures import billets, picture


@pytest.fixture
def source(tmp_path):
    billets.write(tmp_path / "src")
    return tmp_path / "src"


def test_a_place_becomes_an_object_and_its_billet_the_sequence(source, tmp_path):
    recording = import_billets(source, tmp_path / "out")
    assert [(grasp.grasp_id, grasp.object_id, grasp.sequence_id) for grasp in recording.grasps] == [
        ("ground1-01", "ground1-01", "ground1"),
        ("welded1-01", "welded1-01", "welded1"),
        ("welded1-02", "welded1-02", "welded1"),
    ]


def test_the_files_are_copied_byte_for_byte(source, tmp_path):
    grasp = import_billets(source, tmp_path / "out").grasps[1]
    touch, photo = tmp_path / "out" / grasp.touches["a"], tmp_path / "out" / grasp.photo
    assert touch.read_bytes() == (source / "welded1/01_touch.png").read_bytes()
    assert photo.read_bytes() == (source / "welded1/01_photo.jpg").read_bytes()


def test_the_recording_states_the_licence_and_the_caveat(source, tmp_path):
    recording = import_billets(source, tmp_path / "out")
    assert "GPL-3.0" in recording.info["licence"]
    assert "leakage from the capture" in recording.info["notes"][0]


def test_incomplete_and_damaged_places_are_skipped_with_a_note(source, tmp_path):
    (source / "welded1/01_photo.jpg").unlink()
    (source / "welded1/02_touch.png").write_bytes(b"no picture")
    recording = import_billets(source, tmp_path / "out")
    assert [grasp.grasp_id for grasp in recording.grasps] == ["ground1-01"]
    assert recording.notes[:2] == (
        "skipped 1: its photo or touch is missing, such as welded1/01_touch.png",
        "skipped 1: its touch a is not a readable PNG or JPEG file, such as welded1-02",
    )


def test_two_places_with_the_same_grasp_id_are_not_mixed(source, tmp_path):
    for folder, place in (("a-b", "c"), ("a", "b-c")):
        picture(source / folder / f"{place}_touch.png", 1)
        picture(source / folder / f"{place}_photo.jpg", 2)
    recording = import_billets(source, tmp_path / "out")
    assert [grasp.sequence_id for grasp in recording.grasps if grasp.grasp_id == "a-b-c"] == ["a"]
    assert any("another grasp has the same name, such as a-b-c" in note for note in recording.notes)


def test_a_source_without_a_pair_is_a_clear_error(tmp_path):
    picture(tmp_path / "src/welded1/01_touch.png", 1)
    with pytest.raises(ImporterError, match=r"must contain pairs <billet>/<place>_touch\.png"):
        import_billets(tmp_path / "src", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_import_into_another_recording_is_refused(source, tmp_path):
    RecordingWriter(tmp_path / "out", {"source": "sim", "sensor": "GelSight"}).close()
    with pytest.raises(RecordingError, match="was recorded with source 'sim'"):
        import_billets(source, tmp_path / "out")


def test_the_real_billets_are_imported_completely(tmp_path):
    recording = import_billets(touch_data("billets"), tmp_path / "out")
    assert len(recording.grasps) == 9 * 16
    assert len({grasp.sequence_id for grasp in recording.grasps}) == 9
    touch = cv2.imread(str(tmp_path / "out" / recording.grasps[0].touches["a"]))
    assert touch.shape == (240, 320, 3)
