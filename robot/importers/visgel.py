"""VisGel: a robot with a GelSight touches 195 objects, seen by a camera.

    data_seen/.../touch/<n>/<rec>/frame0000.jpg     frame 0 shows the untouched gel
    data_seen/.../vision/<n>/<rec>/frame0000.jpg    frames of the same number are of the same moment
    data_unseen/...                                 objects that the authors kept for judging

The folders between data_seen and touch differ from copy to copy, and are found. Nothing says which object is touched.
So one recording of a touch stands for an object, which it is not: two of them may be of one object, and pairs of them
are then wrongly held for different. Of each recording the frame is imported that differs most from frame 0, among 16
spread evenly over it, with the camera's frame of the same moment. The folder `<n>` is the sequence. The split
`unseen` trains on data_seen and tests on data_unseen.
"""

import re
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from robot.errors import ImporterError
from robot.importers.importing import (
    DataSet,
    DataSetMetadata,
    Item,
    Progress,
    Skip,
    import_items,
    numbered_files,
    safe_name,
    subfolders,
)
from robot.recording.folder import Recording
from robot.storage import decode_picture, read_content

DATA_SET = DataSet(
    source="VisGel",
    licence="not stated in the authors' repository",
    citation="Li, Zhu, Tedrake, Torralba, Connecting Touch and Vision via Cross-Modal Prediction, CVPR 2019",
    sensor="GelSight",
    rig="KUKA iiwa arm; webcam",
    background="at the start of each touch",
    expects="`data_seen/` or `data_unseen/`, and in them `touch/<n>/<rec>/frame0000.jpg` and `vision/`, which is alike",
    caveats=(
        "Nothing says which object is touched: object_id names one recording of one touch, and two of them may be of "
        "one object. Pair accuracy and guesses are too low by that.",
        "The camera sees arm and scene: who knows the place knows the touch. Print the control of the photo's "
        "background.",
    ),
    unverified=(
        "the folders between data_seen and touch",
        "that `<n>` is one sitting",
    ),
)
_FRAME = re.compile(r"frame(\d+)\.jpe?g")
_FRAMES_COMPARED = 16
_DEPTH = 4
"""Folders below data_seen in which touch/ is looked for."""


def import_visgel(src: Path, out: Path, progress: Progress | None = None) -> Recording:
    """Import a touch of each recording below `src`. Raises ImporterError where there is none."""
    src = Path(src)
    objects = {part: [_name(part, each) for each in _recordings(src / f"data_{part}")] for part in ("seen", "unseen")}
    if not any(objects.values()):
        raise DATA_SET.mismatch_error(src, "it holds no recording of a touch")
    splits = {"unseen": {"train": objects["seen"], "test": objects["unseen"]}} if all(objects.values()) else {}
    return import_items(
        DATA_SET,
        _items(src),
        out,
        total=sum(map(len, objects.values())),
        progress=progress,
        metadata=DataSetMetadata(splits=splits),
    )


def _recordings(root: Path, depth: int = _DEPTH) -> Iterator[Path]:
    """The folders touch/<n>/<rec> below `root`."""
    if not root.is_dir():
        return
    for folder in subfolders(root):
        if folder.name == "touch":
            for sitting in subfolders(folder):
                yield from subfolders(sitting)
        elif depth and folder.name != "vision":
            yield from _recordings(folder, depth - 1)


def _name(part: str, recording: Path) -> str:
    return safe_name(part, recording.parent.name, recording.name)


def _items(src: Path) -> Iterator[Item | Skip]:
    for part in ("seen", "unseen"):
        for recording in _recordings(src / f"data_{part}"):
            pressed = _TouchRecording(recording)
            images = {
                "photo": pressed.photo,
                "touch_a": pressed.touch,
                "touch_a_before": pressed.no_contact,
            }
            name = _name(part, recording)
            yield Item(name, name, images, {"sequence_id": safe_name(part, recording.parent.name)})


class _TouchRecording:
    """One recording of a touch, looked at when its pictures are asked for."""

    def __init__(self, recording: Path) -> None:
        self._touch = recording
        self._vision = recording.parents[2] / "vision" / recording.parent.name / recording.name

    def touch(self) -> Path:
        return self._touch / self._frame

    def photo(self) -> Path:
        return self._vision / self._frame

    def no_contact(self) -> Path:
        return self._touch / self._names[0]

    @cached_property
    def _names(self) -> list[str]:
        names = [path.name for _, path in numbered_files(self._touch, _FRAME)]
        if len(names) < 2:
            raise ImporterError("it has no two frames")
        return names

    @cached_property
    def _frame(self) -> str:
        """The frame that differs most from the first; an unreadable one does not count."""
        first = _small(self._touch / self._names[0])
        spread = (
            np.linspace(1, len(self._names) - 1, min(_FRAMES_COMPARED, len(self._names) - 1))
            .round()
            .astype(int)
            .tolist()
        )
        names: list[str] = [self._names[index] for index in spread]
        differences = [_difference(_small(self._touch / name), first) for name in names]
        if max(differences) < 0:
            raise ImporterError("no frame of it can be compared with its first")
        return names[differences.index(max(differences))]


def _small(path: Path) -> np.ndarray | None:
    """Grey levels at an eighth of the size; None for what is no picture."""
    try:
        return decode_picture(read_content(path, ImporterError), cv2.IMREAD_REDUCED_GRAYSCALE_8)
    except ImporterError:
        return None


def _difference(frame: np.ndarray | None, first: np.ndarray | None) -> float:
    """Mean absolute difference in grey levels; -1 where there is none."""
    if frame is None or first is None or frame.shape != first.shape:
        return -1.0
    return float(cv2.absdiff(frame, first).mean())
