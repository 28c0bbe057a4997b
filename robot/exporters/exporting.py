"""The common part of all exporters: an atomic output folder, the order of grasps, and their pictures as steps.

A grasp is an episode. Its steps are the moments before, during and after the touch that every grasp has; each step has
the photo from before the grasp. Only the current grasp is in memory.
"""

import contextlib
import fcntl
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.files import sync
from robot.errors import ImporterError, RecordingError
from robot.importers.importing import Progress, picture_bytes
from robot.recording.folder import RecordedGrasp, Recording
from robot.storage import PART_SUFFIX, decode_picture, storage_errors

Picture = NDArray[np.uint8]
"""(H, W, 3) uint8, RGB."""
Parts = Mapping[str, Sequence[str]]
"""A split: train, validation, test -> object ids."""

MOMENT_SUFFIXES = {"before": "_before", "during": "", "after": "_after"}
"""Suffix of the columns of each step of an episode."""
_FACTS = ("source", "sensor", "rig", "licence", "terms", "citation", "background")
"""Keys of recording.json that a store repeats."""
_MARK = ".touch-retrieval-export"


class Exporter(Protocol):
    """A function that writes a recording to the new folder `out`, and with a split its parts separately."""

    def __call__(
        self, recording: Recording, out: Path, *, parts: Parts | None = None, progress: Progress | None = None
    ) -> "RecordingExport":
        """Export a recording.

        Args:
            recording: The recording.
            out: New or empty folder.
            parts: Split of the objects; None for all in the training part.
            progress: Called with (done, total) after each grasp.

        Raises:
            RecordingError: The format cannot represent the recording, or a picture is damaged.
            StorageError: The folder cannot be written.
        """


@dataclass(frozen=True)
class RecordingExport:
    """Result of an export.

    Attributes:
        folder: The written folder.
        grasps: Number of written grasps.
        notes: Remarks for the user.
    """

    folder: Path
    grasps: int
    notes: tuple[str, ...] = ()


# The folder ------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def atomic_folder(out: Path) -> Iterator[Path]:
    """Create a temporary folder that becomes `out` if the block succeeds; otherwise `out` does not exist.

    The remains of an interrupted export next to `out` are overwritten.

    Args:
        out: New or empty folder.

    Raises:
        RecordingError: `out` is not empty, or another file has the name of the temporary folder.
        StorageError: The folder cannot be written.
    """
    out = Path(os.path.abspath(out))
    part = out.with_name(out.name + PART_SUFFIX)
    with storage_errors(out):
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise RecordingError(f"{out} must be a new or an empty folder; choose another one")
        if part.exists() and not (part / _MARK).is_file():
            raise RecordingError(f"{part} already exists and is not from an export; move it, or choose another folder")
        part.mkdir(parents=True, exist_ok=True)
        with open(part / _MARK, "ab") as mark:
            fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
            for path in part.iterdir():
                if path.name != _MARK:
                    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
            yield part
            for path in (*part.rglob("*"), part):
                sync(path)
            (part / _MARK).unlink()
            if out.exists():
                out.rmdir()
            os.rename(part, out)
            sync(out.parent)


# Grasps ----------------------------------------------------------------------------------------------------


def grasps_by_part(recording: Recording, parts: Parts | None) -> tuple[dict[str, list[RecordedGrasp]], list[str]]:
    """Return the grasps by part of the split, and remarks.

    Args:
        recording: The recording.
        parts: The split; None for all grasps in `train`.

    Raises:
        RecordingError: Parts have an object in common, or no part has a grasp.
    """
    if parts is None:
        return {"train": list(recording.grasps)}, []
    part_of: dict[str, str] = {}
    for part, objects in parts.items():
        for object_id in objects:
            if part_of.setdefault(object_id, part) != part:
                raise RecordingError(f"the split has {object_id} in two parts; each object must be in one part")
    found: dict[str, list[RecordedGrasp]] = {part: [] for part in parts}
    for grasp in recording.grasps:
        if grasp.object_id in part_of:
            found[part_of[grasp.object_id]].append(grasp)
    exported = {part: grasps for part, grasps in found.items() if grasps}
    if not exported:
        raise RecordingError("the split contains no object of the recording")
    left_out = len(recording.grasps) - sum(map(len, exported.values()))
    return exported, [f"left out {left_out} grasp(s) of objects that are not in the split"] if left_out else []


def recording_facts(recording: Recording) -> dict[str, Any]:
    """Return the facts of recording.json that a store repeats; None for one that is missing."""
    return {key: recording.info.get(key) for key in _FACTS}


def plain_fields(grasp: RecordedGrasp) -> dict[str, object]:
    """Return the fields of a grasp except its images: grasp_id, object_id, and recorded values."""
    return {key: value for key, value in grasp.to_row().items() if not key.endswith("_file_name")}


# Steps -----------------------------------------------------------------------------------------------------


class EpisodeSteps:
    """The pictures of grasps as steps in time. Each camera has one size, that of the first grasp.

    Attributes:
        fingers: Letters of the fingers.
        moments: Moments that every grasp has.
        notes: Remarks on moments that are left out.
        sizes: (height, width) of `photo`, `touch_a`, ...
    """

    def __init__(self, recording: Recording, grasps: Sequence[RecordedGrasp]) -> None:
        """Read the first grasp.

        Args:
            recording: The recording.
            grasps: Grasps to export.

        Raises:
            RecordingError: There is no grasp, or grasps differ in their fingers.
        """
        if not grasps:
            raise RecordingError(f"{recording.folder} must contain grasps, but contains none")
        self._folder = recording.folder
        self.fingers = sorted(grasps[0].touches)
        for grasp in grasps:
            if sorted(grasp.touches) != self.fingers:
                raise RecordingError(
                    f"every grasp must have the same fingers; {grasps[0].grasp_id} has {', '.join(self.fingers)}, "
                    f"{grasp.grasp_id} has {', '.join(sorted(grasp.touches))}"
                )
        self.moments = [moment for moment in MOMENT_SUFFIXES if all(map(self._has(moment), grasps))]
        self.notes = [
            f"the frames {moment} the touch are left out because some grasps do not have them"
            for moment in MOMENT_SUFFIXES
            if moment not in self.moments and any(map(self._has(moment), grasps))
        ]
        first = self._read(grasps[0])
        self.sizes = {name: pictures[0].shape[:2] for name, pictures in first.items()}
        self._resized: dict[str, int] = {}

    def _has(self, moment: str) -> Callable[[RecordedGrasp], bool]:
        return lambda grasp: (
            grasp.images().keys() >= {f"touch_{finger}{MOMENT_SUFFIXES[moment]}" for finger in self.fingers}
        )

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
        photo = read_picture(self._folder / files["photo"])
        touches = {
            f"touch_{finger}": [
                read_picture(self._folder / files[f"touch_{finger}{MOMENT_SUFFIXES[moment]}"])
                for moment in self.moments
            ]
            for finger in self.fingers
        }
        return {"photo": [photo] * len(self.moments), **touches}

    def remarks(self) -> list[str]:
        """Return remarks on moments that were left out and on pictures that were resized so far."""
        sizes = {name: f"{width} x {height}" for name, (height, width) in self.sizes.items()}
        resized = [
            f"{name}: {count} grasp(s) had another size and were resized to {sizes[name]} with black borders"
            for name, count in self._resized.items()
        ]
        return [*self.notes, *resized]


def read_picture(path: Path) -> Picture:
    """Return the pixels of a complete PNG or JPEG file: (H, W, 3) uint8, RGB.

    Raises:
        RecordingError: The file is missing, damaged or cut off.
    """
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
