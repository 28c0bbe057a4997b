"""Open-X-Tactile: robot tasks with touch as zarr stores in the layout of FTP-1.

    <task>.zarr.zip, or <task>.zarr/ unpacked, zarr version 2
        meta/episode_ends                       (E,) end of each episode
        data/camera_main_rgb                    (T, H, W, 3) uint8; the option `camera` names another
        data/<side>_tactile_data_<group>        (T, areas, H, W, 3) uint8; an area is a finger
        data/<side>_tactile_{sensor,type}_<group>    name of the sensor; image, state or binary

An episode becomes one grasp and one sequence: its first step provides the no-contact frame and the photo, and the step
whose gel images differ most from the first is the touch. Published stores do not name objects, so a task is treated as
one object. Stores are read one step at a time, without groups and without pickle.
"""

import itertools
import json
import math
import re
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot.errors import ImporterError
from robot.importers.episodes import Step, episode_images
from robot.importers.importing import NOT_STATED, DataSet, Item, Progress, import_extra, import_items
from robot.recording.folder import Recording, safe_name

DATA_SET = DataSet(
    source="Open-X-Tactile",
    licence=NOT_STATED,
    terms="see each store's own page",
    citation="see each store's own page",
    sensor="see the stores",
    rig="see the stores",
    expects="`<task>.zarr.zip` or `<task>.zarr/` with `meta/episode_ends` and `data/<side>_tactile_data_<group>`",
    fingers=0,
    background="the first step of each episode",
    caveats=(
        "A task counts as one object: compare tasks, or set the objects yourself.",
        "The touch of an episode is its step that differs most from the first; a change of light can cause this too.",
    ),
    unverified=(
        "that the first step of an episode is without contact",
        "the strings in the arrays for sensor and type",
        "the rest of the layout, which was taken from notes and not from a store",
    ),
)
_TACTILE = re.compile(r"data/\w+?_tactile_data_\w+")
_CODECS = ("blosc", "bz2", "gzip", "lz4", "lzma", "zlib", "zstd")
"""Accepted codecs. A filter, or another codec, such as pickle, could run code."""
_MAX_CHUNK_BYTES = 512 * 2**20
"""Maximum bytes of a chunk, which is read into memory as a whole."""


def import_open_x_tactile(
    src: Path, out: Path, progress: Progress | None = None, *, camera: str = "camera_main_rgb"
) -> Recording:
    """Import a store, or the stores in a folder, with the photos of `camera`.

    Raises:
        ImporterError: zarr is missing, or a store does not have this layout.
    """
    paths = sorted(
        path
        for path in (src, *(src.glob("*") if src.is_dir() else ()))
        if path.name.endswith(".zarr" if path.is_dir() else ".zarr.zip")
    )
    if not paths:
        raise DATA_SET.mismatch_error(src, "there is no such file or folder; unpack .tar files first")
    import_extra("zarr", "Open-X-Tactile")
    tasks = [_Task(path, camera) for path in paths]
    fingers = {task.fingers for task in tasks}
    if len(fingers) > 1:
        raise ImporterError(
            f"the stores of one recording must have the same number of fingers, got {sorted(fingers)}; import them "
            "one by one"
        )
    sensors = ", ".join(sorted({sensor for task in tasks for sensor in task.sensors})) or "unknown"
    items = (item for task in tasks for item in task.items())
    total = sum(len(task.ends) for task in tasks)
    return import_items(
        replace(DATA_SET, sensor=sensors, fingers=fingers.pop()),
        items,
        out,
        total=total,
        progress=progress,
        source=src,
        options={"camera": camera},
    )


class _Task:
    """One store: its episodes, camera and fingers."""

    def __init__(self, path: Path, camera: str) -> None:
        store = _Store(path)
        self.name = safe_name(path.name.removesuffix(".zip").removesuffix(".zarr"))
        tactile = [
            name
            for name in store.names
            if _TACTILE.fullmatch(name) and store.texts(name.replace("_data_", "_type_")) in ([], ["image"])
        ]
        if f"data/{camera}" not in store.names:
            cameras = sorted(name.removeprefix("data/") for name in store.names if name.endswith("_rgb"))
            raise ImporterError(
                f"{path} has no data/{camera}; set --option camera= to one of: {', '.join(cameras) or 'none'}"
            )
        if not tactile or "meta/episode_ends" not in store.names:
            raise ImporterError(f"{path} must contain meta/episode_ends and data/<side>_tactile_data_<group>")
        self._camera = _Steps(store, f"data/{camera}", 4)
        self._gels = [_Steps(store, name, 5) for name in tactile]
        self.sensors = [text for name in tactile for text in store.texts(name.replace("_data_", "_sensor_"))]
        self.ends = [int(end) for end in store.values("meta/episode_ends").ravel()]
        steps = min(array.shape[0] for array in (self._camera, *self._gels))
        if not self.ends or not all(np.diff([0, *self.ends]) > 0) or self.ends[-1] > steps:
            raise ImporterError(f"{path}: meta/episode_ends must increase up to at most {steps}, the number of steps")
        self.fingers = sum(array.shape[1] for array in self._gels)

    def items(self) -> Iterator[Item]:
        """Yield one grasp for each episode."""
        for episode, (start, end) in enumerate(itertools.pairwise([0, *self.ends])):
            name = safe_name(self.name, f"{episode:06d}")
            left_out: dict[str, int] = {}
            steps = partial(self._steps, start, end)
            images = episode_images(steps, self.fingers, left_out=partial(left_out.__setitem__, name))
            yield Item(name, self.name, images, {"sequence_id": name}, left_out)

    def _steps(self, start: int, end: int) -> Iterator[Step]:
        for step in range(start, end):
            yield self._camera[step], [area for array in self._gels for area in array[step]]


class _Store:
    """A zarr store, version 2: a folder, or a .zip file of it; `names` are the paths of its arrays, sorted."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            root: Any = zipfile.Path(path) if path.is_file() else path
        except (OSError, zipfile.BadZipFile) as error:
            raise ImporterError(f"{path} cannot be read as a zip file: {error}") from error
        inside = list(root.iterdir())
        self._top = f"{inside[0].name}/" if path.is_file() and len(inside) == 1 else ""  # the folder of the store
        self.root = root / self._top if self._top else root
        arrays = [array for group in self.root.iterdir() if group.is_dir() for array in group.iterdir()]
        self.names = sorted(f"{each.parent.name}/{each.name}" for each in arrays if (each / ".zarray").is_file())

    def texts(self, name: str) -> list[str]:
        """Return the distinct texts of a small array, in order; none if the array is missing."""
        texts = self.values(name).ravel().tolist() if name in self.names else []
        return list(dict.fromkeys(text.decode(errors="replace") if isinstance(text, bytes) else text for text in texts))

    def values(self, name: str) -> NDArray[Any]:
        """Return all values of a small array."""
        array, _ = self.open(name)
        if array.dtype.kind not in "iuUS" or array.size * array.dtype.itemsize > _MAX_CHUNK_BYTES:
            raise ImporterError(f"{self.path.name}/{name} has type {array.dtype} and {array.size} values, not readable")
        return _read(array, ..., f"{self.path.name}/{name}")

    def open(self, name: str) -> tuple[Any, str]:
        """Return an array and the separator in the names of its chunks. Its codecs are checked before zarr opens it."""
        label = f"{self.path.name}/{name}"
        zarr = import_extra("zarr", "Open-X-Tactile")
        try:
            metadata = json.loads((self.root / name / ".zarray").read_bytes())
            codec = metadata.get("compressor")
            is_known = (codec is None or codec["id"] in _CODECS) and not metadata.get("filters")
            if metadata.get("zarr_format") != 2 or not is_known:
                raise ImporterError(f"it must be zarr version 2 without filters, with a codec of {', '.join(_CODECS)}")
            store = zarr.storage.ZipStore(self.path, mode="r") if self.path.is_file() else str(self.path)
            array = zarr.open_array(store, path=self._top + name, mode="r", zarr_format=2)
            if not 0 < math.prod(array.chunks) * array.dtype.itemsize <= _MAX_CHUNK_BYTES:
                raise ImporterError(f"it has chunks of {array.chunks}: too large, or empty")
        except Exception as error:  # zarr, numcodecs and zipfile raise many types for damaged stores
            raise ImporterError(f"{label} cannot be opened: {error}") from error
        return array, metadata.get("dimension_separator", ".")


class _Steps:
    """A uint8 array along time, read step by step."""

    def __init__(self, store: _Store, name: str, ndim: int) -> None:
        self._store, self._label = store, f"{store.path.name}/{name}"
        self._array, separator = store.open(name)
        self.shape: tuple[int, ...] = self._array.shape
        if self._array.dtype != np.uint8 or len(self.shape) != ndim:
            raise ImporterError(
                f"{self._label} must have type uint8 and {ndim} axes, got {self._array.dtype}, {len(self.shape)} axes"
            )
        self._chunk = f"{name}/{separator.join(['{}', *['0'] * (ndim - 1)])}"

    def __getitem__(self, step: int) -> NDArray[np.uint8]:
        """Return the pictures of a step; raise ImporterError for a missing chunk, which zarr would read as zeros."""
        if not (self._store.root / self._chunk.format(step // self._array.chunks[0])).is_file():
            raise ImporterError(f"a chunk of {self._label} is missing")
        return _read(self._array, step, self._label)


def _read(array: Any, index: Any, label: str) -> NDArray[Any]:
    """Return values of a zarr array; raise ImporterError if they cannot be decoded."""
    try:
        return np.asarray(array[index])
    except Exception as error:
        raise ImporterError(f"{label} cannot be decoded: {type(error).__name__}") from error
