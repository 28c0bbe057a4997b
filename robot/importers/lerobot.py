"""LeRobot data sets, version 3: robot episodes with gel cameras among their cameras; and our own exports.

They are read with pyarrow and PyAV, without lerobot. This was checked on a data set that lerobot 0.4.4 wrote.

    meta/info.json    meta/tasks.parquet    meta/episodes/chunk-000/file-000.parquet
    data/chunk-000/file-000.parquet         rows of steps; with pictures if a camera is not a video
    videos/<key>/chunk-000/file-000.mp4     a camera, the episodes of a file one after the other

The option `touch` names the gel cameras, separated by commas, and `photo` the camera that shows the object. By default
cameras with the word touch, tactile, gel or digit in their name are gel cameras, and the first other camera that is not
stated to be of depth takes the photo; both are printed. An
episode becomes one grasp: its first step provides the no-contact frame and the photo, and the step whose gel images
differ most from the first is the touch. If the episodes have fields for object and sequence, like the exports of
`retrieve export-recording`, these fields are imported. Otherwise the task is the object and the episode the sequence.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from _touch_retrieval.text import decode_text
from robot.errors import ImporterError
from robot.extras import import_extra
from robot.importers.episodes import Picture, Step, episode_images
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    Item,
    Progress,
    Skip,
    import_items,
)
from robot.recording.folder import Recording, safe_name
from robot.storage import decode_picture, read_content

DATA_SET = DataSet(
    source="LeRobot data set",
    licence=NOT_STATED,
    terms="see the data set's own card",
    citation="see the data set's own card",
    sensor="names of the cameras",
    rig="see info.json",
    expects="`meta/info.json` of a LeRobot data set, version 3",
    fingers=0,
    background="the first step of each episode",
    caveats=(
        "A task counts as one object unless the episodes name objects; a task with several objects does not "
        "distinguish them.",
        "The touch of an episode is the step that differs most from the first; a change of light can cause this too.",
        "Videos are not lossless: fine relief may be lost.",
    ),
    unverified=("that the first step of an episode is without contact",),
)
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH, EPISODES_PATH = f"data/{_FILE}.parquet", f"meta/episodes/{_FILE}.parquet"
VIDEO_PATH = "videos/{video_key}/" + f"{_FILE}.mp4"
_GEL = re.compile(r"(?<![a-z])(touch|tactile|gels?|gelsight[a-z]*|gelslim|digit|digit360)(?![a-z])", re.IGNORECASE)
"""Whole words in the name of a gel camera: touchscreen, digital and angel are others."""
_FIELDS = ("force_n", "opening_mm", "touch_skew_s", "time_s", "session", "outcome", "grasped", "pose")
_WHAT = "a LeRobot data set"

_Row = dict[str, Any]


def import_lerobot(
    src: Path, out: Path, progress: Progress | None = None, *, touch: str = "", photo: str = ""
) -> Recording:
    """Import the episodes below `src`.

    Raises:
        ImporterError: pyarrow or av is missing, or `src` is not a data set of version 3.
    """
    if not (src / "meta" / "info.json").is_file():
        raise DATA_SET.mismatch_error(src, "there is no such file")
    source = _LeRobotSource(src, touch, photo)
    total = sum(1 for _ in source.episodes(("episode_index",)))
    cameras = f"gel cameras: {', '.join(source.touch)}; photo: {source.photo}; others: --option touch=... photo=..."
    return import_items(
        replace(
            DATA_SET,
            fingers=len(source.touch),
            caveats=(cameras, *DATA_SET.caveats),
            **source.stored_facts(),
        ),
        source.items(),
        out,
        total=total,
        progress=progress,
        source=src,
        options={"touch": touch, "photo": photo},
    )


class _Feature(msgspec.Struct):
    dtype: str
    info: dict[str, Any] | None = None

    @property
    def is_depth(self) -> bool:
        """Whether the data set states that a camera's pictures are depth, as LeRobot and older versions write it."""
        return any((self.info or {}).get(key) for key in ("is_depth_map", "video.is_depth_map"))


class _Moments(msgspec.Struct):
    moments: list[Literal["before", "during", "after"]] | None = None


class _Info(msgspec.Struct):
    """The keys of info.json that are read; `recording` is of our own exports."""

    codebase_version: str
    fps: Annotated[float, msgspec.Meta(gt=0, le=1e6)]
    features: dict[str, _Feature]
    data_path: str = DATA_PATH
    video_path: str = VIDEO_PATH
    robot_type: str | None = None
    recording: dict[str, Any] = {}


def _read_info(path: Path) -> _Info:
    try:
        info = msgspec.json.decode(decode_text(read_content(path, ImporterError)), type=_Info)
        msgspec.convert(info.recording, _Moments)
    except ValueError as error:
        raise ImporterError(f"{path} must be that of a LeRobot data set: {error}") from error
    if not re.fullmatch(r"v3(\.\d+)*", info.codebase_version):
        raise ImporterError(f"{path} must have LeRobot version 3, got {info.codebase_version}; convert it with lerobot")
    if (info.data_path, info.video_path) != (DATA_PATH, VIDEO_PATH):
        raise ImporterError(
            f"{path} must have the paths {DATA_PATH} and {VIDEO_PATH}, got {info.data_path} and {info.video_path}"
        )
    return info


class _LeRobotSource:
    """A data set on disk: its cameras, and its episodes as grasps."""

    def __init__(self, src: Path, touch: str, photo: str) -> None:
        self._av, self._arrow = import_extra("av", _WHAT), import_extra("pyarrow", _WHAT)
        self.src, self._info = src, _read_info(src / "meta" / "info.json")
        features = self._info.features.items()
        kinds = {name: feature.dtype for name, feature in features if feature.dtype in ("video", "image")}
        self._kinds = kinds
        self.touch = (
            [name.strip() for name in touch.split(",")]
            if touch
            else sorted(name for name in kinds if _GEL.search(_words(name)))
        )
        others = (name for name in kinds if name not in self.touch and not self._info.features[name].is_depth)
        self.photo = photo or next(others, "")
        if not self.touch or any(name not in kinds for name in (*self.touch, self.photo)):
            raise ImporterError(
                f"{src} must have a camera for the photo and gel cameras; choose them with --option photo=... "
                f"touch=... from: {', '.join(kinds) or 'none'}"
            )
        if any("/" in name or ".." in name for name in kinds):
            raise ImporterError(f"{src} must have no camera name that is a path")
        self._moments = self._info.recording.get("moments")
        self._videos: dict[str, tuple[Path, Any]] = {}

    def stored_facts(self) -> dict[str, Any]:
        """Return source, licence, terms, citation, rig and sensor from info.json, as far as it contains them."""
        facts = self._info.recording or {"rig": self._info.robot_type}
        keys = ("source", "licence", "terms", "citation", "rig", "sensor")
        texts = {key: facts[key] for key in keys if isinstance(facts.get(key), str)}
        return {"sensor": ", ".join(self.touch)} | ({"terms": ""} if "licence" in texts else {}) | texts

    def episodes(self, columns: Sequence[str]) -> Iterator[_Row]:
        """Yield the rows of meta/episodes, with those of the columns that exist."""
        paths = sorted((self.src / "meta" / "episodes").glob("*/*.parquet"))
        if not paths:
            raise ImporterError(f"{self.src} must contain meta/episodes/chunk-000/file-000.parquet")
        for path in paths:
            with self._readable(path):
                file = import_extra("pyarrow.parquet", _WHAT).ParquetFile(path)
                known = [name for name in columns if name in file.schema_arrow.names]
                for batch in file.iter_batches(256, columns=known):
                    yield from batch.to_pylist()

    def items(self) -> Iterator[Item | Skip]:
        """Yield one grasp for each episode."""
        keys = (self.photo, *self.touch)
        columns = [f"videos/{key}/{field}" for key in keys for field in ("chunk_index", "file_index", "from_timestamp")]
        ids = ("grasp_id", "object_id", "sequence_id", *_FIELDS)
        for row in self.episodes(
            ("episode_index", "tasks", "length", "data/chunk_index", "data/file_index", *ids, *columns)
        ):
            number = row.get("episode_index")
            name = safe_name(str(row.get("grasp_id") or f"episode-{number}"))
            if not isinstance(row.get("length"), int):
                yield Skip("its row in meta/episodes has no length", name)
                continue
            fields = {key: row[key] for key in _FIELDS if row.get(key) is not None}
            sequence = row.get("sequence_id") or f"episode-{number}"
            moments = self._moments if row["length"] == len(self._moments or ()) else None
            left_out: dict[str, int] = {}
            images = episode_images(
                partial(self._steps, row), len(self.touch), moments, partial(left_out.__setitem__, name)
            )
            tasks = row.get("tasks")
            object_id = row.get("object_id") or (next(iter(tasks), None) if isinstance(tasks, list) else tasks)
            yield Item(name, str(object_id or "unknown"), images, {"sequence_id": str(sequence), **fields}, left_out)

    def _steps(self, row: _Row) -> Iterator[Step]:
        read = {"image": self._image_frames, "video": self._video_frames}
        cameras = [read[self._kinds[key]](key, row) for key in (self.photo, *self.touch)]
        for pictures in zip(*cameras, strict=False):
            yield pictures[0], pictures[1:]

    def _video_frames(self, key: str, row: _Row) -> Iterator[Picture]:
        path = self.src / f"videos/{key}/{_file_of(row, f'videos/{key}')}.mp4"
        start = row.get(f"videos/{key}/from_timestamp")
        if not isinstance(start, float) or not path.is_file():
            raise ImporterError("its video is missing")
        end = start + (row["length"] - 0.5) / self._info.fps
        try:
            video = self._open_video(key, path)
            stream = video.streams.video[0]
            video.seek(int(start / stream.time_base), stream=stream)
            for frame in video.decode(stream):
                if frame.time is not None and frame.time >= start - 0.5 / self._info.fps:
                    if frame.time >= end:
                        return
                    yield frame.to_ndarray(format="rgb24")
        except (self._av.error.FFmpegError, OSError, ValueError, IndexError, OverflowError) as error:
            self._videos.pop(key, None)
            raise ImporterError("its video cannot be decoded") from error

    def _open_video(self, key: str, path: Path) -> Any:
        """Open the video of one camera. It contains many episodes and stays open until another file is needed.

        If it were opened for each episode, its buffers would fragment the heap by several kB per episode.
        """
        if self._videos.get(key, (None, None))[0] != path:
            self._videos[key] = (path, self._av.open(str(path)))
        return self._videos[key][1]

    def _image_frames(self, key: str, row: _Row) -> Iterator[Picture]:
        """Yield the pictures that the rows of steps contain as PNG or JPEG."""
        path = self.src / f"data/{_file_of(row, 'data')}.parquet"
        dataset = import_extra("pyarrow.dataset", _WHAT)
        with self._readable(path):
            is_of_episode = dataset.field("episode_index") == row["episode_index"]
            for batch in dataset.dataset(path).to_batches(
                columns=[key], filter=is_of_episode, batch_size=16, batch_readahead=1
            ):
                for cell in batch.column(0).to_pylist():
                    data = cell.get("bytes") if isinstance(cell, dict) else None
                    image = decode_picture(data) if data else None
                    if image is None:
                        raise ImporterError("a picture of its episode cannot be decoded")
                    yield image

    @contextmanager
    def _readable(self, path: Path) -> Iterator[None]:
        """Convert pyarrow's errors for a damaged file to ImporterError."""
        try:
            yield
        except (self._arrow.ArrowException, OSError, ValueError, KeyError) as error:
            raise ImporterError(f"{path} cannot be read: {str(error)[:200]!r}") from error


def _words(name: str) -> str:
    """Return the name of a camera with its words apart: wristTouch becomes wrist_Touch."""
    return re.sub("(?<=[a-z])(?=[A-Z])", "_", name)


def _file_of(row: _Row, kind: str) -> str:
    """Return the chunk and file of an episode's data or video."""
    numbers = {key: row.get(f"{kind}/{key}") for key in ("chunk_index", "file_index")}
    if not all(isinstance(number, int) and number >= 0 for number in numbers.values()):
        raise ImporterError(f"its episode does not name the file of its {kind.split('/')[0]}")
    return _FILE.format(**numbers)
