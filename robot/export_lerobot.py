"""Export of a recording as a LeRobot data set, version 3: `LeRobotDataset("name", root=OUT)`.

Written with pyarrow and PyAV according to the source of lerobot 0.4.4; lerobot itself is not needed.

    meta/info.json                                    features, counts, paths
    meta/stats.json                                   min, max, mean, std and count of each feature
    meta/tasks.parquet                                a task for each object: its object_id
    meta/episodes/chunk-000/file-000.parquet          an episode for each grasp, with its recorded fields
    data/chunk-000/file-000.parquet                   a row for each step: before, during, after the touch
    videos/observation.images.<camera>/chunk-000/file-000.mp4      camera: photo, touch_a, touch_b, ...

A grasp is an episode. Its steps are the moments before, during and after the touch that every grasp has. `moment` of a
step is 0 before, 1 during, 2 after the touch; all steps of an episode have the same photo. Videos are H.264 with key
frames only and colours at full resolution, but not lossless: on 144 touches of a GelSight Mini the root mean square
error is 0.86 grey levels, at most 1.2. Only the current grasp is in memory.
"""

import contextlib
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot.errors import ImporterError, RecordingError
from robot.importers.episodes import MOMENT_SUFFIXES, Picture
from robot.importers.importing import Progress, import_extra, picture_bytes
from robot.recording.folder import RecordedGrasp, Recording
from robot.storage import decode_picture, storage_errors

FPS = 1
"""Nominal, because steps have no fixed rate; readers require an integer."""
EPISODES_A_FILE = 500
FILES_A_CHUNK = 1000
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_DATA, _VIDEO = f"data/{_FILE}.parquet", "videos/{video_key}/" + f"{_FILE}.mp4"
_EPISODES = f"meta/episodes/{_FILE}.parquet"
_CODEC = {"crf": "10", "g": "1", "bf": "0", "preset": "fast"}
_STEP_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index", "moment")
_FACTS = ("source", "sensor", "rig", "licence", "terms", "citation", "background")
"""Keys of recording.json that info.json repeats."""
_WHAT = "LeRobot's format"


def export_lerobot(recording: Recording, out: Path, progress: Progress | None = None) -> tuple[str, ...]:
    """Write a LeRobot data set, version 3.

    Args:
        recording: The recording.
        out: New or empty folder; after an error it does not exist.
        progress: Called with (done, total) after each grasp.

    Returns:
        Remarks for the user.

    Raises:
        RecordingError: A picture is damaged, grasps differ in their fingers, or `out` is not empty.
        ImporterError: pyarrow or av is missing.
        StorageError: The folder cannot be written.
    """
    import_extra("pyarrow", _WHAT), import_extra("av", _WHAT)
    grasps, steps = recording.grasps, _EpisodeSteps(recording)
    tasks = {name: number for number, name in enumerate(dict.fromkeys(grasp.object_id for grasp in grasps))}
    with _new_folder(out) as folder:
        stats = {name: _Stats() for name in (*_STEP_COLUMNS, *map(_key, steps.sizes))}
        for start in range(0, len(grasps), EPISODES_A_FILE):
            with _FileWriter(folder, start, steps, tasks, stats) as file:
                for episode, grasp in enumerate(grasps[start : start + EPISODES_A_FILE], start):
                    file.append(episode, grasp)
                    if progress is not None:
                        progress(episode + 1, len(grasps))
        _write_tasks(folder / "meta" / "tasks.parquet", tasks)
        _write_json(folder / "meta" / "stats.json", {name: values.to_dict() for name, values in stats.items()})
        _write_json(folder / "meta" / "info.json", _info(recording, steps, len(tasks)))
    return steps.remarks()


@contextlib.contextmanager
def _new_folder(out: Path) -> Iterator[Path]:
    """Create a temporary folder next to `out` that becomes `out` if the block succeeds, and is deleted otherwise."""
    out = Path(os.path.abspath(out))
    with storage_errors(out):
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise RecordingError(f"{out} must be a new or an empty folder; choose another one")
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent, ignore_cleanup_errors=True) as folder:
            yield (part := Path(folder) / out.name)
            os.replace(part, out)


# Steps -----------------------------------------------------------------------------------------------------


class _EpisodeSteps:
    """The pictures of grasps as steps in time. Each camera has one size, that of the first grasp.

    Attributes:
        moments: Moments that every grasp has.
        sizes: (height, width) of `photo`, `touch_a`, ...
    """

    def __init__(self, recording: Recording) -> None:
        """Read the first grasp; raise RecordingError if there is none, or grasps differ in their fingers."""
        if not (grasps := recording.grasps):
            raise RecordingError(f"{recording.folder} must contain grasps, but contains none")
        self._folder = recording.folder
        self._fingers = sorted(grasps[0].touches)
        for grasp in grasps:
            if sorted(grasp.touches) != self._fingers:
                raise RecordingError(
                    f"every grasp must have the same fingers; {grasps[0].grasp_id} has {', '.join(self._fingers)}, "
                    f"{grasp.grasp_id} has {', '.join(sorted(grasp.touches))}"
                )
        self.moments = [moment for moment in MOMENT_SUFFIXES if all(map(self._has(moment), grasps))]
        self._left_out = [
            moment for moment in MOMENT_SUFFIXES if moment not in self.moments and any(map(self._has(moment), grasps))
        ]
        self.sizes = {name: pictures[0].shape[:2] for name, pictures in self._read(grasps[0]).items()}
        self._resized: dict[str, int] = {}

    def _has(self, moment: str) -> Callable[[RecordedGrasp], bool]:
        columns = {f"touch_{finger}{MOMENT_SUFFIXES[moment]}" for finger in self._fingers}
        return lambda grasp: grasp.images().keys() >= columns

    def pictures_of(self, grasp: RecordedGrasp) -> dict[str, list[Picture]]:
        """Return the pictures of each camera (photo, touch_a, ...), one per step.

        Raises:
            RecordingError: A picture is damaged.
        """
        pictures = self._read(grasp)
        for name, size in self.sizes.items():
            if any(picture.shape[:2] != size for picture in pictures[name]):
                self._resized[name] = self._resized.get(name, 0) + 1
                pictures[name] = [letterbox(picture, size) for picture in pictures[name]]
        return pictures

    def _read(self, grasp: RecordedGrasp) -> dict[str, list[Picture]]:
        files = grasp.images()
        touches = {
            f"touch_{finger}": [
                _read_picture(self._folder / files[f"touch_{finger}{MOMENT_SUFFIXES[moment]}"])
                for moment in self.moments
            ]
            for finger in self._fingers
        }
        return {"photo": [_read_picture(self._folder / files["photo"])] * len(self.moments), **touches}

    def remarks(self) -> tuple[str, ...]:
        """Return remarks on moments that are left out and on pictures that were resized so far."""
        left_out = [
            f"the frames {moment} the touch are left out because some grasps do not have them"
            for moment in self._left_out
        ]
        resized = [
            f"{name}: {count} grasp(s) had another size and were resized to {self.sizes[name][1]} x "
            f"{self.sizes[name][0]} with black borders"
            for name, count in self._resized.items()
        ]
        return (*left_out, *resized)


def _read_picture(path: Path) -> Picture:
    """Return the pixels of a complete PNG or JPEG file: (H, W, 3) uint8, RGB."""
    try:
        image = decode_picture(picture_bytes("picture", path))
    except ImporterError:
        image = None
    if image is None:
        raise RecordingError(f"{path} is missing, damaged or cut off; run `retrieve check`, and remove its line")
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)


def letterbox(picture: Picture, size: tuple[int, int]) -> Picture:
    """Scale a picture to fit into (height, width), centred on black."""
    scale = min(size[0] / picture.shape[0], size[1] / picture.shape[1])
    height, width = (max(round(scale * side), 1) for side in picture.shape[:2])
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    canvas = np.zeros((*size, 3), np.uint8)
    top, left = (size[0] - height) // 2, (size[1] - width) // 2
    canvas[top : top + height, left : left + width] = small
    return canvas


# Files -----------------------------------------------------------------------------------------------------


def _key(camera: str) -> str:
    return f"observation.images.{camera}"


class _FileWriter:
    """The data, videos and episodes of one file number. `with` closes it, also after an error."""

    def __init__(
        self, folder: Path, start: int, steps: _EpisodeSteps, tasks: Mapping[str, int], stats: Mapping[str, "_Stats"]
    ) -> None:
        chunk, file = divmod(start // EPISODES_A_FILE, FILES_A_CHUNK)
        self._numbers = {"chunk_index": chunk, "file_index": file}
        self._folder, self._start, self._steps, self._tasks, self._stats = folder, start, steps, tasks, stats
        self._rows: list[dict[str, Any]] = []
        self._episodes: list[dict[str, Any]] = []
        self._videos: dict[str, _VideoWriter] = {}

    def __enter__(self) -> "_FileWriter":
        for camera, size in self._steps.sizes.items():
            path = self._folder / _VIDEO.format(video_key=_key(camera), **self._numbers)
            self._videos[camera] = _VideoWriter(path, size)
        return self

    def append(self, episode: int, grasp: RecordedGrasp) -> None:
        """Write one grasp as an episode."""
        pictures, length = self._steps.pictures_of(grasp), len(self._steps.moments)
        first, task = episode * length, self._tasks[grasp.object_id]
        for step, moment in enumerate(self._steps.moments):
            values = (step / FPS, step, episode, first + step, task, list(MOMENT_SUFFIXES).index(moment))
            self._rows.append(dict(zip(_STEP_COLUMNS, values, strict=True)))
            for name, value in zip(_STEP_COLUMNS, values, strict=True):
                self._stats[name].add(np.array([[value]], dtype=np.float64))
        for camera, frames in pictures.items():
            for frame in frames:
                self._videos[camera].append(frame)
                self._stats[_key(camera)].add(frame.reshape(-1, 3) / 255.0)
        self._episodes.append(self._episode(episode, grasp, first, length))

    def _episode(self, episode: int, grasp: RecordedGrasp, first: int, length: int) -> dict[str, Any]:
        row: dict[str, Any] = {"episode_index": episode, "tasks": [grasp.object_id], "length": length}
        row |= {f"data/{key}": value for key, value in self._numbers.items()}
        row |= {"dataset_from_index": first, "dataset_to_index": first + length}
        start = (episode - self._start) * length / FPS
        for camera in self._steps.sizes:
            row |= {f"videos/{_key(camera)}/{key}": value for key, value in self._numbers.items()}
            row[f"videos/{_key(camera)}/from_timestamp"] = float(start)
            row[f"videos/{_key(camera)}/to_timestamp"] = float(start + length / FPS)
        row |= {f"meta/episodes/{key}": value for key, value in self._numbers.items()}
        fields = grasp.to_row()
        return row | {key: fields.get(key) for key in _PLAIN}

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        for video in self._videos.values():
            video.close()
        if kind is None:
            pa = import_extra("pyarrow", _WHAT)
            kinds = {"string": pa.string(), "bool": pa.bool_(), "double": pa.float64(), "list": pa.list_(pa.float64())}
            plain = {key: kinds[kind] for key, kind in _PLAIN.items()}
            _write_table(self._folder / _DATA.format(**self._numbers), self._rows, {"timestamp": pa.float32()})
            _write_table(self._folder / _EPISODES.format(**self._numbers), self._episodes, plain)


class _VideoWriter:
    """A video of pictures of one size, with key frames only."""

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        av = import_extra("av", _WHAT)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._av, self._count = av, 0
        self._container = av.open(str(path), "w")
        self._stream = self._container.add_stream("libx264", rate=FPS, options=_CODEC)
        self._stream.height, self._stream.width = size
        self._stream.pix_fmt = "yuv444p"

    def append(self, picture: Picture) -> None:
        """Add the next frame."""
        frame = self._av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts, frame.time_base = self._count, Fraction(1, FPS)
        self._count += 1
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Write the buffered frames and close the file."""
        self._container.mux(self._stream.encode())
        self._container.close()


class _Stats:
    """Minimum, maximum, mean and standard deviation of each channel."""

    def __init__(self) -> None:
        self._count, self._sum, self._squares = 0, np.zeros(1), np.zeros(1)
        self._low, self._high = np.full(1, np.inf), np.full(1, -np.inf)

    def add(self, values: NDArray[np.float64]) -> None:
        """Add values (n, c)."""
        self._count += len(values)
        self._sum = self._sum + values.sum(axis=0)
        self._squares = self._squares + np.square(values).sum(axis=0)
        self._low, self._high = np.minimum(self._low, values.min(axis=0)), np.maximum(self._high, values.max(axis=0))

    def to_dict(self) -> dict[str, Any]:
        """Return the statistics in the layout of LeRobot: (3, 1, 1) in 0..1 for pictures."""
        mean = self._sum / self._count
        deviation = np.sqrt(np.maximum(self._squares / self._count - mean**2, 0.0))
        statistics = {"min": self._low, "max": self._high, "mean": mean, "std": deviation}
        shape = (-1, 1, 1) if len(mean) == 3 else (-1,)
        return {name: value.reshape(shape).tolist() for name, value in statistics.items()} | {"count": [self._count]}


# Files of meta/ --------------------------------------------------------------------------------------------

_PLAIN = {
    "grasp_id": "string",
    "object_id": "string",
    "sequence_id": "string",
    "grasped": "bool",
    "outcome": "string",
    "force_n": "double",
    "opening_mm": "double",
    "touch_skew_s": "double",
    "time_s": "double",
    "pose": "list",
}


def _write_table(path: Path, rows: Sequence[Mapping[str, Any]], types: Mapping[str, Any]) -> None:
    """Write a Parquet file of rows with the same keys; `types` are those that values do not determine."""
    pa = import_extra("pyarrow", _WHAT)
    columns = {key: pa.array([row[key] for row in rows], types.get(key)) for key in rows[0]}
    path.parent.mkdir(parents=True, exist_ok=True)
    import_extra("pyarrow.parquet", _WHAT).write_table(pa.table(columns), path)


def _write_tasks(path: Path, tasks: Mapping[str, int]) -> None:
    """Write tasks like a pandas frame with column task_index and the tasks as index, the layout that LeRobot reads."""
    pa = import_extra("pyarrow", _WHAT)
    index = "__index_level_0__"
    columns = [
        {"name": name, "field_name": field, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}
        for name, field, kind, numpy_type in (
            ("task_index", "task_index", "int64", "int64"),
            (None, index, "unicode", "object"),
        )
    ]
    metadata = {"index_columns": [index], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    table = pa.table(
        {"task_index": pa.array(list(tasks.values()), pa.int64()), index: pa.array(list(tasks), pa.string())}
    )
    table = table.replace_schema_metadata({b"pandas": json.dumps(metadata).encode()})
    import_extra("pyarrow.parquet", _WHAT).write_table(table, path)


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=4) + "\n", "utf-8")


def _info(recording: Recording, steps: _EpisodeSteps, tasks: int) -> dict[str, Any]:
    episodes = len(recording.grasps)
    return {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": episodes,
        "total_frames": episodes * len(steps.moments),
        "total_tasks": tasks,
        "chunks_size": FILES_A_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": FPS,
        "splits": {"train": f"0:{episodes}"},
        "data_path": _DATA,
        "video_path": _VIDEO,
        "features": {_key(camera): _video_feature(size) for camera, size in steps.sizes.items()}
        | {
            name: {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None}
            for name in _STEP_COLUMNS
        },
        "recording": {key: recording.info.get(key) for key in _FACTS} | {"moments": steps.moments},
    }


def _video_feature(size: tuple[int, int]) -> dict[str, Any]:
    height, width = size
    info = {
        "video.height": height,
        "video.width": width,
        "video.codec": "h264",
        "video.pix_fmt": "yuv444p",
        "video.is_depth_map": False,
        "video.fps": FPS,
        "video.channels": 3,
        "has_audio": False,
    }
    return {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": info}
