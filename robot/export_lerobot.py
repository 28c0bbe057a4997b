"""Export of a recording as a LeRobot data set, version 3: `LeRobotDataset("name", root=OUT)`.

Written with pyarrow and PyAV according to the source of lerobot 0.4.4.

    meta/info.json                                    features, counts, paths
    meta/stats.json                                   min, max, mean, std and count of each feature
    meta/tasks.parquet                                a task for each object: its object_id
    meta/episodes/chunk-000/file-000.parquet          an episode for each grasp, with its recorded fields
    data/chunk-000/file-000.parquet                   a row for each step: before, during, after the touch
    videos/observation.images.<camera>/chunk-000/file-000.mp4      camera: photo, touch_a, touch_b, ...

A grasp is an episode. Its steps are the moments before, during and after the touch that every grasp has. `moment` of a
step is 0 before, 1 during, 2 after the touch; all steps of an episode share its photo. Videos are H.264 with key frames
only and colours at full resolution, but not lossless: on 144 touches of a GelSight Mini the root mean square
error is 0.86 grey levels, at most 1.2.
"""

import contextlib
import json
import math
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
from robot.extras import import_extra
from robot.importers.episodes import MOMENT_SUFFIXES, Picture
from robot.importers.importing import Progress, picture_bytes
from robot.importers.lerobot import DATA_PATH, EPISODES_PATH, VIDEO_PATH
from robot.recording.folder import Recording
from robot.recording.grasp import RecordedGrasp
from robot.storage import decode_picture, storage_errors

FPS = 1
"""Nominal, because steps have no fixed rate; readers require an integer."""
_NUMBERS = {"chunk_index": 0, "file_index": 0}
_STEP_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index", "moment")
_FIELDS = {
    **dict.fromkeys(("grasp_id", "object_id", "sequence_id", "session", "outcome"), "string"),
    "grasped": "bool_",
    **dict.fromkeys(("force_n", "opening_mm", "touch_skew_s", "time_s", "pose"), "float64"),
}
"""Recorded fields of an episode, with the name of their type in pyarrow; a pose is a list."""
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
    pa, av = import_extra("pyarrow", _WHAT), import_extra("av", _WHAT)
    if not (grasps := recording.grasps):
        raise RecordingError(f"{recording.folder} must contain grasps, but contains none")
    fingers = sorted(grasps[0].touches)
    for grasp in grasps:
        if sorted(grasp.touches) != fingers:
            raise RecordingError(
                f"every grasp must have the same fingers; {grasps[0].grasp_id} has {', '.join(fingers)}, "
                f"{grasp.grasp_id} has {', '.join(sorted(grasp.touches))}"
            )
    columns = {moment: [f"touch_{finger}{suffix}" for finger in fingers] for moment, suffix in MOMENT_SUFFIXES.items()}
    recorded = {moment: [set(some) <= grasp.images().keys() for grasp in grasps] for moment, some in columns.items()}
    moments = [moment for moment, has_moment in recorded.items() if all(has_moment)]
    suffixes = [MOMENT_SUFFIXES[moment] for moment in moments]
    per_camera = {"photo": ["photo"] * len(moments)} if all(grasp.photo for grasp in grasps) else {}
    per_camera |= {f"touch_{finger}": [f"touch_{finger}{suffix}" for suffix in suffixes] for finger in fingers}
    first = grasps[0].images()
    cameras = [
        _Camera(name, of_camera, _read_picture(recording.folder / first[of_camera[0]]).shape[:2])
        for name, of_camera in per_camera.items()
    ]
    numbers = [list(MOMENT_SUFFIXES).index(moment) for moment in moments]
    tasks = {name: number for number, name in enumerate(dict.fromkeys(grasp.object_id for grasp in grasps))}
    steps: list[dict[str, Any]] = []
    episodes: list[dict[str, Any]] = []
    with _new_folder(out) as folder:
        with contextlib.ExitStack() as videos:
            for camera in cameras:
                videos.enter_context(camera.video(av, folder))
            for episode, grasp in enumerate(grasps):
                for step, moment_number in enumerate(numbers):
                    values = (step / FPS, step, episode, len(steps), tasks[grasp.object_id], moment_number)
                    steps.append(dict(zip(_STEP_COLUMNS, values, strict=True)))
                for camera in cameras:
                    for column in camera.columns:
                        camera.add(av, _read_picture(recording.folder / grasp.images()[column]))
                episodes.append(_episode(episode, grasp, len(moments), cameras))
                if progress is not None:
                    progress(episode + 1, len(grasps))
        types = {key: getattr(pa, kind)() for key, kind in _FIELDS.items()}
        types["pose"] = pa.list_(types["pose"])
        tables = {
            DATA_PATH.format(**_NUMBERS): _table(pa, steps, {"timestamp": pa.float32()}),
            EPISODES_PATH.format(**_NUMBERS): _table(pa, episodes, types),
            "meta/tasks.parquet": _task_table(pa, tasks),
        }
        for path, table in tables.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            import_extra("pyarrow.parquet", _WHAT).write_table(table, folder / path)
        stats = {
            name: _stats([_summary(np.array([[step[name]] for step in steps], np.float64))], len(steps))
            for name in _STEP_COLUMNS
        }
        for camera in cameras:
            stats[camera.key] = _stats(camera.summaries, len(camera.summaries) * math.prod(camera.size))
        for name, document in (("stats", stats), ("info", _info(recording, moments, cameras, len(tasks)))):
            (folder / "meta" / f"{name}.json").write_text(json.dumps(document, indent=4) + "\n", "utf-8")
    recorded = {f"frames {moment} the touch": has_moment for moment, has_moment in recorded.items()}
    recorded["photos"] = [grasp.photo is not None for grasp in grasps]
    return tuple(
        f"the {what} are left out because some grasps do not have them"
        for what, has_it in recorded.items()
        if any(has_it) and not all(has_it)
    )


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


def _read_picture(path: Path) -> Picture:
    try:
        image = decode_picture(picture_bytes("picture", path))
    except ImporterError:
        image = None
    if image is None:
        raise RecordingError(f"{path} is missing, damaged or cut off; run `retrieve check`, and remove its line")
    return image


def _letterbox(picture: Picture, size: tuple[int, int]) -> Picture:
    """Scale a picture to fit into (height, width), centred on black; a picture of this size stays as it is."""
    if picture.shape[:2] == size:
        return picture
    scale = min(size[0] / picture.shape[0], size[1] / picture.shape[1])
    height, width = (max(round(scale * side), 1) for side in picture.shape[:2])
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    canvas = np.zeros((*size, 3), np.uint8)
    top, left = (size[0] - height) // 2, (size[1] - width) // 2
    canvas[top : top + height, left : left + width] = small
    return canvas


def _summary(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return minimum, maximum, mean and mean square of values (n, c), (4, c)."""
    return np.stack([values.min(0), values.max(0), values.mean(0), np.square(values).mean(0)])


def _stats(summaries: Sequence[NDArray[np.float64]], count: int) -> dict[str, Any]:
    """Return the statistics of parts of equal size in the layout of LeRobot: (3, 1, 1) in 0..1 for pictures."""
    low, high, means, squares = np.stack(summaries, axis=1)
    mean = means.mean(0)
    deviation = np.sqrt(np.maximum(squares.mean(0) - mean**2, 0.0))
    statistics = {"min": low.min(0), "max": high.max(0), "mean": mean, "std": deviation}
    shape = (-1, 1, 1) if len(mean) == 3 else (-1,)
    return {name: value.reshape(shape).tolist() for name, value in statistics.items()} | {"count": [count]}


class _Camera:
    """A camera of the data set: its columns of a recording, step by step, and its video, with key frames only."""

    _encode: Callable[[Any], None]

    def __init__(self, name: str, columns: Sequence[str], size: tuple[int, int]) -> None:
        self.key, self.columns, self.size = f"observation.images.{name}", columns, size
        self.summaries: list[NDArray[np.float64]] = []

    @contextlib.contextmanager
    def video(self, av: Any, folder: Path) -> Iterator[None]:
        """Open the video in the data set's folder; pictures can be added inside the block."""
        path = folder / VIDEO_PATH.format(video_key=self.key, **_NUMBERS)
        path.parent.mkdir(parents=True)
        with av.open(str(path), "w") as container:
            stream = container.add_stream(
                "libx264", rate=FPS, options={"crf": "10", "g": "1", "bf": "0", "preset": "fast"}
            )
            stream.height, stream.width = self.size
            stream.pix_fmt = "yuv444p"
            self._encode = lambda frame: container.mux(stream.encode(frame))
            yield
            self._encode(None)

    def add(self, av: Any, picture: Picture) -> None:
        """Add a picture to the video, scaled to its size."""
        picture = _letterbox(picture, self.size)
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts, frame.time_base = len(self.summaries), Fraction(1, FPS)
        self._encode(frame)
        self.summaries.append(_summary(picture.reshape(-1, 3) / 255.0))


def _episode(episode: int, grasp: RecordedGrasp, length: int, cameras: Sequence[_Camera]) -> dict[str, Any]:
    row: dict[str, Any] = {"episode_index": episode, "tasks": [grasp.object_id], "length": length}
    row |= {"dataset_from_index": episode * length, "dataset_to_index": (episode + 1) * length}
    for table in ("data", "meta/episodes", *(f"videos/{camera.key}" for camera in cameras)):
        row |= {f"{table}/{key}": value for key, value in _NUMBERS.items()}
    for camera in cameras:
        row[f"videos/{camera.key}/from_timestamp"] = float(episode * length / FPS)
        row[f"videos/{camera.key}/to_timestamp"] = float((episode + 1) * length / FPS)
    return row | {key: getattr(grasp, key) for key in _FIELDS}


def _table(pa: Any, rows: Sequence[Mapping[str, Any]], types: Mapping[str, Any]) -> Any:
    """Return the pyarrow table of rows with the same keys; `types` are those that values do not determine."""
    return pa.table({key: pa.array([row[key] for row in rows], types.get(key)) for key in rows[0]})


def _task_table(pa: Any, tasks: Mapping[str, int]) -> Any:
    """Return tasks like a pandas frame with column task_index and the tasks as index, the layout that LeRobot reads."""
    index = "__index_level_0__"
    kinds = {"task_index": ("task_index", "int64", "int64"), index: (None, "unicode", "object")}
    columns = [
        {"name": name, "field_name": field, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}
        for field, (name, kind, numpy_type) in kinds.items()
    ]
    metadata = {"index_columns": [index], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    table = pa.table({"task_index": pa.array(tasks.values(), pa.int64()), index: pa.array(tasks, pa.string())})
    return table.replace_schema_metadata({b"pandas": json.dumps(metadata).encode()})


def _info(recording: Recording, moments: Sequence[str], cameras: Sequence[_Camera], tasks: int) -> dict[str, Any]:
    episodes = len(recording.grasps)
    video = {"video.codec": "h264", "video.pix_fmt": "yuv444p", "video.is_depth_map": False, "video.fps": FPS}
    features: dict[str, Any] = {
        camera.key: {
            "dtype": "video",
            "shape": [*camera.size, 3],
            "names": ["height", "width", "channels"],
            "info": {"video.height": camera.size[0], "video.width": camera.size[1], **video, "video.channels": 3}
            | {"has_audio": False},
        }
        for camera in cameras
    }
    for name in _STEP_COLUMNS:
        features[name] = {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None}
    return {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": episodes,
        "total_frames": episodes * len(moments),
        "total_tasks": tasks,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": FPS,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH,
        "features": features,
        "recording": {
            key: recording.info.get(key)
            for key in ("source", "sensor", "rig", "licence", "terms", "citation", "background")
        }
        | {"moments": list(moments)},
    }
