"""HEIC and AVIF pictures: read like any other, or refused with an installation hint."""

import sys

import numpy as np
import pytest
from PIL import Image

from retrieval.data import images
from retrieval.data.images import decode_rgb
from retrieval.errors import ImageError
from tests.retrieval.data.test_images import exif, noise, saved

pillow_heif = pytest.importorskip("pillow_heif")

KINDS = ["HEIF", "AVIF"]


pillow_heif.register_heif_opener()  # to write such files
HEIC, AVIF = (saved(Image.new("RGB", (64, 64)), kind) for kind in KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_colours_are_those_of_the_pixels_on_white(kind):
    for mode, colour, expected in (("RGB", (200, 100, 50), (200, 100, 50)), ("RGBA", (255, 0, 0, 51), (255, 204, 204))):
        rgb = decode_rgb(saved(Image.new(mode, (16, 8), colour), kind, quality=100), "x")
        assert (rgb.shape, rgb.dtype) == ((8, 16, 3), np.float32)
        np.testing.assert_allclose(rgb * 255, np.broadcast_to(expected, (8, 16, 3)), atol=5)  # colour rounding


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("orientation", [1, 2, 6, 7])
def test_a_picture_is_upright_like_the_same_jpeg(kind, orientation):
    """A HEIC decoder rotates the pixels itself, an AVIF file has a tag; a second or no rotation would move corners."""
    quarters = np.kron(np.array([[40, 100], [160, 220]], np.uint8), np.ones((16, 24), np.uint8))
    image = Image.fromarray(quarters).convert("RGB")
    ours, jpeg = (decode_rgb(saved(image, one, exif=exif(orientation), quality=95), one) for one in (kind, "JPEG"))
    assert ours.shape == jpeg.shape
    np.testing.assert_allclose(ours[4:-4:8, 4:-4:8], jpeg[4:-4:8, 4:-4:8], atol=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_cut_at_any_length_is_refused(kind):
    data = saved(Image.fromarray(noise(24, 16)), kind)
    for length in range(0, len(data), 31):
        with pytest.raises(ImageError):
            decode_rgb(data[:length], "x")


def test_a_missing_decoder_is_an_error_that_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(ImageError, match=r"photo\.heic: a HEIC picture.*pip install 'touch-retrieval\[heif\]'"):
        decode_rgb(HEIC, "photo.heic")


def test_a_header_with_too_many_pixels_is_refused_before_decoding(monkeypatch):
    monkeypatch.setattr(images, "MAX_PIXELS", 64 * 64 - 1)
    for data in (HEIC, AVIF):
        with pytest.raises(ImageError, match="4096 pixels; at most 4095 are decoded"):
            decode_rgb(data, "x")
