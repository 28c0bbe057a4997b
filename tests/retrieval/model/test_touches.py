"""Gel images in every form, and grasps by the nesting of lists."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from retrieval.errors import BadInput, ImageError
from retrieval.model.touches import parse_grasps, read_image

GREY = np.full((4, 6, 3), 128, dtype=np.uint8)


def names(touches, fingers=2):
    return [[image.name for image in grasp] for grasp in parse_grasps(touches, fingers)]


@pytest.fixture
def picture(tmp_path):
    """A PNG file of noise."""
    samples = np.random.default_rng(3).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    Image.fromarray(samples).save(tmp_path / "noise.png")
    return tmp_path / "noise.png"


@pytest.mark.parametrize(
    ("touches", "fingers", "named"),
    [
        (["a.png", Path("b.png")], 2, [["a.png", "b.png"]]),
        ([["a.png", "b.png"], ("c.png", "d.png")], 2, [["a.png", "b.png"], ["c.png", "d.png"]]),
        ([["a.png"], ["b.png"]], 1, [["a.png"], ["b.png"]]),
        ([b"12345", bytearray(b"678")], 2, [["grasp 1, finger a", "grasp 1, finger b"]]),
        (np.stack([[GREY], [GREY]]), 1, [["grasp 1, finger a"], ["grasp 2, finger a"]]),
        (
            [[GREY, "b.png"], [Image.fromarray(GREY)] * 2],
            2,
            [["grasp 1, finger a", "b.png"], ["grasp 2, finger a", "grasp 2, finger b"]],
        ),
    ],
)
def test_the_nesting_of_images_gives_the_grasps_and_files_keep_their_names(touches, fingers, named):
    assert names(touches, fingers) == named


@pytest.mark.parametrize(
    ("touches", "message"),
    [
        ([], "give at least one touch"),
        ([[]], r"got 0: "),
        (["a.png", "b.png", "c.png"], "got 3"),
        (["a.png", ["b.png", "c.png"]], "a list mixes images with lists of images"),
        ([[["a.png", "b.png"]]], "query several objects with query_many"),
        (None, "got NoneType"),
    ],
)
def test_every_other_input_is_refused_with_one_sentence(touches, message):
    with pytest.raises(BadInput, match=message):
        parse_grasps(touches, 2)


@pytest.mark.parametrize("mode", ["P", "LA", "CMYK", "turned"])
def test_a_pillow_image_is_read_upright_like_its_file(mode, picture):
    image, buffer = Image.open(picture), io.BytesIO()
    exif = image.getexif()
    exif[274] = 6 if mode == "turned" else 1
    image = image if mode == "turned" else image.convert(mode)
    image.save(buffer, "TIFF" if mode == "CMYK" else "PNG", exif=exif)
    opened, by_file = Image.open(io.BytesIO(buffer.getvalue())), read_image(buffer.getvalue(), "it")
    assert by_file.shape == ((32, 24, 3) if mode == "turned" else (24, 32, 3))
    assert np.array_equal(read_image(opened, "it"), by_file)


def test_an_array_need_not_be_contiguous():
    blue_first = np.random.default_rng(0).integers(0, 256, (8, 10, 3), dtype=np.uint8)
    turned = read_image(blue_first[::2, :, ::-1], "it")
    assert turned.flags.c_contiguous
    assert np.array_equal(turned, blue_first[::2, :, ::-1] / np.float32(255))


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (GREY / 255, r"must contain uint8 samples in 0\.\.255, got float64; convert samples in 0\.\.1 with np\.rint"),
        (GREY[..., 0], r"must be \(height, width, 3\) in RGB order, got \(4, 6\); repeat a grey image"),
        (GREY.transpose(2, 0, 1), r"got \(3, 4, 6\).*put channels last"),
        (GREY[:0], "has no pixels"),
    ],
)
def test_an_array_with_unclear_range_or_channels_is_refused(array, message):
    with pytest.raises(ImageError, match=rf"^finger a: .*{message}"):
        read_image(array, "finger a")


def test_a_pillow_image_of_a_truncated_file_is_refused(picture):
    opened = Image.open(io.BytesIO(picture.read_bytes()[:500]))
    with pytest.raises(ImageError, match="it: damaged or truncated"):
        read_image(opened, "it")
