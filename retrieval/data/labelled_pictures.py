"""Pictures with what is known of the objects they show, as `retrieve collect --photos-only` and `--touches-only` make
them, and pairs of them; the format stands in robot.sim.pictures.

Photographed objects and pressed objects come from worlds of their own, and no object is both; but what two labelled
objects of one shape and relief, of like pitch, amplitude, aspect and sharpness, feel and look like, teaches a matcher
what goes with what. One pressed object and one photographed object cost a third and a tenth of a felt one.
"""

import hashlib
import json
import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from _touch_retrieval.files import read_json, read_regular
from retrieval.data.dataset import Grasp
from retrieval.errors import DatasetError

KINDS = ("photo", "touch")
FAMILIES = ("relief", "shape")
SIZES = ("pitch_mm", "amplitude_mm", "aspect", "sharpness")
MIN_AMPLITUDE_MM = 0.05
"""An amplitude below this is as none."""
SIZE_WEIGHTS = (2.0, 1.0, 1.0, 0.5)
"""Of the squared differences in `LabelledPicture.size_targets`, each in standard deviations; a pitch is felt and
seen best."""
SHAPE_MISMATCH_DISTANCE = 3.0
"""How far apart two objects of different shapes are, in the same unit."""


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
    def size_targets(self) -> tuple[float, ...]:
        """`sizes` as they are learnt and compared: what is a ratio of scales by its logarithm."""
        pitch, amplitude, aspect, sharpness = self.sizes
        return math.log(pitch), math.log(max(amplitude, MIN_AMPLITUDE_MM)), math.log(aspect), sharpness


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
    same folder read again, wherever it lies. Pictures themselves are not read.
    """
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


# Pairs ---------------------------------------------------------------------------------------------------------------


def pair_by_label(photos: Path, touches: Path, fingers: int) -> list[Grasp]:
    """Grasps made of labelled pictures: each press with the photo of the object most like the pressed one, each photo
    with the press of the object most like the photographed one.

    photos, touches: folders that `retrieve collect --photos-only` and `--touches-only` wrote. fingers: gel
    images of one touch; where it is 1, each finger's press is a touch of its own. Like is of the same relief and
    nearest in sizes, another shape being as far as SHAPE_MISMATCH_DISTANCE; where no object has the relief, a picture is left out.
    The photographed object names the grasp's object, `like <object_id>`, so that two presses with one photo are of one
    object. Raises DatasetError for folders of the wrong kind or where nothing pairs.
    """
    photographed, pressed = _of_kind(photos, "photo"), _of_kind(touches, "touch")
    of_object: dict[str, list[LabelledPicture]] = defaultdict(list)
    for picture in sorted(pressed, key=lambda each: each.finger or ""):
        of_object[picture.object_id].append(picture)
    touched = [[one] for one in pressed] if fingers == 1 else of_object.values()
    whole = [part for part in touched if len(part) == fingers]
    if not whole:
        raise DatasetError(f"no object in {touches} was pressed by {fingers} fingers, as the recording's were grasped")
    grasps = [_grasp(whole[row], photographed[match]) for row, match in _pairs([one[0] for one in whole], photographed)]
    if not grasps:
        raise DatasetError(f"no object in {touches} has the relief of one in {photos}; collect more")
    return grasps


def _of_kind(folder: Path, kind: str) -> list[LabelledPicture]:
    found, pictures = load_labelled(folder)
    if found != kind:
        raise DatasetError(f"{folder} must hold labelled pictures of kind {kind}; it holds those of kind {found}")
    return pictures


def _pairs(pressed: list[LabelledPicture], photographed: list[LabelledPicture]) -> list[tuple[int, int]]:
    """(row of the press, row of the photo), in order."""
    rows_of: dict[str, tuple[list[int], list[int]]] = defaultdict(lambda: ([], []))
    for side, pictures in enumerate((pressed, photographed)):
        for row, picture in enumerate(pictures):
            rows_of[picture.relief][side].append(row)
    shapes = [np.array([each.shape for each in pictures]) for pictures in (pressed, photographed)]
    felt, seen = _scaled(pressed, photographed), _scaled(photographed, photographed)
    pairs: set[tuple[int, int]] = set()
    for presses, photos in rows_of.values():
        if presses and photos:
            other = shapes[0][presses][:, None] != shapes[1][photos]
            apart = np.hypot(cdist(felt[presses], seen[photos]), SHAPE_MISMATCH_DISTANCE * other)
            pairs |= {(press, photos[match]) for press, match in zip(presses, apart.argmin(1), strict=True)}
            pairs |= {(presses[match], photo) for photo, match in zip(photos, apart.argmin(0), strict=True)}
    return sorted(pairs)


def _scaled(pictures: list[LabelledPicture], over: list[LabelledPicture]) -> NDArray[np.float64]:
    """(N, sizes) in weighted standard deviations over `over`; all alike for smooth objects, which have none."""
    deviation = np.array([each.size_targets for each in over]).std(0) + 1e-6
    sizes = np.array([each.size_targets for each in pictures]) / deviation * np.sqrt(SIZE_WEIGHTS)
    sizes[[each.is_smooth for each in pictures]] = 0.0
    return np.asarray(sizes)


def _grasp(fingers: list[LabelledPicture], photo: LabelledPicture) -> Grasp:
    return Grasp(
        grasp_id=f"{fingers[0].file.name} like {photo.object_id}",
        object_id=f"like {photo.object_id}",
        sequence_id=None,
        photo=photo.file,
        touches=tuple(each.file for each in fingers),
        backgrounds=tuple(each.before for each in fingers if each.before),
    )
