"""X-Capture: two objects with three points, one touch without its photo, and files that the importer ignores."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from tests.miniatures import picture

OBJECTS, POINTS = ("00071", "00102"), ("000", "001", "002")
GRASPS = len(OBJECTS) * len(POINTS)


def write(folder: Path, objects: Sequence[str] = OBJECTS) -> None:
    for number, name in enumerate(objects):
        for index, point in enumerate(POINTS):
            path = folder / name / point
            seed = 100 * number + 10 * index
            picture(path / f"{point}_rgb.png", seed, (20, 24))
            picture(path / f"{point}_10N_tactile.png", seed + 1, (24, 18))
            depth = np.full((20, 24), 400 + seed, np.uint16)
            (path / f"{point}_depth.png").write_bytes(cv2.imencode(".png", depth)[1].tobytes())
            (path / f"{point}_15N_force.npy").write_bytes(b"\x93NUMPY")
            picture(path / "pointcloud" / f"{point}_mask_0.png", seed + 2)
    picture(folder / objects[0] / "003" / "003_10N_tactile.png", 9)
