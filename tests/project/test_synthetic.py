"""Synthetic test pictures: seeded, with the documented shapes; photo and touch have only the relief in common."""

import json
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from robot.recording.folder import read_recording
from tests import synthetic
from tests.synthetic import (
    DrawnObject,
    draw_background,
    draw_photo,
    draw_touch,
    make_object,
    make_objects,
    relief,
)

RELIEF_FIELDS = ("pitch_mm", "depth_mm", "anisotropy", "regularity", "sharpness")


@pytest.fixture(scope="module")
def many() -> list[DrawnObject]:
    return [make_object(seed) for seed in range(2000)]


def _tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_pictures_have_the_documented_shape_and_type() -> None:
    obj = make_object(3)
    touch = draw_touch(obj, 0)
    pictures = {(256, 256, 3): draw_photo(obj, 0), (96, 96, 3): draw_photo(obj, 0, px=96)}
    assert list(touch) == ["a", "b"]
    assert list(draw_touch(obj, 0, fingers=["a"])) == ["a"]
    for shape, picture in [
        *pictures.items(),
        ((120, 160, 3), touch["a"]),
        ((120, 160, 3), draw_background(0)),
    ]:
        assert picture.shape == shape
        assert picture.dtype == np.uint8
    assert draw_touch(obj, 0, px=(128, 128))["b"].shape == (128, 128, 3)


def test_the_same_seed_draws_the_same_bytes() -> None:
    first = draw_photo(make_object(5), 1), draw_touch(make_object(5), 1), draw_background(1)
    relief.cache_clear()
    again = draw_photo(make_object(5), 1), draw_touch(make_object(5), 1), draw_background(1)
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1]["b"], again[1]["b"])
    np.testing.assert_array_equal(first[2], again[2])


def test_grasps_fingers_frames_and_objects_differ() -> None:
    obj, other = make_objects(2)
    touch = draw_touch(obj, 0)
    assert (draw_photo(obj, 0) != draw_photo(obj, 1)).mean() > 0.5
    assert (touch["a"] != draw_touch(obj, 1)["a"]).mean() > 0.5
    assert (touch["a"] != touch["b"]).mean() > 0.5
    assert (draw_background(0) != draw_background(1)).mean() > 0.5
    assert obj != other
    assert not np.array_equal(relief(obj), relief(other))
    assert make_objects(3, seed=1)[0] not in make_objects(3)


@pytest.mark.parametrize("number", range(len(synthetic.FAMILIES)))
def test_every_family_fills_its_depth_and_dents_the_gel(number: int) -> None:
    obj = replace(make_object(number), depth_mm=0.6)
    field = relief(obj)
    assert field.dtype == np.float32
    assert 0 <= field.min() < 0.1
    assert 0.3 < field.max() <= 0.6 + 1e-6
    pressed = draw_touch(obj, 0, fingers=["a"])["a"].astype(float)
    assert np.abs(pressed - draw_background(0).astype(float)).mean() > 5


def test_a_finger_without_force_shows_the_no_contact_frame() -> None:
    """The two differ only by sensor noise with a deviation of 1.5 each."""
    empty = draw_touch(make_object(1), 0, force_n=0.0)["b"].astype(float) - draw_background(0, "b").astype(float)
    assert abs(empty.mean()) < 0.1
    assert 1.5 < empty.std() < 3


def test_more_force_dents_more() -> None:
    obj = make_object(4)
    rest = draw_background(0).astype(float)
    change = [np.abs(draw_touch(obj, 0, force_n=f)["a"].astype(float) - rest).mean() for f in (1.0, 5.0, 15.0)]
    assert change == sorted(change)
    assert change[2] > 1.3 * change[0]


def test_appearance_is_independent_of_relief(many: list[DrawnObject]) -> None:
    """2000 objects: independent columns correlate by less than 0.1 (4.5 standard errors)."""
    touchable = np.array([[getattr(obj, name) for name in RELIEF_FIELDS] for obj in many])
    visible = np.array([[*obj.colour, *obj.paint, obj.paint_fraction, obj.gloss, *obj.outline] for obj in many])
    correlation = np.corrcoef(touchable.T, visible.T)[: touchable.shape[1], touchable.shape[1] :]
    assert np.abs(correlation).max() < 0.1
    family = np.array([obj.family for obj in many])
    for name in synthetic.FAMILIES:
        deviation = (visible[family == name].mean(0) - visible.mean(0)) / visible.std(0)
        assert np.abs(deviation).max() < 0.45  # 5.5 standard errors of 154 objects
    assert {field.name for field in fields(DrawnObject)} == {
        *RELIEF_FIELDS, "object_id", "seed", "family", "colour", "paint", "paint_fraction", "gloss", "outline",
    }  # fmt: skip


def test_relief_does_not_change_the_mean_colour_of_the_photo_and_appearance_does_not_change_the_touch() -> None:
    obj = make_object(3)
    deep = replace(obj, depth_mm=2 * obj.depth_mm)
    repainted = replace(obj, colour=(0.9, 0.2, 0.2), paint=(0.1, 0.1, 0.1))
    shallow_mean, deep_mean = (draw_photo(part, 0).mean((0, 1)) for part in (obj, deep))
    np.testing.assert_allclose(shallow_mean, deep_mean, atol=4)  # grey levels: highlights clip at 255
    np.testing.assert_array_equal(draw_touch(obj, 0)["a"], draw_touch(repainted, 0)["a"])


def test_a_recording_reads_back_and_repeats(tmp_path: Path) -> None:
    objects = make_objects(2)
    folders = [synthetic.write_recording(tmp_path / name, objects, grasps=2, misses=1, seed=4) for name in "xy"]
    recording = read_recording(folders[0])
    assert [grasp.grasped for grasp in recording.grasps] == [True, True, False] * 2
    assert {grasp.object_id for grasp in recording.grasps} == {obj.object_id for obj in objects}
    first = recording.grasps[0]
    assert set(first.images()) == {"photo", "touch_a", "touch_b", "touch_a_before", "touch_b_before"}
    stored = cv2.cvtColor(cv2.imread(str(folders[0] / first.touches["a"])), cv2.COLOR_BGR2RGB)
    np.testing.assert_array_equal(stored, draw_touch(objects[0], 4000)["a"])
    assert _tree(folders[0]) == _tree(folders[1])


def test_a_recording_of_one_finger_without_no_contact_frames(tmp_path: Path) -> None:
    folder = synthetic.write_recording(tmp_path, make_objects(1), grasps=1, fingers=["a"], before=False)
    row = json.loads((folder / "metadata.jsonl").read_text())
    assert {key for key in row if key.endswith("_file_name")} == {"photo_file_name", "touch_a_file_name"}


def test_catalogue_and_queries(tmp_path: Path) -> None:
    objects = make_objects(2)
    catalogue = synthetic.write_catalogue(tmp_path / "catalog", objects, photos_per_object=2)
    queries = synthetic.write_queries(tmp_path / "queries", objects, touches_per_object=2)
    names = [obj.object_id for obj in objects]
    assert sorted(_tree(catalogue)) == sorted(f"{name}/{n}.jpg" for name in names for n in (1, 2))
    assert {name: len(touches) for name, touches in queries.items()} == dict.fromkeys(names, 2)
    assert all(path.is_file() for touches in queries.values() for touch in touches for path in touch)
