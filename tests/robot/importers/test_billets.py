"""Importer of billets; test_importers.py tests the common behaviour."""

from robot.importers.billets import import_billets


def test_a_place_becomes_an_object_and_its_billet_the_sequence(source, tmp_path):
    recording = import_billets(source, tmp_path / "out")
    assert [(grasp.grasp_id, grasp.object_id, grasp.sequence_id) for grasp in recording.grasps] == [
        ("ground1-01", "ground1-01", "ground1"),
        ("welded1-01", "welded1-01", "welded1"),
        ("welded1-02", "welded1-02", "welded1"),
    ]
