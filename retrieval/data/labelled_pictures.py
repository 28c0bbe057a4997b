"""Labelled pictures of photo-only and touch-only objects, and pairs of them.

`retrieve collect --photos-only` and `--touches-only` write these pictures; robot.sim.pictures defines the format.

Photo-only and touch-only objects come from separate object sets, so no object has both. Two objects with the same shape
and relief, and similar pitch, amplitude, aspect and sharpness, still teach a matcher which touch fits which photo. A
touch-only object costs a third, and a photo-only object a tenth, of the time of a grasped one.
"""

import hashlib
import json
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from _touch_retrieval.files import read_json, read_regular
from retrieval.data.dataset import Grasp, recorded_objects
from retrieval.errors import DatasetError

KINDS = ("photo", "touch")
FAMILIES = ("relief", "shape")
SIZES = ("pitch_mm", "amplitude_mm", "aspect", "sharpness")
MIN_AMPLITUDE_MM = 0.05
"""Smaller amplitudes are raised to this one."""
SIZE_WEIGHTS = (2.0, 1.0, 1.0, 0.5)
"""Weights of the squared differences in `LabelledPicture.size_targets`, each in standard deviations. The pitch is most
visible in photos and gel images."""
SHAPE_MISMATCH_DISTANCE = 3.0
"""Distance that different shapes add, as the root of the sum of squares, in the same unit."""


@dataclass(frozen=True)
class ObjectLabels:
    """The properties of a simulated object that both its touches and its photos show.

    Attributes:
        families: Its relief and shape families, in the order of `FAMILIES`.
        sizes: Sizes of its relief, in the order of `SIZES`; the amplitude of a smooth object is 0.
    """

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
        """Whether the object has no relief; its pitch, aspect and sharpness then have no meaning."""
        return self.sizes[SIZES.index("amplitude_mm")] == 0

    @property
    def size_targets(self) -> tuple[float, ...]:
        """`sizes` for regression and comparison: logarithms of all but the sharpness."""
        pitch, amplitude, aspect, sharpness = self.sizes
        return math.log(pitch), math.log(max(amplitude, MIN_AMPLITUDE_MM)), math.log(aspect), sharpness

    @classmethod
    def from_dict(cls, row: Mapping[str, Any]) -> "ObjectLabels":
        """Read the labels that the simulated rig writes. Raises ValueError if they are missing or impossible."""
        try:
            families, sizes = tuple(str(row[name]) for name in FAMILIES), tuple(float(row[name]) for name in SIZES)
        except (KeyError, TypeError) as error:
            raise ValueError(f"no labels: {error!r}") from error
        pitch, amplitude, aspect, sharpness = sizes
        if not (0 < pitch < math.inf and 0 <= amplitude < math.inf and 1 <= aspect < math.inf and 0 <= sharpness <= 1):
            raise ValueError(
                f"pitch and amplitude must be lengths in mm, aspect at least 1, sharpness within 0..1; got {sizes}"
            )
        return cls(families, sizes)


@dataclass(frozen=True)
class LabelledPicture:
    """A photo, or one finger's gel image with its no-contact frame, and the labels of its object.

    Attributes:
        file: File of the photo or gel image.
        finger: Finger of the gel image; None for a photo.
        before: File of the no-contact frame, if any.
        object_id: The object.
        labels: Its labels.
    """

    file: Path
    finger: str | None
    before: Path | None
    object_id: str
    labels: ObjectLabels


def load_object_labels(recording: Path) -> dict[str, ObjectLabels]:
    """Return the labels of the objects of a simulated recording, from its recording.json.

    Raises:
        DatasetError: The recording has no labels, or they are damaged.
    """
    try:
        return {name: ObjectLabels.from_dict(row) for name, row in recorded_objects(recording).items()}
    except (ValueError, AttributeError) as error:
        raise DatasetError(f"{recording}: recording.json must hold the labels of each object; {error}") from error


def load_labelled(folder: Path) -> tuple[str, list[LabelledPicture]]:
    """Return the kind of the pictures in `folder` ("photo" or "touch"), and the pictures.

    Raises:
        DatasetError: The folder contains no valid labelled pictures.
    """
    try:
        info = read_json(folder / "pictures.json")
        lines = read_regular(folder / "metadata.jsonl").decode().splitlines()
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{folder} must be a folder that `retrieve collect --photos-only` or `--touches-only` wrote: {error}"
        ) from error
    kind = info.get("kind") if isinstance(info, dict) else None
    if kind not in KINDS:
        raise DatasetError(f"{folder}/pictures.json: kind must be photo or touch, got {kind!r}")
    pictures = [_picture(folder, number, line) for number, line in enumerate(lines, start=1)]
    if not pictures:
        raise DatasetError(f"{folder} contains no picture yet; run the same `retrieve collect` again")
    return kind, pictures


def labels_digest(pictures: Iterable[LabelledPicture]) -> str:
    """Return the SHA-256 (hex) of the pictures' file names and labels, in this order.

    The digest does not depend on the folder's location. Picture files are not read.
    """
    digest = hashlib.sha256()
    for each in pictures:
        labels = each.labels.families, each.labels.sizes
        digest.update(json.dumps([each.file.name, each.finger, each.object_id, *labels]).encode())
    return digest.hexdigest()


def _picture(folder: Path, number: int, line: str) -> LabelledPicture:
    try:
        row: dict[str, Any] = json.loads(line)
        before = folder / row["before_file_name"] if "before_file_name" in row else None
        labels = ObjectLabels.from_dict(row)
        return LabelledPicture(folder / row["file_name"], row.get("finger"), before, str(row["object_id"]), labels)
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{folder}/metadata.jsonl, line {number}: not a labelled picture: {error}") from error


# Pairs ---------------------------------------------------------------------------------------------------------------


def pair_by_label(photos: Path, touches: Path, fingers: int) -> list[Grasp]:
    """Make grasps of labelled pictures: pair each touch with the photo of the most similar object, and vice versa.

    The most similar object has the same relief and the nearest sizes; another shape adds SHAPE_MISMATCH_DISTANCE. A
    picture is left out if no object on the other side has its relief. The photographed object names the grasp's
    object, `like <object_id>`, so that two touches with one photo have one object.

    Args:
        photos: Folder that `retrieve collect --photos-only` wrote.
        touches: Folder that `retrieve collect --touches-only` wrote.
        fingers: Number of gel images of one touch; with 1, each finger's image is a touch of its own.

    Returns:
        The grasps.

    Raises:
        DatasetError: A folder has the wrong kind, or no pair exists.
    """
    photographed, pressed = _of_kind(photos, "photo"), _of_kind(touches, "touch")
    by_object: dict[str, list[LabelledPicture]] = defaultdict(list)
    for picture in sorted(pressed, key=lambda each: each.finger or ""):
        by_object[picture.object_id].append(picture)
    groups = [[one] for one in pressed] if fingers == 1 else by_object.values()
    presses = [group for group in groups if len(group) == fingers]
    if not presses:
        raise DatasetError(f"no object in {touches} was pressed by {fingers} fingers, as in the recording's grasps")
    pairs = _pairs([press[0] for press in presses], photographed)
    grasps = [_grasp(presses[row], photographed[match]) for row, match in pairs]
    if not grasps:
        raise DatasetError(f"no object in {touches} has the relief of an object in {photos}; collect more")
    return grasps


def _of_kind(folder: Path, kind: str) -> list[LabelledPicture]:
    found, pictures = load_labelled(folder)
    if found != kind:
        raise DatasetError(f"{folder} must contain labelled pictures of kind {kind}; it contains kind {found}")
    return pictures


def _pairs(pressed: list[LabelledPicture], photographed: list[LabelledPicture]) -> list[tuple[int, int]]:
    """Return sorted pairs (row of the touch, row of the photo)."""
    rows_of: dict[str, tuple[list[int], list[int]]] = defaultdict(lambda: ([], []))
    for side, pictures in enumerate((pressed, photographed)):
        for row, picture in enumerate(pictures):
            rows_of[picture.labels.relief][side].append(row)
    shapes = [np.array([each.labels.shape for each in pictures]) for pictures in (pressed, photographed)]
    touch_sizes, photo_sizes = _scaled(pressed, photographed), _scaled(photographed, photographed)
    pairs: set[tuple[int, int]] = set()
    for presses, photos in rows_of.values():
        if presses and photos:
            other = shapes[0][presses][:, None] != shapes[1][photos]
            distances = np.hypot(cdist(touch_sizes[presses], photo_sizes[photos]), SHAPE_MISMATCH_DISTANCE * other)
            pairs |= {(press, photos[match]) for press, match in zip(presses, distances.argmin(1), strict=True)}
            pairs |= {(presses[match], photo) for photo, match in zip(photos, distances.argmin(0), strict=True)}
    return sorted(pairs)


def _scaled(pictures: list[LabelledPicture], over: list[LabelledPicture]) -> NDArray[np.float64]:
    """Return (N, sizes) in weighted standard deviations over `over`; zeros for smooth objects, which have no sizes."""
    deviation = np.array([each.labels.size_targets for each in over]).std(0) + 1e-6
    sizes = np.array([each.labels.size_targets for each in pictures]) / deviation * np.sqrt(SIZE_WEIGHTS)
    sizes[[each.labels.is_smooth for each in pictures]] = 0.0
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
