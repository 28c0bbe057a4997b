"""What exporters share: a folder that is whole or absent, the order of grasps, and their pictures as steps in time.

A grasp is an episode: its moments (before, during, after the touch, as far as every grasp has them) are its steps, each
with the photo taken before it. Only the grasp at hand is in memory.
"""

import contextlib
import fcntl
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.files import sync
from robot.errors import ImporterError, RecordingError
from robot.importers.importing import Progress, picture_bytes
from robot.recording.folder import RecordedGrasp, Recording
from robot.storage import PART_SUFFIX, decode_picture, storage_errors

Picture = NDArray[np.uint8]
"""(H, W, 3), red first."""
Parts = Mapping[str, Sequence[str]]
"""Of a split: train, validation, test -> object ids."""

MOMENT_SUFFIXES = {"before": "_before", "during": "", "after": "_after"}
"""Steps of an episode, and what their columns end in."""
_MARK = ".touch-retrieval-export"


class Exporter(Protocol):
    """Writes a recording to the new folder `out`; with a split, the grasps of its parts as the format tells them
    apart.
    """

    def __call__(
        self, recording: Recording, out: Path, *, parts: Parts | None = None, progress: Progress | None = None
    ) -> "RecordingExport":
        """Raises RecordingError for what the format cannot hold or a picture that is broken, StorageError."""


@dataclass(frozen=True)
class RecordingExport:
    """What was written: `notes` are remarks for the user."""

    folder: Path
    grasps: int
    notes: tuple[str, ...] = ()


# The folder ------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def atomic_folder(out: Path) -> Iterator[Path]:
    """A new folder to write in, which becomes `out` when the block ends well; else nothing stands at `out`.

    What an export that died left beside `out` is written anew. Raises RecordingError where `out` holds anything,
    StorageError.
    """
    out = Path(os.path.abspath(out))
    part = out.with_name(out.name + PART_SUFFIX)
    with storage_errors(out):
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise RecordingError(f"{out} must be a new or an empty folder, and holds something; name another one")
        if part.exists() and not (part / _MARK).is_file():
            raise RecordingError(f"{part} is in the way and no export made it; move it away, or name another folder")
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
    """Grasps by part of the split (all of them train where there is none), and remarks. Raises RecordingError for a
    split that shares objects, or one without a grasp.
    """
    if parts is None:
        return {"train": list(recording.grasps)}, []
    part_of: dict[str, str] = {}
    for part, objects in parts.items():
        for object_id in objects:
            if part_of.setdefault(object_id, part) != part:
                raise RecordingError(f"the split has {object_id} in two parts; every object must stand in one")
    found: dict[str, list[RecordedGrasp]] = {part: [] for part in parts}
    for grasp in recording.grasps:
        if grasp.object_id in part_of:
            found[part_of[grasp.object_id]].append(grasp)
    kept = {part: grasps for part, grasps in found.items() if grasps}
    if not kept:
        raise RecordingError("the split names no object of the recording")
    left_out = len(recording.grasps) - sum(map(len, kept.values()))
    return kept, [f"left out {left_out} grasp(s) of objects that the split does not name"] if left_out else []


def plain_fields(grasp: RecordedGrasp) -> dict[str, object]:
    """What its line says beside its images: grasp_id, object_id, and what was recorded."""
    return {key: value for key, value in grasp.to_row().items() if not key.endswith("_file_name")}


# Steps -----------------------------------------------------------------------------------------------------


class EpisodeSteps:
    """The pictures of grasps as steps in time: all of one size for each camera, which is that of the first grasp."""

    def __init__(self, recording: Recording, grasps: Sequence[RecordedGrasp]) -> None:
        """Raises RecordingError where there is no grasp, or grasps differ in their fingers."""
        if not grasps:
            raise RecordingError(f"{recording.folder} must hold grasps, and holds none")
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
            f"frames {moment} the touch are left out: not every grasp has them"
            for moment in MOMENT_SUFFIXES
            if moment not in self.moments and any(map(self._has(moment), grasps))
        ]
        first = self._read(grasps[0])
        self.sizes = {name: pictures[0].shape[:2] for name, pictures in first.items()}
        """(height, width) of `photo`, `touch_a`, ..."""
        self._resized: dict[str, int] = {}

    def _has(self, moment: str) -> Callable[[RecordedGrasp], bool]:
        return lambda grasp: (
            grasp.images().keys() >= {f"touch_{finger}{MOMENT_SUFFIXES[moment]}" for finger in self.fingers}
        )

    def pictures_of(self, grasp: RecordedGrasp) -> dict[str, list[Picture]]:
        """Pictures of each camera (photo, touch_a, ...), one a step. Raises RecordingError for one that is broken."""
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
        """What was left out and what was resized so far."""
        sizes = {name: f"{width} x {height}" for name, (height, width) in self.sizes.items()}
        resized = [
            f"{name}: {count} grasp(s) had another size, and were fitted into {sizes[name]} before black"
            for name, count in self._resized.items()
        ]
        return [*self.notes, *resized]


def read_picture(path: Path) -> Picture:
    """A whole PNG or JPEG file as pixels. Raises RecordingError."""
    try:
        image = decode_picture(picture_bytes("picture", path))
    except ImporterError:
        image = None
    if image is None:
        raise RecordingError(f"{path} is missing, damaged or cut off; run `retrieve check`, and take its line out")
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)


def letterbox(picture: Picture, size: tuple[int, int]) -> Picture:
    """The picture as large as it fits into (height, width), in the middle, before black."""
    scale = min(size[0] / picture.shape[0], size[1] / picture.shape[1])
    height, width = (max(round(scale * side), 1) for side in picture.shape[:2])
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    whole = np.zeros((*size, 3), np.uint8)
    top, left = (size[0] - height) // 2, (size[1] - width) // 2
    whole[top : top + height, left : left + width] = small
    return whole
