"""Miniatures of public data sets, for their importers: the published layout with small synthetic pictures.

Each module has `write(folder)`, which creates the data set in a new folder, and `GRASPS`, its number of grasps.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np


def picture(path: Path, seed: int, size: tuple[int, int] = (12, 16), **changes: Any) -> Path:
    """Write a synthetic picture of size (H, W) for a seed. `grey`: one channel."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded(path.suffix, seed, size, **changes))
    return path


def encoded(suffix: str, seed: int, size: tuple[int, int] = (12, 16), grey: bool = False) -> bytes:
    """Return the content of such a file."""
    image = pixels(seed, size)
    return bytes(cv2.imencode(suffix, image[..., 0] if grey else image)[1].tobytes())


def pixels(seed: int, size: tuple[int, int] = (12, 16)) -> Any:
    """Return (H, W, 3) uint8, smooth."""
    small = np.random.default_rng(seed).integers(0, 256, (3, 4, 3), dtype=np.uint8)
    return cv2.resize(small, size[::-1], interpolation=cv2.INTER_LINEAR)
