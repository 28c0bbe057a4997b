"""Open-X-Tactile: robot tasks with touch as zarr stores in the layout of FTP-1; and our own exports to that format.

    <task>.zarr.zip, or <task>.zarr/ unpacked, zarr version 2
        meta/episode_ends                       (E,) end of each episode
        data/camera_main_rgb                    (T, H, W, 3) uint8; the option `camera` names another
        data/<side>_tactile_data_<group>        (T, areas, H, W, 3) uint8; an area is a finger
        data/<side>_tactile_{sensor,type}_<group>    name of the sensor; image, state or binary

An episode becomes one grasp and one sequence: its first step provides the no-contact frame and the photo, and the step
whose gel images differ most from the first is the touch. Published stores do not name objects, so a task is treated as
one object. The exports of `retrieve export-recording` have `meta/object_id` and further fields, which are imported.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from robot.errors import ImporterError
from robot.importers.episodes import MOMENT_SUFFIXES, Episode, Step
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    DataSetMetadata,
    Item,
    Progress,
    Skip,
    import_extra,
    import_items,
    safe_name,
)
from robot.importers.zarr_store import ZarrStore
from robot.recording.folder import Recording

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
        "A task counts as one object unless its store names objects: compare tasks, or set the objects yourself.",
        "The touch of an episode is its step that differs most from the first; a change of light can cause this too.",
    ),
    unverified=(
        "that the first step of an episode is without contact",
        "the strings in the arrays for sensor and type",
        "the rest of the layout, which was taken from notes and not from a store",
    ),
)
_TACTILE = re.compile(r"data/(?P<side>\w+?)_tactile_data_(?P<group>\w+)")
_NAMES = ("object_id", "grasp_id", "sequence_id")
_FIELDS = ("force_n", "opening_mm", "touch_skew_s", "time_s", "outcome", "grasped", "pose")


def import_open_x_tactile(
    src: Path, out: Path, progress: Progress | None = None, *, camera: str = "camera_main_rgb"
) -> Recording:
    """Import the stores below `src`.

    Args:
        src: A store, or a folder with stores.
        out: Recording folder to write or continue.
        progress: Called with (done, total) after each grasp.
        camera: Camera of the photo.

    Raises:
        ImporterError: zarr is missing, or a store does not have this layout.
    """
    src = Path(src)
    paths = sorted(
        path
        for path in (src, *(src.glob("*") if src.is_dir() else ()))
        if path.name.endswith(".zarr" if path.is_dir() else ".zarr.zip")
    )
    if not paths:
        packed = sorted(src.glob("*.tar*")) if src.is_dir() else []
        lacking = f"unpack {packed[0].name} first" if packed else "there is no such file or folder"
        raise DATA_SET.mismatch_error(src, lacking)
    import_extra("zarr", "Open-X-Tactile")
    tasks = [_TaskStore(ZarrStore(path), camera) for path in paths]
    facts = _store_facts(tasks)
    fingers = {task.fingers for task in tasks}
    if len(fingers) > 1:
        raise ImporterError(
            f"the stores of one recording must have the same number of fingers, got {sorted(fingers)}; import them "
            "one by one"
        )
    splits = tasks[0].splits() if len(tasks) == 1 else {}
    return import_items(
        replace(facts, fingers=fingers.pop()),
        _items(tasks),
        out,
        total=sum(len(task.ends) for task in tasks),
        progress=progress,
        metadata=DataSetMetadata({}, splits),
    )


def _store_facts(tasks: list["_TaskStore"]) -> DataSet:
    """Return the facts of the data set, replaced by those in the stores."""
    sensors = sorted({sensor for task in tasks for sensor in task.sensors()})
    recording = tasks[0].store.attributes().get("recording") if len(tasks) == 1 else None
    facts = recording if isinstance(recording, dict) else {}
    keys = ("source", "licence", "terms", "citation", "rig")
    texts = {key: facts[key] for key in keys if isinstance(facts.get(key), str)}
    own_terms = {"terms": ""} if "licence" in texts else {}
    return replace(DATA_SET, sensor=", ".join(sensors) or "unknown", **(own_terms | texts))


class _TaskStore:
    """One store: its episodes, cameras and fingers."""

    def __init__(self, store: ZarrStore, camera: str) -> None:
        self.store = store
        self._tactile = [name for name in store.names() if self._is_image(name)]
        if f"data/{camera}" not in store.names():
            cameras = sorted(name.removeprefix("data/") for name in store.names() if name.endswith("_rgb"))
            raise ImporterError(
                f"{store.path} has no data/{camera}; set --option camera= to one of: {', '.join(cameras) or 'none'}"
            )
        if not self._tactile or "meta/episode_ends" not in store.names():
            raise ImporterError(f"{store.path} must contain meta/episode_ends and data/<side>_tactile_data_<group>")
        self._camera = store.array(f"data/{camera}", ndim=4, kind="u1")
        self._gels = [store.array(name, ndim=5, kind="u1") for name in self._tactile]
        length = min(array.shape[0] for array in (self._camera, *self._gels))
        self.ends = [int(end) for end in store.array("meta/episode_ends", ndim=1, kind="iu").all()]
        is_increasing = all(start < end for start, end in zip([0, *self.ends], self.ends, strict=False))
        if not self.ends or not is_increasing or self.ends[-1] > length:
            raise ImporterError(
                f"{store.path}: meta/episode_ends must increase up to at most {length}, the number of steps"
            )
        self.fingers = sum(array.shape[1] for array in self._gels)
        if not 1 <= self.fingers <= 26:
            raise ImporterError(f"{store.path}: a touch must have 1 to 26 areas, got {self.fingers}")
        self._moments = self._read_moments()
        self._values = {key: self._read_values(key) for key in (*_NAMES, *_FIELDS)}

    def _is_image(self, name: str) -> bool:
        found = _TACTILE.fullmatch(name)
        kind = self.store.texts(name.replace("_tactile_data_", "_tactile_type_")) if found else []
        return bool(found) and kind in ([], ["image"])

    def _read_moments(self) -> list[str] | None:
        moments = self.store.texts("meta/moment")
        lengths = {end - start for start, end in zip([0, *self.ends], self.ends, strict=False)}
        valid = lengths == {len(moments)} and len(set(moments)) == len(moments) and set(moments) <= set(MOMENT_SUFFIXES)
        return moments if valid and "during" in moments else None

    def _read_values(self, key: str) -> Any:
        """Return an array of meta with one entry per episode, bytes as text; None if it is missing."""
        if f"meta/{key}" not in self.store.names():
            return None
        kind = "US" if key == "outcome" else "USiuf" if key in _NAMES else "iufb"
        values = self.store.array(f"meta/{key}", ndim=2 if key == "pose" else 1, kind=kind).all()
        if len(values) != len(self.ends):
            return None
        return np.char.decode(values, "utf-8", "replace") if values.dtype.kind == "S" else values

    def sensors(self) -> list[str]:
        """Return the names of the sensors in its arrays."""
        return [text for name in self._tactile for text in self.store.texts(name.replace("_data_", "_sensor_"))]

    def object_id(self, episode: int) -> str:
        """Return the object of an episode; the task if the store does not name objects."""
        return self._text("object_id", episode) or self.store.name

    def _text(self, key: str, episode: int) -> str:
        return "" if self._values[key] is None else str(self._values[key][episode])

    def splits(self) -> dict[str, dict[str, list[str]]]:
        """Return the split that its attributes define by ranges of episodes."""
        published = self.store.attributes().get("splits")
        if not isinstance(published, dict) or len(published) < 2:
            return {}
        try:
            ranges = {str(part): range(*map(int, bounds)) for part, bounds in published.items()}
        except (TypeError, ValueError):
            return {}
        valid = set(range(len(self.ends)))
        return {
            "exported": {
                part: sorted({self.object_id(episode) for episode in episodes if episode in valid})
                for part, episodes in ranges.items()
                if len(episodes) <= len(valid)
            }
        }

    def items(self, is_only_store: bool) -> Iterator[Item | Skip]:
        """Yield one grasp for each episode.

        Args:
            is_only_store: Whether there is no other store, so that stored grasp ids need no prefix.
        """
        for episode, (start, end) in enumerate(zip([0, *self.ends], self.ends, strict=False)):
            stored_id = self._text("grasp_id", episode)
            if stored_id and is_only_store:
                grasp_id = safe_name(stored_id)
            else:
                grasp_id = safe_name(self.store.name, stored_id or f"{episode:06d}")
            sequence = self._text("sequence_id", episode) or f"{self.store.name}-{episode:06d}"
            fields = {key: value for key in _FIELDS if (value := self._field(key, episode)) is not None}
            pictures = Episode(partial(self._steps, start, end), self.fingers, self._moments)
            yield Item(grasp_id, self.object_id(episode), pictures.images(), {"sequence_id": sequence, **fields})

    def _field(self, key: str, episode: int) -> Any:
        if self._values[key] is None:
            return None
        value = self._values[key][episode]
        if key == "outcome":
            return str(value) or None
        if key == "grasped":
            return bool(value) if value in (0, 1) else None
        numbers = [float(number) for number in np.atleast_1d(value) if np.isfinite(number)]
        if not numbers:
            return None
        return numbers if key == "pose" else numbers[0]

    def _steps(self, start: int, end: int) -> Iterator[Step]:
        for step in range(start, end):
            yield self._camera.step(step), [area for array in self._gels for area in array.step(step)]


def _items(tasks: list[_TaskStore]) -> Iterator[Item | Skip]:
    for task in tasks:
        yield from task.items(is_only_store=len(tasks) == 1)
