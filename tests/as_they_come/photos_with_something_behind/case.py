"""Whether a photo is whole is what its decoder says, not what the bytes at the end of its file look like.

A phone writes a film, a second picture or a depth map behind a photo; a small copy inside it ends like a photo.
"""

import io

import numpy as np
import pytest
from PIL import Image

from retrieval.data import images
from robot.errors import ImporterError
from robot.importers.folder import import_folder
from robot.importers.importing import picture_bytes
from tests.as_they_come import write_pictures


def jpeg(height=48, width=64, **options):
    pixels = np.random.default_rng(height).integers(0, 256, (height, width, 3), np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", **options)
    return buffer.getvalue()


def check(folder, get):
    small = jpeg(8, 8)
    segment = b"\xff\xe1" + (len(small) + 2).to_bytes(2, "big") + small
    with_copy = b"\xff\xd8" + segment + jpeg()[2:]  # as a camera stores a thumbnail
    png = write_pictures(folder, "a.png").joinpath("a.png").read_bytes()
    film = bytes(70_000)  # longer than any end that was searched, without an end marker
    for data in (jpeg(), jpeg(progressive=True), with_copy, png):
        for whole in (data, data + film, data + small + film, data + b"\r\n"):
            assert picture_bytes("photo", whole) == whole
            assert images.decode_rgb(whole, "photo").shape == images.decode_rgb(data, "photo").shape
        for cut in (data[:-60], data[: len(data) // 2]):
            with pytest.raises(ImporterError, match="its photo is cut off"):
                picture_bytes("photo", cut)
    (folder / "mug").mkdir()
    (folder / "mug" / "touch_0.png").write_bytes(png)
    (folder / "mug" / "photo_0.jpg").write_bytes(with_copy + film)
    assert len(import_folder(folder, folder / "out").grasps) == 1

    several = io.BytesIO()  # as most phones write now: a picture, and its brightness or depth
    Image.open(io.BytesIO(jpeg(480, 640))).save(
        several, "MPO", save_all=True, append_images=[Image.open(io.BytesIO(small))]
    )
    assert Image.open(several).format == "MPO"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(images, "MAX_PIXELS", 480 * 640 - 1)
        for data in (several.getvalue(), several.getvalue() + film):
            assert images.decode_rgb(data, "photo").shape == (240, 320, 3)
    assert images.decode(several.getvalue(), "photo", 60).shape == (60, 80, 3)
    assert images.decode(several.getvalue(), "photo").shape == (480, 640, 3)
