"""Large JPEG photos are decoded no larger than their views require: sizes, errors, and unchanged cases."""

import numpy as np
import pytest
from PIL import Image

from retrieval.data import preprocessing
from retrieval.data.images import decode
from retrieval.data.preprocessing import Preprocessing
from retrieval.model.config import Config
from tests.retrieval.data.test_images import exif, saved


def jpeg(height, width, **options):
    """Return a smooth JPEG picture whose pixel values encode their positions."""
    down, across = np.mgrid[:height, :width]
    samples = np.stack([255 * down / height, 255 * across / width, np.full(down.shape, 90.0)], axis=2)
    return saved(Image.fromarray(samples.astype(np.uint8)), "JPEG", quality=95, **options)


@pytest.fixture
def decoded(monkeypatch):
    """Sizes of the decoded pictures."""
    sizes, record = [], lambda image: sizes.append(image.shape[:2]) or image
    monkeypatch.setattr(preprocessing, "decode", lambda *arguments: record(decode(*arguments)))
    return sizes


@pytest.mark.parametrize(
    ("min_side", "shape"), [(None, (600, 800)), (301, (600, 800)), (300, (300, 400)), (1, (75, 100))]
)
@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_is_decoded_as_small_as_its_shorter_side_may_be(min_side, shape, progressive):
    data = jpeg(600, 800, progressive=progressive)
    assert decode(data, "x", min_side).shape[:2] == shape


def test_other_formats_are_not_reduced_and_a_rotated_photo_is_turned_upright():
    assert decode(saved(Image.new("RGB", (400, 300)), "PNG"), "x", 10).shape == (300, 400, 3)
    assert decode(jpeg(1200, 1600, exif=exif(6)), "x", 300).shape == (400, 300, 3)  # a quarter turn


@pytest.mark.parametrize(("views", "side"), [(("whole",), 128), (("zoom",), 256), (("whole", "grey"), 256)])
def test_views_are_cut_from_twice_as_many_pixels_as_they_have(views, side, decoded):
    """A tower has 32 pixels: 64 of the whole photo (and 128 for the object search), or 64 in 7/16 of the side."""
    Preprocessing(photo_px=32, views=views, reduced=True).photo_from_bytes(jpeg(1024, 1024), "x")
    assert decoded == [(side, side)]


def with_object(side, fraction):
    """Return a JPEG photo of a blue square on a plain ground; `fraction` is the square's side relative to the photo."""
    samples = np.full((side, side, 3), 190, np.uint8)
    low, high = round(side * (0.5 - fraction / 2)), round(side * (0.5 + fraction / 2))
    samples[low:high, low:high] = (20, 30, 200)
    return saved(Image.fromarray(samples), "JPEG", quality=95)


def test_a_small_object_needs_a_second_larger_decoding_and_a_large_one_does_not(decoded):
    settings = Preprocessing(photo_px=64, views=("crop",), reduced=True)
    for side, fraction, sizes in (
        (1024, 0.6, [(128, 128), (256, 256)]),  # the crop has 1.12 * 0.6 of 128, 86 pixels, and 128 are required
        (1024, 0.96, [(128, 128)]),
        (1024, 0.2, [(128, 128), (1024, 1024)]),
        (200, 0.2, [(200, 200)]),  # the file has no more pixels
    ):
        decoded.clear()
        settings.photo_from_bytes(with_object(side, fraction), "x")
        assert decoded == sizes


@pytest.mark.parametrize("views", [("whole",), ("crop", "grey")])
def test_views_change_by_a_few_grey_levels_at_most(views):
    data = with_object(1600, 0.4)
    plain, reduced = (
        Preprocessing(photo_px=64, views=views, reduced=one).photo_from_bytes(data, "x").views for one in (False, True)
    )
    assert 0 < np.abs(plain - reduced).mean() < 2 / 255


def test_an_older_model_decodes_whole_photos(decoded):
    Preprocessing(photo_px=32).photo_from_bytes(jpeg(1024, 1024), "x")
    assert decoded == [(1024, 1024)]
    tables = Config().to_dict()
    del tables["preprocessing"]["reduced"]
    assert Config.from_dict(tables) == Config()


def test_files_and_bytes_give_equal_views(tmp_path):
    settings, data = Preprocessing(photo_px=32, reduced=True), jpeg(1024, 768)
    path = tmp_path / "a.jpg"
    path.write_bytes(data)
    np.testing.assert_array_equal(settings.load_photo(path), settings.photo_from_bytes(data, "x").views)
