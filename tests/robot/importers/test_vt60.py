"""Importer of VT60; test_importers.py tests the common behaviour."""

from collections import Counter

import pytest

from retrieval.data.dataset import load_grasps, make_split
from robot.importers.vt60 import import_vt60
from tests.miniatures import vt60


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("vt60")
    vt60.write(folder / "src")
    return import_vt60(folder / "src", folder / "out")


def test_an_object_is_a_class_and_an_instance_and_all_pictures_are_stored_once(recording):
    """An object with photos but without touches is skipped with a note."""
    assert {grasp.object_id for grasp in recording.grasps} == {"-".join(names) for names in vt60.OBJECTS}
    assert recording.info["objects"]["03_ball-01"] == {
        "class": "ball",
        "instance": "01",
        "nickname": "yellow_beachball",
    }
    assert {grasp.touches_before["a"] for grasp in recording.grasps} == {"images/no_contact_shared.jpg"}
    files = list((recording.folder / "images").iterdir())
    assert len(files) == vt60.GRASPS + vt60.PHOTOS * len(vt60.OBJECTS) + 1
    assert "skipped 1: photos of an object without touches, such as 03_ball/07" in recording.notes


def test_touches_are_assigned_to_the_photos_of_their_own_object_in_turn(recording):
    """12 touches and 5 photos: the numbers of uses differ by at most 1."""
    ball = [grasp for grasp in recording.grasps if grasp.object_id == "03_ball-01"]
    assert [grasp.photo.split("_img_")[1].split("_")[0] for grasp in ball] == list("123451234512")
    assert all(grasp.photo.startswith("images/03_ball-01-") for grasp in ball)
    assert sorted(Counter(grasp.photo for grasp in ball).values()) == [2, 2, 2, 3, 3]


def test_a_bottle_empty_and_full_is_one_sequence_and_drawn_splits_do_not_divide_it(recording):
    sequence = {grasp.object_id: grasp.sequence_id for grasp in recording.grasps}
    assert sequence["02_bottleempty-01"] == sequence["08_bottlefull-01"] == "bottle-buxton"
    assert sequence["02_bottleempty-02"] == sequence["08_bottlefull-02"] == "bottle-volvic"
    assert sequence["03_ball-01"] == "03_ball-01"
    for seed in range(5):
        split = make_split(load_grasps(recording.folder), validation=0, test=0.4, seed=seed)
        assert ("02_bottleempty-01" in split.train) == ("08_bottlefull-01" in split.train)


def test_the_touch_that_is_the_no_contact_frame_itself_is_skipped(source, tmp_path):
    """The published data has one; `retrieve check` reports such a grasp as an error."""
    (touch,) = (source / "touch/03_ball/01").glob("touch_1_img_4_*")
    touch.write_bytes((source / "touch/baselineForCalibration.jpg").read_bytes())
    recording = import_vt60(source, tmp_path / "out")
    assert len(recording.grasps) == vt60.GRASPS - 1
    assert "skipped 1: its touch is the no-contact frame itself, such as 03_ball-01-4" in recording.notes


def test_a_data_set_without_its_no_contact_frame_is_imported_without(source, tmp_path):
    (source / "touch/baselineForCalibration.jpg").unlink()
    recording = import_vt60(source, tmp_path / "out")
    assert not any(grasp.touches_before for grasp in recording.grasps)
    assert recording.info["background"] == "none"
