"""`import folder` reads pictures of the formats that a catalogue reads, or names those that it leaves out."""

import numpy as np
from PIL import Image

from retrieval.data.images import read_rgb
from robot.importers.folder import import_folder


def check(folder, get):
    endings = ("bmp", "TIF", "tiff", "webp", "png", "JPG", "jfif")
    for number, ending in enumerate(endings):
        pixels = np.random.default_rng(number).integers(0, 256, (8, 8, 3), np.uint8)
        (folder / ending).mkdir()
        for name in ("touch_0", "photo_0"):
            options = {"lossless": True} if ending == "webp" else {}
            Image.fromarray(pixels).save(folder / ending / f"{name}.{ending}", **options)
    for name, mode in (("deep", "I;16"), ("clear", "RGBA")):  # neither clipped nor given a background
        (folder / name).mkdir()
        for each in ("touch_0", "photo_0"):
            Image.new(mode, (8, 8)).save(folder / name / f"{each}.tif")
    (folder / "heic").mkdir()
    for name in ("touch_0", "photo_0"):
        (folder / "heic" / f"{name}.heic").write_bytes(b"\0\0\0\x18ftypheic")
    recording = import_folder(folder, folder.parent / "out")
    assert {grasp.object_id for grasp in recording.grasps} == set(endings)
    for grasp in recording.grasps:
        photo = read_rgb(recording.folder / grasp.photo)
        assert (photo == read_rgb(folder / grasp.object_id / f"photo_0.{grasp.object_id}")).all()
    assert "skipped 3: its photo is not a readable picture" in " ".join(recording.notes)
