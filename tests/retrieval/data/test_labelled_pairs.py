"""Pressed objects are paired with photographed ones that are like them."""

import json
from pathlib import Path

import pytest

from retrieval.data.labelled_pictures import pair_by_label
from retrieval.errors import DatasetError

RIBS = {"relief": "ribs", "shape": "tube", "pitch_mm": 4.0, "amplitude_mm": 1.0, "aspect": 1.5, "sharpness": 0.3}


def write(folder: Path, kind: str, *labels: dict[str, object]) -> Path:
    """Lines of pictures that nobody opens; a touch is of the fingers a and b unless its label says which."""
    folder.mkdir(parents=True)
    (folder / "pictures.json").write_text(json.dumps({"kind": kind}))
    rows = []
    for number, label in enumerate(labels):
        row = {"object_id": f"{kind}-{number}", **RIBS, **label}
        if kind == "photo":
            rows.append({"file_name": f"{number}.png", **row})
            continue
        for finger in label.get("fingers", "ab"):
            rows.append(
                {"file_name": f"{number}-{finger}.png", "before_file_name": f"{number}-{finger}-before.png"}
                | {"finger": finger, **row}
            )
    (folder / "metadata.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def pairs(tmp_path, photos, touches, fingers=2):
    return pair_by_label(write(tmp_path / "p", "photo", *photos), write(tmp_path / "t", "touch", *touches), fingers)


def names(found):
    return {(grasp.touches[0].name[0], grasp.photo.name[0]) for grasp in found}


def test_each_press_and_each_photo_finds_what_is_nearest_in_sizes_among_those_of_its_relief(tmp_path):
    photos = [
        {"pitch_mm": 8.0},
        {"pitch_mm": 4.2},
        {"relief": "waves"},
        {"relief": "layers"},
        {"pitch_mm": 4.3, "amplitude_mm": 3.0},
    ]
    found = pairs(tmp_path, photos, [{}, {"pitch_mm": 7.0}])
    assert names(found) == {("0", "1"), ("1", "0"), ("0", "4")}  # no press has chosen photo 4
    first = found[0]
    assert (first.photo.name, first.object_id) == ("1.png", "like photo-1")
    assert [file.name for file in first.touches] == ["0-a.png", "0-b.png"]
    assert [file.name for file in first.backgrounds] == ["0-a-before.png", "0-b-before.png"]
    assert len({grasp.grasp_id for grasp in found}) == 3


def test_another_shape_is_taken_where_its_own_is_far_in_sizes_or_missing(tmp_path):
    alike, far = {"shape": "box", "pitch_mm": 4.1}, {"pitch_mm": 5.0}
    assert ("0", "1") in names(pairs(tmp_path, [alike, far, {"pitch_mm": 9.0}], [{}]))
    assert names(pairs(tmp_path / "b", [alike], [{}])) == {("0", "0")}


def test_two_presses_with_one_photo_are_grasps_of_one_object(tmp_path):
    found = pairs(tmp_path, [{}], [{}, {"pitch_mm": 5.0}])
    assert {grasp.object_id for grasp in found} == {"like photo-0"}
    assert len({grasp.grasp_id for grasp in found}) == 2


def test_what_looks_like_no_pressed_object_and_what_one_finger_missed_is_left_out(tmp_path):
    found = pairs(tmp_path, [{}, {"relief": "layers"}], [{}, {"relief": "waves"}, {"fingers": "b"}])
    assert names(found) == {("0", "0")}


def test_smooth_objects_are_alike_whatever_their_pitch_says(tmp_path):
    smooth = {"relief": "smooth", "amplitude_mm": 0.0}
    found = pairs(tmp_path, [smooth | {"pitch_mm": 9.0}, smooth | {"pitch_mm": 2.1}], [smooth | {"pitch_mm": 2.0}])
    assert names(found) == {("0", "0"), ("0", "1")}


def test_for_a_sensor_of_one_finger_each_press_is_a_touch_of_its_own(tmp_path):
    found = pairs(tmp_path, [{}], [{}, {"fingers": "b"}], fingers=1)
    assert [[file.name for file in grasp.touches] for grasp in found] == [["0-a.png"], ["0-b.png"], ["1-b.png"]]


def test_pictures_of_the_wrong_kind_and_pictures_that_do_not_pair_are_refused(tmp_path):
    photos, touches = write(tmp_path / "p", "photo", {}), write(tmp_path / "t", "touch", {"relief": "waves"})
    with pytest.raises(DatasetError, match="kind touch; it holds those of kind photo"):
        pair_by_label(photos, photos, 2)
    with pytest.raises(DatasetError, match="collect more"):
        pair_by_label(photos, touches, 2)
    with pytest.raises(DatasetError, match="3 fingers"):
        pair_by_label(photos, touches, 3)
