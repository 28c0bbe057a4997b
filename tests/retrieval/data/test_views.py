"""The object's box in a photo, and the views that are cut out around it."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from retrieval.commands.main import main
from retrieval.data.camera import PhotoCamera
from retrieval.data.object_finder import FoundObject, crop_square, find_object
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import resize
from retrieval.data.views import FIELD_MM, VIEWS, tile_views
from retrieval.model.config import MatcherConfig
from retrieval.model.fusion import Matcher
from retrieval.report.pages import write_views

GROUND = (0.55, 0.5, 0.45)


def photo(*, size=(256, 256), colour=(0.2, 0.4, 0.8), box=(100, 60, 150, 200), shadow=(), noise=0.01, slope=0.0):
    """Return a photo of a plain box on a ground with a little noise; a shadow is darker and bluer than the ground."""
    rng = np.random.default_rng(0)
    image = np.ones((*size, 3)) * GROUND
    image *= 1 + slope * np.linspace(-1, 1, size[1])[None, :, None]
    for left, top, right, bottom in shadow:
        image[top:bottom, left:right] *= np.array([0.57, 0.6, 0.63])
    left, top, right, bottom = box
    image[top:bottom, left:right] = colour
    return np.clip(image + rng.normal(0, noise, image.shape), 0, 1).astype(np.float32)


def white_paper():
    image = np.ones((200, 200, 3), np.float32)
    image[50:150, 80:120] = 0.4
    return image


def near(found, expected, px=6):
    return np.abs(np.subtract(found[:4], expected)).max() <= px


BOX = (100, 60, 150, 200)
FOUND = {
    "blue": (photo(), BOX),
    "nearly white": (photo(colour=(0.95, 0.95, 0.9)), BOX),
    "nearly black": (photo(colour=(0.05, 0.05, 0.06)), BOX),
    "with a shadow": (photo(shadow=[(150, 150, 240, 200)]), BOX),
    "in uneven light": (photo(slope=0.3), BOX),
    "on white paper without noise": (white_paper(), (80, 50, 120, 150)),
}


@pytest.mark.parametrize("name", FOUND)
def test_the_box_of_the_object_is_found(name):
    image, expected = FOUND[name]
    assert near(find_object(image), expected, px=7 if name == "nearly black" else 6)


def test_the_box_is_in_the_photos_own_pixels():
    found = find_object(photo(size=(600, 900), box=(400, 100, 550, 500)))
    assert near(found, (400, 100, 550, 500), px=16)


def test_a_photo_without_an_object_is_used_whole():
    assert find_object(photo(box=(0, 0, 0, 0))) == (0, 0, 256, 256, 256 * 256)
    assert find_object(np.zeros((40, 30, 3), np.float32)) == (0, 0, 30, 40, 30 * 40)


@given(
    arrays(
        np.float32, st.tuples(st.integers(1, 40), st.integers(1, 40), st.just(3)), elements=st.floats(0, 1, width=32)
    )
)
def test_any_photo_has_a_box_inside_it(image):
    found = find_object(image)
    assert 0 <= found.left < found.right <= image.shape[1]
    assert 0 <= found.top < found.bottom <= image.shape[0]
    assert 0 < found.area <= image[..., 0].size
    assert np.isfinite(tile_views(image, list(VIEWS), 8, find_object(image))).all()


@pytest.mark.parametrize("side", [1, 2, 7, 30])
@pytest.mark.parametrize("middle", [(0, 0), (19, 9), (8, 4)])
def test_a_square_is_cut_out_exactly_at_any_position(side, middle):
    image = np.random.default_rng(0).random((10, 20, 3)).astype(np.float32)
    found = crop_square(image, FoundObject(*middle, middle[0] + 1, middle[1] + 1, 1.0), side)
    left, top = (round(each + 0.5 - side / 2) for each in middle)
    for row in range(side):
        for column in range(side):
            expected = image[min(max(top + row, 0), 9), min(max(left + column, 0), 19)]
            np.testing.assert_array_equal(found[row, column], expected)


def test_the_grey_view_is_the_zoom_without_its_colours_to_the_bit():
    image = photo()
    found = FoundObject(90, 80, 140, 150, 50 * 70)
    zoom = VIEWS["zoom"](image, found, FIELD_MM)
    expected = resize(np.repeat(zoom.mean(axis=2, keepdims=True), 3, axis=2), (48, 48))
    np.testing.assert_array_equal(tile_views(image, ("grey",), 48, found), expected)


def test_views_are_tiled_side_by_side():
    image = photo()
    tiles = tile_views(image, ("whole", "crop", "zoom", "grey"), 64, find_object(image))
    assert tiles.shape == (64, 256, 3)
    np.testing.assert_array_equal(tiles[:, :64], Preprocessing(photo_px=64).photo(image))
    blue = [float((tiles[:, left : left + 64, 2] > 0.65).mean()) for left in (0, 64, 128)]
    assert blue[2] > blue[1] > blue[0]  # windows of 112, 157 and 256 pixels


def test_the_crop_has_the_same_scale_at_any_distance_of_the_camera():
    def width(box):
        tile = tile_views(photo(box=box), ("crop",), 100, FoundObject(*map(float, box), 0.0))
        return int((tile[50, :, 2] > 0.65).sum())

    assert abs(width((100, 60, 150, 200)) - width((115, 95, 140, 165))) <= 2


def test_the_zoom_has_one_scale_for_all_object_sizes():
    def stripes(box):
        image = photo(box=box)
        left, top, right, bottom = box
        image[top:bottom, left:right:8] = 1
        return tile_views(image, ("zoom",), 112, find_object(image))

    small, large = stripes((110, 90, 150, 170)), stripes((70, 20, 190, 230))
    middle = slice(40, 72)
    for found in (small, large):
        row = found[56, middle, 0]
        assert (np.diff(np.flatnonzero(row > 0.9)) == 8).all()


@pytest.mark.parametrize(("field_mm", "px"), [(FIELD_MM, 112), (380, 56), (95, 224)])
def test_the_zoom_has_one_scale_in_millimetres(field_mm, px):
    for found in (FoundObject(110, 90, 150, 170, 3000), FoundObject(70, 20, 190, 230, 20000)):
        assert VIEWS["zoom"](photo(), found, field_mm).shape == (px, px, 3)


def test_a_photos_features_are_those_of_its_views_side_by_side():
    torch.manual_seed(0)
    config = MatcherConfig(tower="small", tower_output="pooled", hidden=8)
    matcher = Matcher(config, views=2).eval()
    photos = torch.rand(3, 3, 32, 64)
    with torch.inference_mode():
        found = matcher.photo_features(photos)
        expected = torch.cat([matcher.photo_tower(photos[..., :32]), matcher.photo_tower(photos[..., 32:])], dim=1)
    torch.testing.assert_close(found, expected)
    assert matcher.head.photo_partial.in_features == found.shape[1]


def test_a_sheet_shows_the_views_of_a_catalogue(tmp_path, model, catalogue, capsys):
    words = ["build-index", str(catalogue), "--model", str(model), "--out", str(tmp_path / "index")]
    assert main([*words, "--preview"]) == 0
    sheet = tmp_path / "index" / "views.png"
    assert f"in {sheet}" in capsys.readouterr().err
    with Image.open(sheet) as picture:
        assert picture.width == 2 * 48
        assert picture.height >= 48


def test_a_sheet_shows_photos_turned_as_the_model_receives_them(tmp_path):
    path, settings = tmp_path / "a.png", Preprocessing(photo_px=64, views=("crop",))
    image = photo()
    image[60:120, 100:150] = [0.9, 0.2, 0.1]  # the upper part of the box
    Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(path)
    sheets = []
    for roll_deg in (0, 180):
        write_views({path: PhotoCamera(roll_deg=roll_deg)}, settings, tmp_path / "views.png")
        sheets.append(np.asarray(Image.open(tmp_path / "views.png"), np.float32)[:, :64])
    upright, turned = sheets
    assert np.abs(upright - turned[::-1, ::-1]).mean() < 5 < np.abs(upright - turned).mean()
