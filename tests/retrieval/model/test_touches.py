"""Gel images however they are given, told apart by how deep the lists are nested."""

import io
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from retrieval.data import images
from retrieval.errors import BadInput, ImageError
from retrieval.model.touches import parse_grasps, read_image

GREY = np.full((4, 6, 3), 128, dtype=np.uint8)


def names(given, fingers=2):
    return [[image.name for image in grasp] for grasp in parse_grasps(given, fingers)]


def counts(given, fingers=2):
    return [len(grasp) for grasp in parse_grasps(given, fingers)]


@pytest.fixture
def picture(tmp_path):
    """A PNG file of noise."""
    samples = np.random.default_rng(3).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    Image.fromarray(samples).save(tmp_path / "noise.png")
    return tmp_path / "noise.png"


# Nesting -----------------------------------------------------------------------------------------------------------


def test_a_list_of_images_is_one_grasp_and_a_list_of_lists_are_several():
    assert names(["a.png", Path("b.png")]) == [["a.png", "b.png"]]
    assert names([["a.png", "b.png"], ("c.png", "d.png")]) == [["a.png", "b.png"], ["c.png", "d.png"]]


def test_for_one_finger_an_image_alone_is_a_grasp():
    for given in ("a.png", ["a.png"], [["a.png"]]):
        assert names(given, 1) == [["a.png"]]
    assert names([["a.png"], ["b.png"]], 1) == [["a.png"], ["b.png"]]


def test_two_images_for_one_finger_are_never_taken_for_two_grasps():
    with pytest.raises(BadInput, match=r"takes 1 gel image\(s\) for one touch; got 2: a\.png, b\.png \(one grasp is a"):
        parse_grasps(["a.png", "b.png"], 1)


def test_an_array_of_more_axes_is_a_list_of_those_below_it():
    assert counts(np.stack([GREY, GREY])) == [2]
    assert counts(np.stack([[GREY, GREY], [GREY, GREY], [GREY, GREY]])) == [2, 2, 2]
    assert counts(GREY, 1) == [1]


def test_bytes_are_an_image_and_no_list():
    assert names([b"12345", bytearray(b"678")]) == [["grasp 1, finger a (5 bytes)", "grasp 1, finger b (3 bytes)"]]


def test_what_is_no_file_is_named_by_its_place():
    given = [[GREY, "b.png"], [Image.fromarray(GREY), GREY]]
    assert names(given)[0] == ["grasp 1, finger a (array 4 x 6 x 3 uint8)", "b.png"]
    assert names(given)[1][0] == "grasp 2, finger a (Pillow image 6 x 4 RGB)"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ([], "give at least one touch"),
        ([[]], r"got 0: "),
        ("a.png", r"got 1: a\.png"),
        (["a.png"], r"got 1: a\.png"),
        (["a.png", "b.png", "c.png"], "got 3"),
        ([["a.png", "b.png"], ["c.png"]], r"got 1: c\.png"),
        (["a.png", ["b.png", "c.png"]], "images and lists of images stand side by side"),
        ([[["a.png", "b.png"]]], "several objects go to query_many"),
        (None, "got NoneType"),
        ([None, None], "got NoneType"),
        ([[1.0, 2.0]], "got float"),
        ({"a": "a.png"}, "got dict"),
        ((image for image in ("a.png", "b.png")), "got generator"),
        (np.float32(1), "got float32"),
    ],
)
def test_whatever_else_is_refused_in_a_sentence(given, said):
    with pytest.raises(BadInput, match=said):
        parse_grasps(given, 2)


# Reading -----------------------------------------------------------------------------------------------------------


def test_a_file_gives_the_same_numbers_however_it_is_given(picture):
    data = picture.read_bytes()
    with Image.open(picture) as opened:
        given = [picture, str(picture), data, bytearray(data), memoryview(data), opened, np.asarray(opened)]
        read = [read_image(image, "it") for image in given]
    assert read[0].shape == (24, 32, 3)
    for other in read[1:]:
        assert np.array_equal(read[0], other)


@pytest.mark.parametrize("mode", ["1", "L", "P", "LA", "RGBA", "CMYK"])
def test_a_pillow_image_is_read_as_its_file_is(mode, picture):
    image, buffer = Image.open(picture).convert(mode), io.BytesIO()
    image.save(buffer, "TIFF" if mode == "CMYK" else "PNG")
    assert np.array_equal(read_image(image, "it"), read_image(buffer.getvalue(), "it"))


def test_a_pillow_image_is_turned_upright_as_its_file_is(picture):
    image, buffer = Image.open(picture), io.BytesIO()
    exif = image.getexif()
    exif[274] = 6
    image.save(buffer, "JPEG", exif=exif)
    opened = Image.open(io.BytesIO(buffer.getvalue()))
    assert read_image(opened, "it").shape == (32, 24, 3)
    assert np.array_equal(read_image(opened, "it"), read_image(buffer.getvalue(), "it"))


def test_an_array_need_not_lie_in_one_piece():
    blue_first = np.random.default_rng(0).integers(0, 256, (8, 10, 3), dtype=np.uint8)
    turned = read_image(blue_first[::2, :, ::-1], "it")
    assert turned.flags.c_contiguous
    assert np.array_equal(turned, blue_first[::2, :, ::-1] / np.float32(255))


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (GREY / 255, r"must hold uint8 samples in 0\.\.255, got float64; make them of samples in 0\.\.1 by np\.rint"),
        (GREY.astype(np.float32), "got float32"),
        (GREY.astype(np.uint16), "got uint16"),
        (GREY > 0, "got bool"),
        (np.array(["a.png", "b.png"]), "got <U5"),
        (GREY[..., 0], r"must be \(height, width, 3\), red first, got \(4, 6\); repeat a grey image"),
        (GREY[..., :1], r"got \(4, 6, 1\)"),
        (np.concatenate([GREY, GREY[..., :1]], axis=2), r"got \(4, 6, 4\)"),
        (GREY.transpose(2, 0, 1), r"got \(3, 4, 6\).*put channels last"),
        (GREY[:0], "has no pixels"),
        (GREY[:, :0], "has no pixels"),
    ],
)
def test_an_array_whose_range_or_channels_would_be_guessed_is_refused(array, said):
    with pytest.raises(ImageError, match=rf"^finger a: .*{said}"):
        read_image(array, "finger a")


def test_a_huge_array_is_refused_before_it_is_copied(monkeypatch):
    monkeypatch.setattr(images, "MAX_PIXELS", 20)
    with pytest.raises(ImageError, match="6 x 4 = 24 pixels; at most 20"):
        read_image(GREY, "it")


def test_a_pillow_image_of_a_truncated_file_is_refused(picture):
    opened = Image.open(io.BytesIO(picture.read_bytes()[:500]))
    with pytest.raises(ImageError, match="it: damaged or truncated"):
        read_image(opened, "it")


def test_a_pillow_image_whose_file_is_closed_is_refused(picture, tmp_path):
    opened = Image.open(shutil.copy(picture, tmp_path / "copy.png"))
    opened.close()
    with pytest.raises(ImageError, match="it: damaged or truncated"):
        read_image(opened, "it")


def test_bytes_that_are_no_picture_are_refused():
    with pytest.raises(ImageError, match="it: not a PNG"):
        read_image(b"no picture", "it")
    with pytest.raises(ImageError, match="it: the file is empty"):
        read_image(b"", "it")
