"""A transparent picture lies on white wherever it is decoded: in training, an export and a preview."""

import io

import cv2
import numpy as np
from PIL import Image

from retrieval.data.images import decode_rgb
from robot.export_lerobot import export_lerobot
from robot.importers.folder import import_folder
from robot.importers.lerobot import import_lerobot
from robot.recording.preview import write_preview
from robot.storage import decode_picture

ALPHA = np.random.default_rng(0).integers(0, 256, (8, 4, 4), np.uint8)
RGBA = Image.fromarray(ALPHA)
PALETTE = RGBA.convert("RGB").quantize(8)
TURNED = Image.Exif()
TURNED[274] = 6  # on its side
KINDS = {
    "RGBA": (RGBA, {}),
    "grey with alpha": (RGBA.convert("LA"), {}),
    "palette, one colour transparent": (PALETTE, {"transparency": 2}),
    "palette, levels": (PALETTE, {"transparency": bytes([0, 128, 255, 0, 1])}),
    "one colour transparent": (RGBA.convert("RGB"), {"transparency": tuple(map(int, ALPHA[1, 1, :3]))}),
    "one grey transparent": (RGBA.convert("L"), {"transparency": RGBA.convert("L").getpixel((0, 0))}),
    "turned": (RGBA, {"exif": TURNED}),
}


def check(folder, get):
    for name, (image, options) in KINDS.items():
        for kind in ("PNG", "WEBP")[: 2 if name == "RGBA" else 1]:
            buffer = io.BytesIO()
            image.save(buffer, kind, **options, **({"lossless": True} if kind == "WEBP" else {}))
            expected = np.rint(255 * decode_rgb(buffer.getvalue(), name)).astype(np.uint8)
            np.testing.assert_array_equal(decode_picture(buffer.getvalue()), expected, err_msg=name)
    (folder / "mug").mkdir()
    Image.new("RGBA", (32, 32), (0, 0, 0, 0)).save(folder / "mug" / "photo_0.png")
    Image.new("RGB", (32, 32), (0, 90, 0)).save(folder / "mug" / "touch_0.png")
    recording = import_folder(folder, folder / "recording")
    sheet = cv2.imread(str(write_preview(recording.folder, folder / "preview.png")))
    assert not (sheet == 0).all(axis=2).any()
    export_lerobot(recording, folder / "lerobot")
    again = import_lerobot(folder / "lerobot", folder / "again")
    assert cv2.imread(str(again.folder / again.grasps[0].photo)).min() > 250
