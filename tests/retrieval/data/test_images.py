"""Reading pictures, and refusing other files. Resizing is in test_images_resize.py."""

import contextlib
import io
import os
import struct
import zlib
from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageFile

from retrieval.data import images
from retrieval.data.images import decode_rgb, read_rgb
from retrieval.errors import ImageError
from tests.hostile_pictures import png_chunk as chunk


def png(colour_type, depth, samples, *extra, size=None):
    """A PNG file of `samples` (H, W) or (H, W, channels), with extra chunks before the pixels."""
    samples = np.asarray(samples)
    height, width = size or samples.shape[:2]
    kind = ">u2" if depth == 16 else "u1"
    rows = b"".join(b"\0" + row.astype(kind).tobytes() for row in samples)
    header = struct.pack(">IIBBBBB", width, height, depth, colour_type, 0, 0, 0)
    body = [chunk(b"IHDR", header), *extra, chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(body)


def tiff(samples, orientation=1, extra_samples=None, bits=None):
    """An uncompressed little-endian TIFF file of uint8 or uint16 `samples` (H, W, channels)."""
    height, width, channels = samples.shape
    raw = samples.astype(samples.dtype.newbyteorder("<")).tobytes()
    bits = bits or samples.dtype.itemsize * 8
    count = 13 if extra_samples is not None else 12
    offset = 8 + 2 + 12 * count + 4
    tags = [
        (256, 3, 1, width),
        (257, 3, 1, height),
        (258, 3, channels, offset if channels > 2 else bits),
        (259, 3, 1, 1),
        (262, 3, 1, 2 if channels > 2 else 1),
        (273, 4, 1, offset + 2 * channels),
        (274, 3, 1, orientation),
        (277, 3, 1, channels),
        (278, 3, 1, height),
        (279, 4, 1, len(raw)),
        (284, 3, 1, 1),
        (296, 3, 1, 1),
    ]
    if extra_samples is not None:
        tags.append((338, 3, 1, extra_samples))
    entries = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    return (
        b"II*\0\x08\0\0\0"
        + struct.pack("<H", len(tags))
        + entries
        + b"\0\0\0\0"
        + struct.pack(f"<{channels}H", *[bits] * channels)
        + raw
    )


def saved(image, kind, **options):
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def exif(orientation):
    content = Image.Exif()
    content[274] = orientation
    return content.tobytes()


def noise(height, width, channels=3, dtype=np.uint8, seed=0):
    top = np.iinfo(dtype).max
    return np.random.default_rng(seed).integers(0, top, (height, width, channels), dtype, endpoint=True)


@cache
def sample_files():
    """One small file of every format and depth."""
    colour = Image.fromarray(noise(24, 17))
    smooth = Image.fromarray(cv2.resize(noise(3, 3), (48, 40), interpolation=cv2.INTER_CUBIC))
    return {
        "png": saved(colour, "PNG"),
        "png palette": saved(colour.quantize(16), "PNG", transparency=3),
        "png 16-bit": cv2.imencode(".png", noise(9, 7, 3, np.uint16))[1].tobytes(),
        "jpeg": saved(smooth, "JPEG"),
        "jpeg progressive": saved(smooth, "JPEG", progressive=True),
        "bmp": saved(colour, "BMP"),
        "tiff": saved(colour, "TIFF"),
        "tiff lzw": saved(colour, "TIFF", compression="tiff_lzw"),
        "tiff 16-bit": tiff(noise(9, 7, 3, np.uint16)),
        "webp": saved(smooth, "WEBP"),
        "webp lossless": saved(colour, "WEBP", lossless=True),
        "avif": saved(smooth, "AVIF"),
    }


def test_a_lossless_file_returns_its_pixels(tmp_path):
    pixels, path = noise(5, 4), tmp_path / "picture"
    for kind in ("PNG", "BMP", "TIFF", "WEBP"):
        path.write_bytes(saved(Image.fromarray(pixels), kind, **{"lossless": True} if kind == "WEBP" else {}))
        rgb = read_rgb(path)
        assert (rgb.dtype, rgb.flags["C_CONTIGUOUS"]) == (np.float32, True)
        np.testing.assert_array_equal(rgb, pixels.astype(np.float32) / 255)


EIGHT_BIT = {
    "grey": (Image.new("L", (1, 1), 51), "PNG", {}, (0.2, 0.2, 0.2)),
    "palette": (Image.new("RGB", (1, 1), (255, 51, 0)).quantize(2), "PNG", {}, (1, 0.2, 0)),
    "cmyk": (Image.new("CMYK", (1, 1), (0, 255, 255, 0)), "TIFF", {}, (1, 0, 0)),
    "alpha half": (Image.new("RGBA", (1, 1), (255, 0, 0, 51)), "PNG", {}, (1, 0.8, 0.8)),
    "alpha none": (Image.new("RGBA", (1, 1), (0, 0, 0, 0)), "WEBP", {"lossless": True}, (1, 1, 1)),
    "grey alpha": (Image.new("LA", (1, 1), (0, 51)), "PNG", {}, (0.8, 0.8, 0.8)),
    "colour key": (Image.new("RGB", (1, 1), (9, 8, 7)), "PNG", {"transparency": (9, 8, 7)}, (1, 1, 1)),
    "palette key": (Image.new("RGB", (1, 1), (255, 0, 0)).quantize(2), "PNG", {"transparency": 0}, (1, 1, 1)),
}


@pytest.mark.parametrize("name", EIGHT_BIT)
def test_every_eight_bit_kind_becomes_rgb_on_white(name):
    image, kind, options, expected = EIGHT_BIT[name]
    rgb = decode_rgb(saved(image, kind, **options), name)
    np.testing.assert_allclose(rgb, np.reshape(expected, (1, 1, 3)), atol=1e-7)


@pytest.mark.parametrize("kind", [".png", ".tiff"])
def test_sixteen_bit_colour_keeps_its_high_byte(kind):
    pixels = np.array([[[256, 257, 65535], [1, 0, 511]]], np.uint16)
    data = cv2.imencode(kind, np.ascontiguousarray(pixels[..., ::-1]))[1].tobytes()
    np.testing.assert_allclose(decode_rgb(data, "x"), pixels / 65535, atol=1 / 255)  # a level of 8 bits


def test_sixteen_bit_grey_is_scaled_and_not_clipped_like_in_pillow():
    pixels = np.array([[0, 256, 32768, 65535]], np.uint16)
    for data in (png(0, 16, pixels), tiff(pixels[..., None])):
        np.testing.assert_array_equal(decode_rgb(data, "x")[0, :, 1], pixels[0].astype(np.float32) / 65535)
    keyed = png(0, 16, [[2000, 2001]], chunk(b"tRNS", struct.pack(">H", 2000)))
    np.testing.assert_allclose(decode_rgb(keyed, "x")[0, :, 0], [1, 2001 / 65535], atol=1e-7)


def test_sixteen_bit_transparency_becomes_white():
    for data in (
        png(4, 16, [[[0, 0], [0, 13107]]]),
        png(6, 16, [[[0, 0, 0, 0], [0, 0, 0, 13107]]]),
        tiff(np.array([[[9, 9, 9, 0], [0, 0, 0, 13107]]], np.uint16), extra_samples=2),
    ):
        np.testing.assert_allclose(decode_rgb(data, "x")[0], [[1, 1, 1], [0.8, 0.8, 0.8]], atol=1e-6)


UPRIGHT = {
    1: [[1, 2, 3], [4, 5, 6]],
    2: [[3, 2, 1], [6, 5, 4]],
    3: [[6, 5, 4], [3, 2, 1]],
    4: [[4, 5, 6], [1, 2, 3]],
    5: [[1, 4], [2, 5], [3, 6]],
    6: [[4, 1], [5, 2], [6, 3]],
    7: [[6, 3], [5, 2], [4, 1]],
    8: [[3, 6], [2, 5], [1, 4]],
}


@pytest.mark.parametrize("orientation", UPRIGHT)
@pytest.mark.parametrize("kind", ["png", "png 16-bit", "tiff", "tiff 16-bit"])
def test_the_exif_orientation_is_applied_once(orientation, kind):
    stored = np.array([[1, 2, 3], [4, 5, 6]])
    eight, sixteen = (stored * 20).astype(np.uint8), (stored * 5000).astype(np.uint16)
    chunk_exif = chunk(b"eXIf", exif(orientation).removeprefix(b"Exif\0\0"))
    data = {
        "png": saved(Image.fromarray(eight), "PNG", exif=exif(orientation)),
        "png 16-bit": png(0, 16, sixteen, chunk_exif),
        "tiff": tiff(eight[..., None], orientation),
        "tiff 16-bit": tiff(sixteen[..., None], orientation),
    }[kind]
    scale = 5000 / 65535 if "16" in kind else 20 / 255
    np.testing.assert_allclose(decode_rgb(data, "x")[..., 0], np.array(UPRIGHT[orientation]) * scale, atol=1e-6)


def test_invalid_and_damaged_exif_is_ignored():
    for orientation in (0, 9, 60000):
        assert decode_rgb(saved(Image.fromarray(noise(2, 3)), "PNG", exif=exif(orientation)), "x").shape == (2, 3, 3)
    data = png(0, 8, [[255]], chunk(b"eXIf", b"II*\0\xff\xff\xff\xff broken"))
    np.testing.assert_array_equal(decode_rgb(data, "x"), np.ones((1, 1, 3)))


def test_files_that_cannot_be_read_give_errors_with_the_reason(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "long.png").write_bytes(b"12345")
    monkeypatch.setattr(images, "MAX_BYTES", 4)
    for name, reason in (
        ("none.png", "no such file"),
        (".", "folder"),
        ("pipe.png", "not a regular file"),
        ("a\0.png", "cannot be read"),
        ("long.png", "has 5 bytes; at most 4"),
    ):
        with pytest.raises(ImageError, match=reason) as caught:
            read_rgb(tmp_path / name)
        assert caught.value.path == str(tmp_path / name)
        assert caught.value.exit_code == 2


REFUSED = {
    "empty": (b"", "is empty"),
    "text": (b"hello, this is no picture at all", "not a PNG, JPEG"),
    "gif": (saved(Image.new("L", (2, 2)), "GIF"), "not a PNG, JPEG"),
    "float": (saved(Image.new("F", (2, 2)), "TIFF"), "pixel type .*F.*not supported"),
    "12-bit": (tiff(np.zeros((2, 2, 1), np.uint16), bits=12), "not supported|truncated"),
    "bomb": (png(2, 8, np.zeros((1, 1, 3)), size=(6000, 10000)), "10000 x 6000 = 60000000 pixels; at most 20000000"),
    "thin": (png(2, 8, np.zeros((1, 1, 3)), size=(20_000_000, 1)), "1 x 20000000 pixels; a side may have at most"),
    "bomb that raises": (png(2, 8, np.zeros((1, 1, 3)), size=(30000, 30000)), "far more pixels; at most"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_unusable_pictures_are_refused_with_the_reason(name, monkeypatch):
    data, reason = REFUSED[name]
    if "bomb" in name or name == "thin":  # refused by its header
        monkeypatch.setattr(ImageFile.ImageFile, "load", None)
    with pytest.raises(ImageError, match=reason) as caught:
        decode_rgb(data, "shot.png")
    assert str(caught.value).startswith("shot.png: ")


def jpeg_of(height, width, **options):
    ramp = np.linspace(0, 255, width).astype(np.uint8)
    return saved(Image.fromarray(np.broadcast_to(ramp[:, None], (height, width, 3))), "JPEG", **options)


@pytest.mark.parametrize(("max_pixels", "size"), [(120_000, (300, 400)), (119_999, (150, 200)), (5_000, (38, 50))])
def test_a_large_jpeg_is_decoded_smaller(monkeypatch, max_pixels, size):
    monkeypatch.setattr(images, "MAX_PIXELS", max_pixels)
    image = decode_rgb(jpeg_of(300, 400), "x")
    assert image.shape == (*size, 3)
    assert np.abs(image - np.linspace(0, 1, size[1])[:, None]).max() < 0.02


def test_a_large_jpeg_that_cannot_be_decoded_smaller_is_refused_before_it_is_decoded(monkeypatch):
    monkeypatch.setattr(images, "MAX_PIXELS", 1_000)
    for data in (jpeg_of(300, 400), jpeg_of(30, 40, progressive=True)):
        with pytest.raises(ImageError, match="at most 1000"):
            decode_rgb(data, "x")


@pytest.mark.parametrize("name", sample_files())
def test_a_file_truncated_at_any_length_is_refused_or_gives_the_whole_picture(name):
    data = sample_files()[name]
    whole = decode_rgb(data, name)
    for length in {*range(0, len(data), max(len(data) // 30, 1)), *range(max(len(data) - 16, 0), len(data))}:
        try:
            part = decode_rgb(data[:length], name)
        except ImageError:
            continue
        np.testing.assert_array_equal(part, whole)


def with_chunk(kind, content, length):
    """A PNG file with a chunk that states `length`, or the true one."""
    length = len(content) if length is None else length
    hostile = struct.pack(">I", length) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
    return png(2, 8, np.zeros((1, 1, 3)), hostile)


def with_flips(name, flips):
    data = bytearray(sample_files()[name])
    for place, bit in flips:
        data[int(place * len(data))] ^= 1 << bit
    return bytes(data)


CHUNKS = [b"IHDR", b"PLTE", b"tRNS", b"iCCP", b"zTXt", b"iTXt", b"eXIf", b"gAMA", b"acTL"]
names, place = st.sampled_from(sorted(sample_files())), st.floats(0, 1, exclude_max=True)
DAMAGED = {
    "flipped bits": (
        250,
        st.builds(with_flips, names, st.lists(st.tuples(place, st.integers(0, 7)), min_size=1, max_size=6)),
    ),
    "a chunk of a PNG file": (
        30,
        st.builds(
            with_chunk,
            st.sampled_from(CHUNKS),
            st.binary(max_size=40) | st.just(zlib.compress(bytes(10**7))),
            st.sampled_from([None, 0, 2**31 - 1, 2**32 - 1]),
        ),
    ),
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_files_are_an_image_error_or_a_picture(kind, monkeypatch):
    monkeypatch.setattr(images, "MAX_PIXELS", 1_000_000)  # 50 times faster for headers with the largest size
    count, files = DAMAGED[kind]

    @settings(max_examples=count)
    @given(files)
    def decode_any(data):
        with contextlib.suppress(ImageError):
            rgb = decode_rgb(data, "damaged")
            assert (rgb.shape[2:], rgb.dtype) == ((3,), np.float32)
            assert 0 <= rgb.min() <= rgb.max() <= 1

    decode_any()
