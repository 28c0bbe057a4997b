"""Touch-only objects are paired with similar photo-only objects."""

import json
from pathlib import Path

import pytest

from retrieval.data.labelled_pictures import pair_by_label
from retrieval.errors import DatasetError

RIBS = {"relief": "ribs", "shape": "tube", "pitch_mm": 4.0, "amplitude_mm": 1.0, "aspect": 1.5, "sharpness": 0.3}


def write(folder: Path, kind: str, *labels: dict[str, object]) -> Path:
    """Write metadata of pictures that are never opened; a touch has fingers a and b unless its label names others."""
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


def test_each_touch_and_each_photo_is_paired_with_the_nearest_sizes_of_the_same_relief(tmp_path):
    photos = [
        {"pitch_mm": 8.0},
        {"pitch_mm": 4.2},
        {"relief": "waves"},
        {"relief": "layers"},
        {"pitch_mm": 4.3, "amplitude_mm": 3.0},
    ]
    found = pairs(tmp_path, photos, [{}, {"pitch_mm": 7.0}])
    assert names(found) == {("0", "1"), ("1", "0"), ("0", "4")}  # photo 4 is no touch's nearest
    first = found[0]
    assert (first.photo.name, first.object_id) == ("1.png", "like photo-1")
    assert [file.name for file in first.touches] == ["0-a.png", "0-b.png"]
    assert [file.name for file in first.backgrounds] == ["0-a-before.png", "0-b-before.png"]
    assert len({grasp.grasp_id for grasp in found}) == 3


def test_another_shape_is_used_if_the_same_shape_is_far_in_sizes_or_missing(tmp_path):
    near, far = {"shape": "box", "pitch_mm": 4.1}, {"pitch_mm": 5.0}
    assert ("0", "1") in names(pairs(tmp_path, [near, far, {"pitch_mm": 9.0}], [{}]))
    assert names(pairs(tmp_path / "b", [near], [{}])) == {("0", "0")}


def test_two_touches_with_one_photo_are_grasps_of_one_object(tmp_path):
    found = pairs(tmp_path, [{}], [{}, {"pitch_mm": 5.0}])
    assert {grasp.object_id for grasp in found} == {"like photo-0"}
    assert len({grasp.grasp_id for grasp in found}) == 2


def test_photos_without_a_similar_touch_and_touches_of_one_finger_are_left_out(tmp_path):
    found = pairs(tmp_path, [{}, {"relief": "layers"}], [{}, {"relief": "waves"}, {"fingers": "b"}])
    assert names(found) == {("0", "0")}


def test_smooth_objects_are_similar_for_any_pitch(tmp_path):
    smooth = {"relief": "smooth", "amplitude_mm": 0.0}
    found = pairs(tmp_path, [smooth | {"pitch_mm": 9.0}, smooth | {"pitch_mm": 2.1}], [smooth | {"pitch_mm": 2.0}])
    assert names(found) == {("0", "0"), ("0", "1")}


def test_for_a_one_finger_sensor_each_gel_image_is_a_separate_touch(tmp_path):
    found = pairs(tmp_path, [{}], [{}, {"fingers": "b"}], fingers=1)
    assert [[file.name for file in grasp.touches] for grasp in found] == [["0-a.png"], ["0-b.png"], ["1-b.png"]]


def test_pictures_of_the_wrong_kind_and_pictures_without_pairs_are_refused(tmp_path):
    photos, touches = write(tmp_path / "p", "photo", {}), write(tmp_path / "t", "touch", {"relief": "waves"})
    with pytest.raises(DatasetError, match="kind touch; it contains kind photo"):
        pair_by_label(photos, photos, 2)
    with pytest.raises(DatasetError, match="collect more"):
        pair_by_label(photos, touches, 2)
    with pytest.raises(DatasetError, match="3 fingers"):
        pair_by_label(photos, touches, 3)
