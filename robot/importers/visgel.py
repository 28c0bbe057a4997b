"""VisGel: a robot with a GelSight touches 195 objects in front of a camera.

    data_seen/.../touch/<n>/<rec>/frame0000.jpg     frame 0 is without contact
    data_seen/.../vision/<n>/<rec>/frame0000.jpg    the same number is the same moment
    data_unseen/...                                 objects that the authors held out for testing

The folders between data_seen and touch vary between copies, and are searched. The data set does not name the touched
objects, so each recording of a touch is treated as an object. This is a surrogate: two recordings may show one object,
and pairs of them are then wrongly treated as different objects. The touch is the frame that differs most from frame 0,
among 16 evenly spread ones; the photo is the camera frame of the same moment. The folder `<n>` is the sequence. The
split `unseen` trains on data_seen and tests on data_unseen.
"""

import re
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from robot.errors import ImporterError
from robot.importers.importing import (
    NOT_STATED,
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
    licence=NOT_STATED,
    terms="the authors' repository states none",
    citation="Li, Zhu, Tedrake, Torralba, Connecting Touch and Vision via Cross-Modal Prediction, CVPR 2019",
    sensor="GelSight",
    rig="KUKA iiwa arm; webcam",
    background="at the start of each touch",
    expects="`data_seen/` or `data_unseen/` with `touch/<n>/<rec>/frame0000.jpg` and the same names in `vision/`",
    caveats=(
        "The data set does not name the touched objects: object_id is one recording of one touch, and two of them may "
        "show one object. This makes pair accuracy and recall too low.",
        "Photos show arm and scene, and the place can identify the touch. Print the control that sees only the "
        "margin of the photo.",
    ),
    unverified=(
        "the folders between data_seen and touch",
        "that `<n>` is one session",
    ),
)
_FRAME = re.compile(r"frame(\d+)\.jpe?g")
_FRAMES_COMPARED = 16
_DEPTH = 4
"""Levels of folders below data_seen that are searched for touch/."""


def import_visgel(src: Path, out: Path, progress: Progress | None = None) -> Recording:
    """Import one touch of each recording below `src`.

    Raises:
        ImporterError: There is no recording.
    """
    src = Path(src)
    objects = {part: [_name(part, path) for path in _recordings(src / f"data_{part}")] for part in ("seen", "unseen")}
    if not any(objects.values()):
        raise DATA_SET.mismatch_error(src, "it contains no recording of a touch")
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
    """Yield the folders touch/<n>/<rec> below `root`."""
    if not root.is_dir():
        return
    for folder in subfolders(root):
        if folder.name == "touch":
            for session in subfolders(folder):
                yield from subfolders(session)
        elif depth and folder.name != "vision":
            yield from _recordings(folder, depth - 1)


def _name(part: str, recording: Path) -> str:
    return safe_name(part, recording.parent.name, recording.name)


def _items(src: Path) -> Iterator[Item | Skip]:
    for part in ("seen", "unseen"):
        for recording in _recordings(src / f"data_{part}"):
            touch = _TouchRecording(recording)
            images = {
                "photo": touch.photo,
                "touch_a": touch.touch,
                "touch_a_before": touch.no_contact,
            }
            name = _name(part, recording)
            yield Item(name, name, images, {"sequence_id": safe_name(part, recording.parent.name)})


class _TouchRecording:
    """One recording of a touch, read on first use of its pictures."""

    def __init__(self, recording: Path) -> None:
        self._touch = recording
        self._vision = recording.parents[2] / "vision" / recording.parent.name / recording.name

    def touch(self) -> Path:
        """Return the gel image of strongest contact."""
        return self._touch / self._frame

    def photo(self) -> Path:
        """Return the camera frame of the same moment."""
        return self._vision / self._frame

    def no_contact(self) -> Path:
        """Return the first gel image."""
        return self._touch / self._names[0]

    @cached_property
    def _names(self) -> list[str]:
        names = [path.name for _, path in numbered_files(self._touch, _FRAME)]
        if len(names) < 2:
            raise ImporterError("it has fewer than two frames")
        return names

    @cached_property
    def _frame(self) -> str:
        """The name of the readable frame that differs most from the first."""
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
            raise ImporterError("none of its frames can be compared with its first frame")
        return names[differences.index(max(differences))]


def _small(path: Path) -> np.ndarray | None:
    """Return grey levels at an eighth of the size; None if the file is not a picture."""
    try:
        return decode_picture(read_content(path, ImporterError), cv2.IMREAD_REDUCED_GRAYSCALE_8)
    except ImporterError:
        return None


def _difference(frame: np.ndarray | None, first: np.ndarray | None) -> float:
    """Return the mean absolute difference in grey levels; -1 if a picture is missing or sizes differ."""
    if frame is None or first is None or frame.shape != first.shape:
        return -1.0
    return float(cv2.absdiff(frame, first).mean())
