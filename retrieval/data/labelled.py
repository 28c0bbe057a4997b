"""Pictures with what is known of the objects they show, as `retrieve collect --photos-only` and `--touches-only` make
them; the format stands in robot.sim.pictures."""

import hashlib
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _touch_retrieval.files import read_json, read_regular
from retrieval.errors import DatasetError

KINDS = ("photo", "touch")
FAMILIES = ("relief", "shape")
SIZES = ("pitch_mm", "amplitude_mm", "aspect", "sharpness")
LEAST_MM = 0.05
"""An amplitude below this is as none."""


@dataclass(frozen=True)
class LabelledPicture:
    """A photo, or one finger's gel image with the untouched gel, and what the object that it shows or feels is.

    finger: whose gel image it is; None for a photo. families: its kind of `FAMILIES`, in their order. sizes: of its
    relief, `SIZES` in their order; the amplitude of a smooth object is 0.
    """

    file: Path
    finger: str | None
    before: Path | None
    object_id: str
    families: tuple[str, ...]
    sizes: tuple[float, ...]

    @property
    def relief(self) -> str:
        """The family of its relief."""
        return self.families[FAMILIES.index("relief")]

    @property
    def shape(self) -> str:
        """The family of its body."""
        return self.families[FAMILIES.index("shape")]

    @property
    def is_smooth(self) -> bool:
        """Whether it wears no relief; its pitch, aspect and sharpness then mean nothing."""
        return self.sizes[SIZES.index("amplitude_mm")] == 0

    @property
    def learnt_sizes(self) -> tuple[float, ...]:
        """`sizes` as they are learnt and compared: what is a ratio of scales by its logarithm."""
        pitch, amplitude, aspect, sharpness = self.sizes
        return math.log(pitch), math.log(max(amplitude, LEAST_MM)), math.log(aspect), sharpness


def load_labelled(folder: Path) -> tuple[str, list[LabelledPicture]]:
    """The kind of the pictures in `folder`, and the pictures. Raises DatasetError."""
    try:
        info = read_json(folder / "pictures.json")
        lines = read_regular(folder / "metadata.jsonl").decode().splitlines()
    except (OSError, ValueError) as error:
        raise DatasetError(f"{folder} must be a folder that `retrieve collect --photos-only` wrote: {error}") from error
    kind = info.get("kind") if isinstance(info, dict) else None
    if kind not in KINDS:
        raise DatasetError(f"{folder}/pictures.json must say kind photo or touch; got {kind!r}")
    pictures = [_picture(folder, number, line) for number, line in enumerate(lines, start=1)]
    if not pictures:
        raise DatasetError(f"{folder} holds no picture yet; run the same `retrieve collect` again")
    return kind, pictures


def labels_digest(pictures: Iterable[LabelledPicture]) -> str:
    """SHA-256 over the names of the pictures' files and over what is known of the objects, in this order: equal for the
    same folder read again, wherever it lies. Pictures themselves are not read."""
    digest = hashlib.sha256()
    for each in pictures:
        digest.update(json.dumps([each.file.name, each.finger, each.object_id, each.families, each.sizes]).encode())
    return digest.hexdigest()


def _picture(folder: Path, number: int, line: str) -> LabelledPicture:
    try:
        row: dict[str, Any] = json.loads(line)
        sizes = tuple(float(row[name]) for name in SIZES)
        before = folder / row["before_file_name"] if "before_file_name" in row else None
        families = tuple(str(row[name]) for name in FAMILIES)
        found = LabelledPicture(
            folder / row["file_name"], row.get("finger"), before, str(row["object_id"]), families, sizes
        )
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{folder}/metadata.jsonl, line {number}, is no labelled picture: {error!r}") from error
    pitch, amplitude, aspect, sharpness = sizes
    if not (0 < pitch < math.inf and 0 <= amplitude < math.inf and 1 <= aspect < math.inf and 0 <= sharpness <= 1):
        raise DatasetError(
            f"{folder}/metadata.jsonl, line {number}: pitch and amplitude must be lengths in mm, aspect from 1, "
            f"sharpness within 0..1; got {sizes}"
        )
    return found
