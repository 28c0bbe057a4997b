"""Files whose structure costs more than their pixels are refused quickly, with one line, before decoding."""

import io

import numpy as np
import pytest
from PIL import Image, ImageFile

from retrieval.data import images
from retrieval.data.images import decode
from retrieval.data.picture_structure import MAX_SCANS, MAX_SEGMENTS, MAX_STRAY_BYTES, MAX_TIFF_NUMBERS
from retrieval.errors import ImageError
from tests.hostile_pictures import jpeg_of_scans, jpeg_of_segments, png_chunk, png_file, png_of_zeros, tiff_of_numbers

MB = 100_000
PIXELS = bytes(25 * 8)  # of a PNG file of 8 x 8
HOSTILE = {
    "scans": (lambda: jpeg_of_scans(448, 4_000), "more than 50 JPEG scans"),
    "comments": (lambda: jpeg_of_segments(19 * MB // 4), "more than 256 JPEG segments before its pixels"),
    "fill bytes": (lambda: b"\xff\xd8" + b"\xff" * 19 * MB, "more than 65536 stray bytes"),
    "chunks before": (lambda: png_file(8, 8, png_chunk(b"teXt", b"") * MB), "more than 256 PNG chunks"),
    "chunks after": (
        lambda: png_file(8, 8, samples=PIXELS)[:-12] + png_chunk(b"teXt", b"") * MB,
        r"more than \d+ PNG chunks",
    ),
    "strips": (lambda: tiff_of_numbers(273, 600_000), "600009 numbers in its TIFF tags"),
    "tags": (lambda: b"MM\0*\0\0\0\x08\xff\xff" + bytes(12 * 65535), "65535 TIFF tags"),
    "thin": (lambda: png_of_zeros(1, 200 * MB), "1 x 20000000 pixels; a side may have at most 65535"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_file_that_costs_more_than_its_pixels_is_refused_with_one_line_before_decoding(name, monkeypatch):
    make, message = HOSTILE[name]
    if name == "thin":  # the sides in its header
        monkeypatch.setattr(ImageFile.ImageFile, "load", None)
    else:
        monkeypatch.setattr(Image, "open", None)
    with pytest.raises(ImageError, match=message) as error:
        decode(make(), "x.png")
    assert "\n" not in str(error.value)


def test_a_video_after_a_photo_and_a_thumbnail_before_it_do_not_count_as_scans():
    thumbnail, photo = io.BytesIO(), io.BytesIO()
    Image.new("RGB", (8, 8)).save(thumbnail, "JPEG")
    Image.new("RGB", (16, 8), "red").save(photo, "JPEG", progressive=True, exif=b"Exif\0\0" + thumbnail.getvalue())
    video = b"\xff\xda" * 1000
    assert decode(photo.getvalue() + video, "x").shape == (8, 16, 3)


def test_scans_hidden_behind_other_segments_are_counted():
    data = jpeg_of_scans(64, 60)
    scan = data.rindex(b"\xff\xda")
    hidden = data[:scan] + b"\xff\xfe\0\4\xff\xd9" + data[scan:]  # a comment that contains an end-of-image marker
    with pytest.raises(ImageError, match="more than 50 JPEG scans"):
        decode(hidden, "x")


def test_files_just_within_the_bounds_are_read():
    assert decode(jpeg_of_scans(64, MAX_SCANS), "x").shape == (64, 64, 3)
    assert decode(jpeg_of_segments(MAX_SEGMENTS - 20), "x").shape == (8, 8, 3)
    stray = jpeg_of_segments(1).replace(b"\xff\xfe\0\2", b"\xff\xfe\0\2" + bytes(MAX_STRAY_BYTES), 1)
    assert decode(stray, "x").shape == (8, 8, 3)
    text = png_chunk(b"tEXt", b"a\0b")
    assert decode(png_file(8, 8, text * (MAX_SEGMENTS - 2), samples=PIXELS), "x").shape == (8, 8, 3)
    assert decode(tiff_of_numbers(40_000, MAX_TIFF_NUMBERS - 20), "x").shape == (8, 8, 3)
    assert decode(png_of_zeros(20_000, 100), "x").shape == (100, 20_000, 3)


def test_a_large_picture_is_copied_in_strips_without_a_difference(monkeypatch):
    samples = np.random.default_rng(0).integers(0, 256, (40, 30, 3), np.uint8)
    for mode in ("RGB", "L", "CMYK", "P"):
        picture, file = Image.fromarray(samples).convert(mode), io.BytesIO()
        picture.save(file, "TIFF")
        whole = np.asarray(picture.convert("RGB"))
        for strip in (1, 100, 10_000):
            monkeypatch.setattr(images, "_STRIP", strip)
            np.testing.assert_array_equal(decode(file.getvalue(), "x"), whole)
