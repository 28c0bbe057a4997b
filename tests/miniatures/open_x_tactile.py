"""Open-X-Tactile: a task as a .zarr.zip with implicit groups, and one unpacked.

They have three and two episodes of a few steps with two areas each. The touch is the third step of an episode.
"""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from tests.miniatures import pixels

EPISODES = {"insert_plug": (4, 5, 3), "wipe_board": (3, 4)}
GRASPS = sum(map(len, EPISODES.values()))
PRESSED = 2


def write(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, (task, lengths) in enumerate(EPISODES.items()):
        path = folder / f"{task}.zarr"
        write_store(path, lengths, 1000 * number)
        if number == 0:
            for group in (path / "data/.zgroup", path / "meta/.zgroup"):
                group.unlink()
            shutil.make_archive(str(path), "zip", path)
            shutil.rmtree(path)


def write_store(path: Path, lengths: tuple[int, ...], seed: int = 0, **more: Any) -> None:
    """Write a store of version 2; `more` are further arrays by path."""
    root = zarr.open_group(str(path), mode="w", zarr_format=2)
    steps = [frame for episode, length in enumerate(lengths) for frame in episode_steps(seed + 100 * episode, length)]
    arrays = {
        "meta/episode_ends": np.cumsum(lengths, dtype=np.int64),
        "data/camera_main_rgb": np.stack([camera for camera, _ in steps]),
        "data/right_tactile_data_0": np.stack([touch for _, touch in steps]),
        "data/right_tactile_sensor_0": np.array(["GelSightMini"]),
        "data/right_tactile_type_0": np.array(["image"]),
        "data/right_tactile_data_1": np.zeros((len(steps), 2, 4, 4, 3), np.uint8),
        "data/right_tactile_type_1": np.array(["state"]),
        "data/right_wrist_pose": np.zeros((len(steps), 6)),
        **more,
    }
    for name, values in arrays.items():
        group = root.require_group(name.split("/")[0])
        chunks = (1, *values.shape[1:]) if name.endswith(("_rgb", "_data_0", "_data_1")) else values.shape
        group.create_array(name.split("/")[1], shape=values.shape, chunks=chunks, dtype=values.dtype)[...] = values


def episode_steps(seed: int, length: int) -> list[tuple[Any, Any]]:
    """Return (camera, (2, H, W, 3)) of each step: gels without contact and with a little noise, except at PRESSED."""
    rest = np.stack([pixels(seed + finger) for finger in (1, 2)])
    pressed = np.stack([pixels(seed + finger) for finger in (3, 4)])
    return [
        (pixels(seed + 10 + step, (20, 30)), pressed if step == PRESSED else rest ^ (step & 1))
        for step in range(length)
    ]
