"""X-Capture: two objects of three points, one touch without its photo, and the files that the importer passes over."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from tests.miniatures import picture

OBJECTS, POINTS = ("00071", "00102"), ("000", "001", "002")
GRASPS = len(OBJECTS) * len(POINTS)


def write(folder: Path, objects: Sequence[str] = OBJECTS) -> None:
    for number, name in enumerate(objects):
        for place, point in enumerate(POINTS):
            at = folder / name / point
            seed = 100 * number + 10 * place
            picture(at / f"{point}_rgb.png", seed, (20, 24))
            picture(at / f"{point}_10N_tactile.png", seed + 1, (24, 18))
            depth = np.full((20, 24), 400 + seed, np.uint16)
            (at / f"{point}_depth.png").write_bytes(cv2.imencode(".png", depth)[1].tobytes())
            (at / f"{point}_15N_force.npy").write_bytes(b"\x93NUMPY")
            picture(at / "pointcloud" / f"{point}_mask_0.png", seed + 2)
    picture(folder / objects[0] / "003" / "003_10N_tactile.png", 9)
