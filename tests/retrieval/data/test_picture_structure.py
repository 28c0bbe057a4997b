"""Files whose structure costs more than their pixels: refused soon, with one line, before any decoder sees them."""

import io
import time

import numpy as np
import pytest
from PIL import Image

from retrieval.data import images
from retrieval.data.images import decode, picture_size
from retrieval.data.picture_structure import MAX_SCANS, MAX_SEGMENTS, MAX_STRAY_BYTES, MAX_TIFF_NUMBERS
from retrieval.errors import ImageError
from tests.hostile_pictures import (
    jpeg_of_scans,
    jpeg_of_segments,
    png_chunk,
    png_file,
    png_of_zeros,
    tiff_of_numbers,
)

MB = 1_000_000
PIXELS = bytes(25 * 8)  # of a PNG file of 8 x 8
HOSTILE = {
    "scans": (lambda: jpeg_of_scans(4472, 40_000), "more than 50 JPEG scans"),
    "comments": (lambda: jpeg_of_segments(19 * MB // 4), "more than 256 JPEG segments before its pixels"),
    "fill bytes": (lambda: b"\xff\xd8" + b"\xff" * 19 * MB, "more than 65536 stray bytes"),
    "escaped bytes": (lambda: b"\xff\xd8\xff\xfe\0\2" + b"\xff\0" * 9 * MB, "more than 65536 stray bytes"),
    "junk": (lambda: b"\xff\xd8\xff\xfe\0\2" + bytes(19 * MB), "more than 65536 stray bytes"),
    "chunks before": (lambda: png_file(8, 8, png_chunk(b"teXt", b"") * MB), "more than 256 PNG chunks before"),
    "empty pixels": (lambda: png_file(8, 8, png_chunk(b"IDAT", b"") * MB), "more than 11974 PNG chunks"),
    "chunks after": (
        lambda: png_file(8, 8, samples=PIXELS)[:-12] + png_chunk(b"teXt", b"") * MB,
        "more than 11974 PNG chunks",
    ),
    "strips": (lambda: tiff_of_numbers(273, 2 * MB), "2000009 numbers in its TIFF tags"),
    "tags": (lambda: b"MM\0*\0\0\0\x08\xff\xff" + bytes(12 * 65535), "65535 TIFF tags"),
    "thin": (lambda: png_of_zeros(1, 20 * MB), "1 x 20000000 pixels; a side may have at most 65535"),
    "flat": (lambda: png_of_zeros(20_001, 100), "20001 x 100 pixels; a side may have"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_file_that_costs_more_than_its_pixels_is_refused_in_one_line_before_it_is_decoded(name):
    make, said = HOSTILE[name]
    data = make()
    for read in (decode, picture_size) if name not in ("thin", "flat") else (decode,):
        begun = time.process_time()
        with pytest.raises(ImageError, match=said) as error:
            read(data, "x.png")
        assert time.process_time() - begun < 0.5
        assert "\n" not in str(error.value)


def test_a_film_behind_a_photo_and_a_thumbnail_before_it_are_no_scans_of_it():
    thumbnail, photo = io.BytesIO(), io.BytesIO()
    Image.new("RGB", (8, 8)).save(thumbnail, "JPEG")
    Image.new("RGB", (16, 8), "red").save(photo, "JPEG", progressive=True, exif=b"Exif\0\0" + thumbnail.getvalue())
    film = b"\xff\xda" * 1000
    assert decode(photo.getvalue() + film, "x").shape == (8, 16, 3)


@pytest.mark.parametrize("scans", [1, 10, MAX_SCANS])
def test_a_progressive_jpeg_of_as_many_scans_as_encoders_write_is_read(scans):
    assert decode(jpeg_of_scans(64, scans), "x").shape == (64, 64, 3)


def test_scans_that_hide_behind_other_segments_are_counted():
    data = jpeg_of_scans(64, 60)
    scan = data.rindex(b"\xff\xda")
    hidden = data[:scan] + b"\xff\xfe\0\4\xff\xd9" + data[scan:]  # a comment that holds the picture's end
    with pytest.raises(ImageError, match="more than 50 JPEG scans"):
        decode(hidden, "x")
    first, scan, rest = data.partition(b"\xff\xda")
    many = first + scan + rest.replace(b"\xff\xda", b"\xff\xfe\0\2" * 1000 + b"\xff\xda")
    with pytest.raises(ImageError, match=r"more than 50 JPEG scans"):
        decode(many, "x")


def test_what_is_just_within_the_bounds_is_read():
    assert decode(jpeg_of_segments(MAX_SEGMENTS - 20), "x").shape == (8, 8, 3)
    stray = jpeg_of_segments(1).replace(b"\xff\xfe\0\2", b"\xff\xfe\0\2" + bytes(MAX_STRAY_BYTES), 1)
    assert decode(stray, "x").shape == (8, 8, 3)
    text = png_chunk(b"tEXt", b"a\0b")
    assert decode(png_file(8, 8, text * (MAX_SEGMENTS - 2), samples=PIXELS), "x").shape == (8, 8, 3)
    assert decode(tiff_of_numbers(40_000, MAX_TIFF_NUMBERS - 20), "x").shape == (8, 8, 3)
    assert decode(png_of_zeros(20_000, 100), "x").shape == (100, 20_000, 3)


def test_a_large_picture_is_taken_in_strips_and_is_the_same(monkeypatch):
    samples = np.random.default_rng(0).integers(0, 256, (40, 30, 3), np.uint8)
    for mode in ("RGB", "L", "CMYK", "P"):
        picture, file = Image.fromarray(samples).convert(mode), io.BytesIO()
        picture.save(file, "TIFF")
        whole = np.asarray(picture.convert("RGB"))
        for strip in (1, 100, 10_000):
            monkeypatch.setattr(images, "_STRIP", strip)
            np.testing.assert_array_equal(decode(file.getvalue(), "x"), whole)
