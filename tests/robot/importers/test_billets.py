"""Importer of billets; test_importers.py tests the common behaviour."""

import cv2
import pytest

from robot.importers.billets import import_billets
from tests.data import touch_data
from tests.miniatures import billets


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


def test_incomplete_and_damaged_places_are_skipped_with_a_note(source, tmp_path):
    (source / "welded1/01_photo.jpg").unlink()
    (source / "welded1/02_touch.png").write_bytes(b"no picture")
    recording = import_billets(source, tmp_path / "out")
    assert [grasp.grasp_id for grasp in recording.grasps] == ["ground1-01"]
    assert recording.notes[:2] == (
        "skipped 1: its photo or touch is missing, such as welded1/01_touch.png",
        "skipped 1: its touch a is not a readable PNG or JPEG file, such as welded1-02",
    )


def test_the_real_billets_are_imported_completely(tmp_path):
    recording = import_billets(touch_data("billets"), tmp_path / "out")
    assert len(recording.grasps) == 9 * 16
    assert len({grasp.sequence_id for grasp in recording.grasps}) == 9
    touch = cv2.imread(str(tmp_path / "out" / recording.grasps[0].touches["a"]))
    assert touch.shape == (240, 320, 3)
