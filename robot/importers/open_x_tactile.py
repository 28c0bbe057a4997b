"""Open-X-Tactile: robot tasks with touch as zarr stores, as FTP-1 reads them; and our own exports to that format.

    <task>.zarr.zip, or <task>.zarr/ unpacked, zarr of version 2
        meta/episode_ends                       (E,) where each episode ends
        data/camera_main_rgb                    (T, H, W, 3) uint8; the option `camera` names another
        data/<side>_tactile_data_<group>        (T, areas, H, W, 3) uint8; an area is a finger
        data/<side>_tactile_{sensor,type}_<group>    the sensor's name; image, state or binary

An episode gives one grasp: its first step is the untouched gel and the photo, the step whose gel images differ most
from it is the touch. No store names objects, so a task counts as one, unless `meta/object_id` is there, as in what
`retrieve export-recording` writes, whose fields are taken back. An episode is a sequence.
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
    licence="as each store's own page says",
    citation="see each store's own page",
    sensor="as the stores say",
    rig="as the stores say",
    expects="`<task>.zarr.zip` or `<task>.zarr/` with `meta/episode_ends` and `data/<side>_tactile_data_<group>`",
    fingers=0,
    background="the first step of each episode",
    caveats=(
        "A task counts as one object unless its store names objects: compare tasks, or give the objects yourself.",
        "The touch of an episode is its step that differs most from the first, which a change of light may be too.",
    ),
    unverified=(
        "that the first step of an episode is without contact",
        "what strings stand in the arrays for sensor and type",
        "everything else about the layout, which was read in notes and not on a store",
    ),
)
_TACTILE = re.compile(r"data/(?P<side>\w+?)_tactile_data_(?P<group>\w+)")
_NAMES = ("object_id", "grasp_id", "sequence_id")
_FIELDS = ("force_n", "opening_mm", "touch_skew_s", "time_s", "outcome", "grasped", "pose")


def import_open_x_tactile(
    src: Path, out: Path, progress: Progress | None = None, *, camera: str = "camera_main_rgb"
) -> Recording:
    """Import the stores below `src`. Raises ImporterError without zarr, and where no store is one."""
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
    """The facts, and what the stores say of themselves instead."""
    sensors = sorted({sensor for task in tasks for sensor in task.sensors()})
    said = tasks[0].store.attributes().get("recording") if len(tasks) == 1 else None
    known = said if isinstance(said, dict) else {}
    texts = {key: known[key] for key in ("source", "licence", "citation", "rig") if isinstance(known.get(key), str)}
    return replace(DATA_SET, sensor=", ".join(sensors) or "unknown", **texts)


class _TaskStore:
    """One store: its episodes, cameras and fingers."""

    def __init__(self, store: ZarrStore, camera: str) -> None:
        self.store = store
        self._tactile = [name for name in store.names() if self._is_image(name)]
        if f"data/{camera}" not in store.names():
            there = sorted(name.removeprefix("data/") for name in store.names() if name.endswith("_rgb"))
            raise ImporterError(f"{store.path} has no data/{camera}; --option camera= one of {', '.join(there) or '-'}")
        if not self._tactile or "meta/episode_ends" not in store.names():
            raise ImporterError(f"{store.path} must hold meta/episode_ends and data/<side>_tactile_data_<group>")
        self._camera = store.array(f"data/{camera}", ndim=4, kind="u1")
        self._gels = [store.array(name, ndim=5, kind="u1") for name in self._tactile]
        length = min(array.shape[0] for array in (self._camera, *self._gels))
        self.ends = [int(end) for end in store.array("meta/episode_ends", ndim=1, kind="iu").all()]
        rising = all(start < end for start, end in zip([0, *self.ends], self.ends, strict=False))
        if not self.ends or not rising or self.ends[-1] > length:
            raise ImporterError(f"{store.path}: meta/episode_ends must rise to at most {length}, the number of steps")
        self.fingers = sum(array.shape[1] for array in self._gels)
        if not 1 <= self.fingers <= 26:
            raise ImporterError(f"{store.path}: a touch must have 1 to 26 areas, got {self.fingers}")
        self._moments = self._read_moments()
        self._lines = {key: self._line(key) for key in (*_NAMES, *_FIELDS)}

    def _is_image(self, name: str) -> bool:
        found = _TACTILE.fullmatch(name)
        kind = self.store.texts(name.replace("_tactile_data_", "_tactile_type_")) if found else []
        return bool(found) and kind in ([], ["image"])

    def _read_moments(self) -> list[str] | None:
        moments = self.store.texts("meta/moment")
        lengths = {end - start for start, end in zip([0, *self.ends], self.ends, strict=False)}
        known = lengths == {len(moments)} and len(set(moments)) == len(moments) and set(moments) <= set(MOMENT_SUFFIXES)
        return moments if known and "during" in moments else None

    def _line(self, key: str) -> Any:
        """An array of meta along episodes, bytes as text; None where there is none. Raises ImporterError."""
        if f"meta/{key}" not in self.store.names():
            return None
        kind = "US" if key == "outcome" else "USiuf" if key in _NAMES else "iufb"
        values = self.store.array(f"meta/{key}", ndim=2 if key == "pose" else 1, kind=kind).all()
        if len(values) != len(self.ends):
            return None
        return np.char.decode(values, "utf-8", "replace") if values.dtype.kind == "S" else values

    def sensors(self) -> list[str]:
        """Names of the sensors, as its arrays say."""
        return [text for name in self._tactile for text in self.store.texts(name.replace("_data_", "_sensor_"))]

    def object_id(self, episode: int) -> str:
        """What the store says, or its task."""
        return self._text("object_id", episode) or self.store.name

    def _text(self, key: str, episode: int) -> str:
        return "" if self._lines[key] is None else str(self._lines[key][episode])

    def splits(self) -> dict[str, dict[str, list[str]]]:
        """The split that stands in its attributes as ranges of episodes, where it parts objects."""
        said = self.store.attributes().get("splits")
        if not isinstance(said, dict) or len(said) < 2:
            return {}
        try:
            ranges = {str(part): range(*map(int, those)) for part, those in said.items()}
        except (TypeError, ValueError):
            return {}
        known = set(range(len(self.ends)))
        return {
            "exported": {
                part: sorted({self.object_id(episode) for episode in those if episode in known})
                for part, those in ranges.items()
                if len(those) <= len(known)
            }
        }

    def items(self, alone: bool) -> Iterator[Item | Skip]:
        """A grasp of each episode. alone: whether names need not say of which store they are."""
        for episode, (start, end) in enumerate(zip([0, *self.ends], self.ends, strict=False)):
            named = self._text("grasp_id", episode)
            grasp_id = safe_name(named) if named and alone else safe_name(self.store.name, named or f"{episode:06d}")
            sequence = self._text("sequence_id", episode) or f"{self.store.name}-{episode:06d}"
            fields = {key: value for key in _FIELDS if (value := self._field(key, episode)) is not None}
            pictures = Episode(partial(self._steps, start, end), self.fingers, self._moments)
            yield Item(grasp_id, self.object_id(episode), pictures.images(), {"sequence_id": sequence, **fields})

    def _field(self, key: str, episode: int) -> Any:
        if self._lines[key] is None:
            return None
        value = self._lines[key][episode]
        if key == "outcome":
            return str(value) or None
        if key == "grasped":
            return bool(value) if value in (0, 1) else None
        numbers = [float(each) for each in np.atleast_1d(value) if np.isfinite(each)]
        if not numbers:
            return None
        return numbers if key == "pose" else numbers[0]

    def _steps(self, start: int, end: int) -> Iterator[Step]:
        for at in range(start, end):
            yield self._camera.step(at), [area for array in self._gels for area in array.step(at)]


def _items(tasks: list[_TaskStore]) -> Iterator[Item | Skip]:
    for task in tasks:
        yield from task.items(alone=len(tasks) == 1)
