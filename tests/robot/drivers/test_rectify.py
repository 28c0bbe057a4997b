"""Rectification of a camera's picture to the gel."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.video.rectify import CropSettings, Rectifier, load_rectifier, make_rectifier, to_rgb
from robot.errors import DeviceError, RobotConfigError

CORNERS = ((10.0, 5.0), (49.0, 5.0), (49.0, 24.0), (10.0, 24.0))


def ramp(width=60, height=40):
    """Return a picture whose red is the column and green the row."""
    y, x = np.mgrid[:height, :width]
    return np.dstack([x, y, np.zeros_like(x)]).astype(np.uint8)


def written(tmp_path, document):
    path = tmp_path / "gel.json"
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return path


def test_the_default_rectifier_does_not_change_a_picture():
    np.testing.assert_array_equal(Rectifier().apply(ramp()), ramp())


def test_a_crop_removes_fractions_at_left_top_right_and_bottom():
    cut = Rectifier(crop=(0.1, 0.25, 0.2, 0.5)).apply(ramp())
    np.testing.assert_array_equal(cut, ramp()[10:20, 6:48])


def test_a_crop_leaves_at_least_a_pixel():
    assert Rectifier(crop=(0.5, 0.5, 0.49, 0.49)).apply(ramp(3, 2)).shape == (1, 1, 3)


def test_the_corners_of_an_axis_aligned_rectangle_crop_it_exactly():
    cut = Rectifier(corners_px=CORNERS, image_px=(60, 40)).apply(ramp())
    np.testing.assert_array_equal(cut, ramp()[5:25, 10:50])


def test_corners_in_another_cyclic_order_rotate_the_picture():
    """With the bottom left corner as the first one, the picture is rotated to the right."""
    turned = (CORNERS[3], *CORNERS[:3])
    cut = Rectifier(corners_px=turned, image_px=(60, 40)).apply(ramp())
    np.testing.assert_array_equal(cut, np.rot90(ramp()[5:25, 10:50], -1))


def test_a_slanted_square_is_straightened_to_its_corners():
    corners = ((30.0, 4.0), (46.0, 20.0), (30.0, 36.0), (14.0, 20.0))  # sides of 22.6 pixels
    cut = Rectifier(corners_px=corners, image_px=(60, 40)).apply(ramp()).astype(int)
    assert cut.shape == (24, 24, 3)
    found = [cut[0, 0, :2], cut[0, -1, :2], cut[-1, -1, :2], cut[-1, 0, :2]]
    np.testing.assert_allclose(found, corners, atol=1)  # integer grey levels
    np.testing.assert_allclose(cut[11:13, 11:13, :2].mean(axis=(0, 1)), [30, 20], atol=1)


def test_a_picture_of_another_size_than_the_calibrations_is_refused():
    with pytest.raises(DeviceError, match="must be 60 x 40 pixels, as in the calibration file, got 30 x 20"):
        Rectifier(corners_px=CORNERS, image_px=(60, 40)).apply(ramp(30, 20))


def test_shrinking_averages_so_that_fine_lines_do_not_alias():
    """Lines of one pixel shrunk to a third are grey; every third pixel would be black or white."""
    lines = np.zeros((60, 60, 3), np.uint8)
    lines[:, ::2] = 200
    shrunk = Rectifier(output_px=(20, 20)).apply(lines)
    assert shrunk.shape == (20, 20, 3)
    assert shrunk.min() > 60
    assert shrunk.max() < 140
    assert set(lines[::3, ::3].ravel().tolist()) == {0, 200}


def test_a_calibration_file_is_read(tmp_path):
    path = written(
        tmp_path,
        {"image_px": [60, 40], "corners_px": [[10, 5], [49, 5], [49, 24], [10, 24]], "output_px": [20, 10], "note": ""},
    )
    assert load_rectifier(path) == Rectifier((), CORNERS, (60, 40), (20, 10))
    assert make_rectifier(CropSettings(calibration=str(path))).apply(ramp()).shape == (10, 20, 3)
    assert make_rectifier(CropSettings(calibration=str(path), output_px=[8, 4])).apply(ramp()).shape == (4, 8, 3)


def test_a_calibration_file_excludes_a_crop_and_settings_override_a_preset(tmp_path):
    path = written(tmp_path, {"image_px": [60, 40], "crop": [0.1, 0.1, 0.1, 0.1]})
    with pytest.raises(RobotConfigError, match="crop and a calibration file exclude each other"):
        make_rectifier(CropSettings(calibration=str(path), crop=[0.2, 0.2, 0.2, 0.2]))
    assert make_rectifier(CropSettings(calibration=str(path)), default_crop=[0.2] * 4).crop == (0.1,) * 4
    assert make_rectifier(CropSettings(crop=[0.3] * 4), default_crop=[0.2] * 4).crop == (0.3,) * 4
    assert make_rectifier(CropSettings(), default_crop=[0.2] * 4).crop == (0.2,) * 4


SQUARE = [[1, 1], [9, 1], [9, 9], [1, 9]]


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ("{", "must be JSON"),
        ("[]", "one JSON object"),
        ({"image_px": [10, 10]}, "either corners_px or crop"),
        ({"crop": [0, 0, 0, 0]}, "must contain image_px"),
        ({"image_px": [10, 10], "crop": [0, 0, 0, 0], "corners_px": SQUARE}, "either corners_px or crop"),
        ({"image_px": [10, 10], "crop": [0, 0, 0, 0], "rotate": 1}, "no setting 'rotate'"),
        ({"image_px": [10], "crop": [0, 0, 0, 0]}, "image_px"),
        ({"image_px": [], "corners_px": []}, "image_px"),
        ({"image_px": [10, 0], "crop": [0, 0, 0, 0]}, "image_px"),
        ({"image_px": [10, 9.5], "crop": [0, 0, 0, 0]}, "a whole number"),
        ({"image_px": [10, 10], "crop": [0, 0, 0]}, "crop"),
        ({"image_px": [10, 10], "crop": [0.6, 0, 0.4, 0]}, "crop"),
        ({"image_px": [10, 10], "crop": [True, 0, 0, 0]}, "crop"),
        ({"image_px": [10, 10], "crop": [10**400, 0, 0, 0]}, "crop"),
        ({"image_px": [10**400, 10], "crop": [0, 0, 0, 0]}, "image_px"),
        ({"image_px": [10, 10], "corners_px": 3}, "a list"),
        ({"image_px": [10, 10], "corners_px": SQUARE[:3]}, "four points"),
        ({"image_px": [10, 10], "corners_px": [[1, 1], [9, 1], [9], [1, 9]]}, "a list of length 2"),
        ({"image_px": [10, 10], "corners_px": SQUARE[::-1]}, "top left, top right"),
        ({"image_px": [10, 10], "corners_px": [[1, 1], [9, 1], [3, 3], [1, 9]]}, "convex"),
        ({"image_px": [10, 10], "corners_px": [[1, 1], [1, 1], [9, 9], [1, 9]]}, "convex"),
        ({"image_px": [9, 9], "corners_px": SQUARE}, "inside image_px"),
        ({"image_px": [10, 10], "corners_px": SQUARE, "output_px": [5]}, "output_px"),
    ],
)
def test_an_invalid_calibration_file_is_refused_by_its_name(tmp_path, document, message):
    with pytest.raises(RobotConfigError, match=f"gel.json.*{message}"):
        load_rectifier(written(tmp_path, document))


def test_a_missing_calibration_file_is_named(tmp_path):
    with pytest.raises(RobotConfigError, match=r"none\.json cannot be read"):
        load_rectifier(tmp_path / "none.json")


anything = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers(-5, 70) | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=10,
)


@given(st.fixed_dictionaries({}, optional=dict.fromkeys(("image_px", "crop", "corners_px", "output_px"), anything)))
def test_any_calibration_file_works_or_is_refused(tmp_path_factory, document):
    path = tmp_path_factory.mktemp("any") / "gel.json"
    path.write_text(json.dumps(document))
    try:
        rectifier = load_rectifier(path)
    except RobotConfigError:
        return
    width, height = rectifier.image_px
    assert rectifier.apply(np.zeros((height, width, 3), np.uint8)).size


@pytest.mark.parametrize(
    "picture", [np.zeros((4, 6, 2), np.uint8), np.zeros((4, 6), np.uint8), np.zeros((4, 6, 3), np.uint16)]
)
def test_a_picture_without_three_colours_is_refused(picture):
    for use in (to_rgb, Rectifier(output_px=(3, 2)).apply):
        with pytest.raises(DeviceError, match="H x W x 3 uint8"):
            use(picture)
