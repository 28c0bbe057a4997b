"""A LeRobot data set like one of a robot: four episodes of two tasks.

The wrist camera and one gel camera are videos, another gel camera is in the rows of steps. The touch is the third step
of an episode.
"""

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.miniatures import encoded, pixels

LENGTHS = (4, 6, 3, 5)
TASKS = ("pick the mug", "pick the tin")
GRASPS = len(LENGTHS)
PRESSED, FPS = 2, 10
WRIST, LEFT, RIGHT = "observation.images.wrist", "observation.images.left_tactile", "observation.images.right_tactile"
SIZE = (48, 64)


def pictures(episode: int, step: int) -> dict[str, int]:
    """Return the seed of each camera's picture."""
    pressed = step == PRESSED
    return {WRIST: 100 * episode + step, LEFT: 1000 + 10 * episode + pressed, RIGHT: 2000 + 10 * episode + pressed}


def write(folder: Path) -> None:
    for name in ("meta/episodes/chunk-000", "data/chunk-000"):
        (folder / name).mkdir(parents=True)
    for key in (WRIST, LEFT):
        write_video(folder / f"videos/{key}/chunk-000/file-000.mp4", key)
    steps, episodes = [], []
    for episode, length in enumerate(LENGTHS):
        first = sum(LENGTHS[:episode])
        numbers = {"chunk_index": 0, "file_index": 0}
        row: dict[str, Any] = {"episode_index": episode, "tasks": [TASKS[episode % 2]], "length": length}
        row |= {f"data/{key}": value for key, value in numbers.items()}
        row |= {"dataset_from_index": first, "dataset_to_index": first + length}
        for key in (WRIST, LEFT):
            row |= {f"videos/{key}/{name}": value for name, value in numbers.items()}
            row |= {f"videos/{key}/from_timestamp": first / FPS, f"videos/{key}/to_timestamp": (first + length) / FPS}
        episodes.append(row | {"stats/action/mean": [0.0]})
        for step in range(length):
            cell = {"bytes": encoded(".png", pictures(episode, step)[RIGHT], SIZE), "path": None}
            steps.append({"action": [0.0], "episode_index": episode, "frame_index": step, RIGHT: cell})
    pq.write_table(pa.Table.from_pylist(episodes), folder / "meta/episodes/chunk-000/file-000.parquet")
    pq.write_table(pa.Table.from_pylist(steps), folder / "data/chunk-000/file-000.parquet")
    pq.write_table(pa.table({"task_index": [0, 1], "task": list(TASKS)}), folder / "meta/tasks.parquet")
    features = {WRIST: "video", LEFT: "video", RIGHT: "image", "action": "float32"}
    info = {
        "codebase_version": "v3.0",
        "robot_type": "so100",
        "total_episodes": len(LENGTHS),
        "fps": FPS,
        "splits": {"train": "0:4"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": {key: {"dtype": kind, "shape": [*SIZE, 3], "names": None} for key, kind in features.items()},
    }
    (folder / "meta/info.json").write_text(json.dumps(info))


def write_video(path: Path, key: str) -> None:
    """Write all episodes of a camera to one video, with frames that depend on each other."""
    path.parent.mkdir(parents=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "5", "g": "5"})
        stream.height, stream.width, stream.pix_fmt = *SIZE, "yuv444p"
        seeds = [pictures(episode, step)[key] for episode, length in enumerate(LENGTHS) for step in range(length)]
        for number, seed in enumerate(seeds):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels(seed, SIZE)), format="bgr24")
            frame.pts, frame.time_base = number, Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
