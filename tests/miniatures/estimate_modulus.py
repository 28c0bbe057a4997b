"""EstimateModulus: two days with another light and other names of files; two of the objects were pressed on both."""

from pathlib import Path

import numpy as np

from tests.miniatures import physiclear

DAYS = {
    "2023-12-06": ("{}_{}.avi", 1, ("foam_brick", "golf_ball", "green_ball")),
    "2023-12-16": ("{}__t={}.avi", 0, ("golf_ball", "green_ball", "strawberry", "bolt")),
}
"""Day -> pattern and first number of its files, and its objects."""
VIDEOS = 2
GRASPS = 7 * VIDEOS * physiclear.IMPORTED
_NAMES = ("foam_brick", "golf_ball", "green_ball", "strawberry", "bolt")


def write(folder: Path) -> None:
    for number, (day, (pattern, first, objects)) in enumerate(DAYS.items()):
        for name in objects:
            for k in range(VIDEOS):
                frames = physiclear.presses(_NAMES.index(name), k)
                light = (np.clip(frame + 25.0 * number, 0, 255).astype(np.uint8) for frame in frames)
                physiclear.write_video(folder / day / pattern.format(name, first + k), list(light))
