"""Importer of ObjectFolder: samples, packs and splits; test_importers.py tests the common behaviour."""

import json

import pytest

from robot.errors import ImporterError, RecordingError
from robot.importers.importing import SPLITS_FOLDER
from robot.importers.objectfolder import import_objectfolder
from robot.storage import parse_object
from tests.miniatures import objectfolder


def test_a_touch_of_a_pack_has_the_photo_of_its_own_number_and_the_split_is_stored_by_objects(source, tmp_path):
    recording = import_objectfolder(source, tmp_path / "out")
    assert [grasp.grasp_id for grasp in recording.grasps][:4] == ["2-1", "2-2", "2-10", "10-1"]
    for grasp in recording.grasps:
        instance = grasp.grasp_id.split("-")[1]
        photo = source / "vision" / grasp.object_id / f"{instance}.png"
        assert (tmp_path / "out" / grasp.photo).read_bytes() == photo.read_bytes()
    split = parse_object((tmp_path / "out" / SPLITS_FOLDER / "published.json").read_bytes(), RecordingError)
    assert split == {"seed": 0, "train": ["2", "31"], "validation": ["10"], "test": ["100"]}


def test_a_split_by_pictures_gets_a_note_and_touches_without_their_photo_get_another(source, tmp_path):
    rows = {"train": [["2", 1], ["10", 1]], "val": [], "test": [["2", 2], ["100", 1]]}
    (source / "split.json").write_text(json.dumps(rows))
    (source / "vision/31/2.png").unlink()
    recording = import_objectfolder(source, tmp_path / "out")
    assert any("has objects in two parts" in note for note in recording.notes)
    assert not (tmp_path / "out" / SPLITS_FOLDER).exists()
    photos = {grasp.grasp_id: grasp.photo for grasp in recording.grasps}
    assert photos["31-2"] == photos["31-10"] != photos["31-1"]


@pytest.mark.parametrize("content", ["[1]", "{", '{"train": 3}'])
def test_an_invalid_split_is_refused(source, tmp_path, content):
    (source / "split.json").write_text(content)
    with pytest.raises(ImporterError, match=r"split\.json"):
        import_objectfolder(source, tmp_path / "out")


def test_each_sample_of_real_is_an_object(tmp_path):
    objectfolder.write_samples(tmp_path / "src")
    recording = import_objectfolder(tmp_path / "src", tmp_path / "out")
    assert [(grasp.grasp_id, grasp.object_id) for grasp in recording.grasps] == [("3-0", "3"), ("20-0", "20")]
