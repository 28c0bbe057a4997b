"""Importer of billets; test_importers.py tests the common behaviour."""

from robot.importers.billets import import_billets


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
        "skipped 1: its touch a is not a readable picture of 8 bits (PNG, JPEG, BMP, TIFF, WebP), such as welded1-02",
    )
