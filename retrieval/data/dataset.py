"""Grasps of a recording, the licence of its data, object-disjoint splits, and a cache of images."""

import hashlib
import json
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.documents import typed
from _touch_retrieval.files import file_digest
from retrieval.data.camera import (
    USUAL_CAMERA,
    PhotoCamera,
    assumed_camera,
    require_camera,
    stated_camera,
    stated_keys,
    unusual,
)
from retrieval.data.preprocessing import Preprocessing
from retrieval.errors import BadInput, DatasetError
from robot.errors import RobotError
from robot.recording.folder import INFO_FILE, Recording, read_info, read_recording

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Grasp:
    """One grasp, successful or not, and its files.

    Attributes:
        photo_file: The photo; None in a recording of touches only.
        touches: Gel images, one file per finger, in order a, b.
        backgrounds: No-contact frames of the same fingers, if recorded.
        opening_mm: Distance between the fingers, if recorded.
        session: Name of the sitting in which the grasp was recorded, if stated; it does not restrict splits.
        outcome: "held", "missed", "slipped", "no_plan"; "failed" for another failure; "unknown" if not recorded.
        accepted: Whether a matcher is trained on it.
        after: Frames after the lift, one file per finger in order, or empty.
        time_s: Time since the recording began.
    """

    grasp_id: str
    object_id: str
    sequence_id: str | None
    photo_file: Path | None
    touches: tuple[Path, ...]
    backgrounds: tuple[Path, ...]
    opening_mm: float | None = None
    session: str | None = None
    outcome: str = "unknown"
    accepted: bool = True
    after: tuple[Path, ...] = ()
    time_s: float | None = None

    @property
    def held(self) -> bool:
        """Whether the gripper lifted the object."""
        return self.outcome == "held"

    @property
    def photo(self) -> Path:
        """The photo. Raises DatasetError if the grasp has none, for everything that compares touches with photos."""
        if self.photo_file is None:
            raise DatasetError(
                f"grasp {self.grasp_id} has no photo, as in a recording of touches only; `retrieve train` fits a model "
                "to such touches, `build-index` and `enrol` accept them, and `evaluate --protocol touch-to-touch` "
                "tests them; everything else needs photos"
            )
        return self.photo_file

    @property
    def photos(self) -> tuple[Path, ...]:
        """The photo, or nothing."""
        return () if self.photo_file is None else (self.photo_file,)


AnyRecording = str | Path | Recording
"""A recording: its folder, or the result of `robot.read_recording`."""


def folder_of(recording: AnyRecording) -> Path:
    """Return the folder of a recording."""
    return recording.folder if isinstance(recording, Recording) else Path(recording)


def load_grasps(recording: AnyRecording) -> list[Grasp]:
    """Read the successful grasps of a recording, in the order of collection.

    Raises DatasetError if the recording cannot be read, has no such grasps, or mixes numbers of fingers.

    >>> [grasp.object_id for grasp in retrieval.load_grasps("recording")]
    ['mug', 'mug', 'tin', 'tin']
    """
    folder = folder_of(recording)
    return require_accepted(folder, load_all_grasps(folder))


def require_accepted(folder: Path, grasps: Iterable[Grasp]) -> list[Grasp]:
    """Return the accepted grasps of `load_all_grasps(folder)`. Raises DatasetError like `load_grasps`."""
    grasps = [grasp for grasp in grasps if grasp.accepted]
    if not grasps:
        raise DatasetError(f"{folder} contains no successful grasp")
    finger_count(grasps)
    return grasps


def load_all_grasps(folder: Path) -> list[Grasp]:
    """Read all grasps of a recording, in the order of collection. Raises DatasetError if it cannot be read."""
    try:
        recording = read_recording(folder)
    except RobotError as error:
        raise DatasetError(str(error)) from error
    for note in recording.notes:
        log.warning("%s", note)

    def in_finger_order(files: Mapping[str, str]) -> tuple[Path, ...]:
        return tuple(folder / files[finger] for finger in sorted(files))

    return [
        Grasp(
            grasp_id=line.grasp_id,
            object_id=line.object_id,
            sequence_id=line.sequence_id,
            photo_file=None if line.photo is None else folder / line.photo,
            touches=in_finger_order(line.touches),
            backgrounds=in_finger_order(line.touches_before),
            opening_mm=line.opening_mm,
            session=line.session,
            outcome=line.outcome or {None: "unknown", True: "held", False: "failed"}[line.grasped],
            accepted=line.grasped is not False,
            after=in_finger_order(line.touches_after),
            time_s=line.time_s,
        )
        for line in recording.grasps
    ]


def load_attempts(folder: Path) -> list[Grasp]:
    """Read the successful AND the failed grasps of a recording, in the order of collection.

    Grasps without `outcome` and `grasped`, and plans without a grasp, are left out. Raises DatasetError.
    """
    grasps = [grasp for grasp in load_all_grasps(folder) if grasp.outcome not in ("unknown", "no_plan")]
    if not grasps:
        raise DatasetError(f"no grasp in {folder} has a recorded result; grasped or outcome is required")
    finger_count(grasps)
    return grasps


NOT_STATED = "not stated"
LICENCES = "licences"
"""Key of a checkpoint's provenance: the fields of each DataLicence."""


@dataclass(frozen=True)
class DataLicence:
    """The licence of one source of training data.

    Attributes:
        source: The recording's source, or the file or folder.
        licence: Name of the licence, or `NOT_STATED`.
        terms: Conditions of use, or where to find them; empty if nothing is known.
    """

    source: str
    licence: str = NOT_STATED
    terms: str = ""

    def __str__(self) -> str:
        return f"{self.licence} ({self.terms})" if self.terms else self.licence


def stored_licences(provenance: Mapping[str, Any]) -> list[DataLicence]:
    """Return the licences in the provenance of a checkpoint; none if an older version made it.

    Raises:
        BadInput: The provenance is damaged.
    """
    return typed(provenance.get(LICENCES, []), list[DataLicence], LICENCES, error=BadInput)


def recording_source(folder: Path) -> str:
    """Return the source that a recording names in its recording.json."""
    return str(read_info(folder)["source"])


def recording_licence(folder: Path) -> DataLicence:
    """Return the licence that a recording names in its recording.json."""
    info = read_info(folder)
    return DataLicence(str(info["source"]), str(info.get("licence") or NOT_STATED), str(info.get("terms") or ""))


def object_kinds(folder: Path) -> dict[str, str]:
    """Return the class of each object whose class a recording names in its recording.json."""
    objects = read_info(folder).get("objects")
    return {
        name: str(about["class"])
        for name, about in (objects if isinstance(objects, dict) else {}).items()
        if isinstance(about, dict) and "class" in about
    }


def stated_by_recording(folder: Path) -> dict[str, float]:
    """Return what a recording.json states of the camera of all photos, by CAMERA_KEYS. Raises DatasetError."""
    info = read_info(folder)
    require_camera(info, f"{folder / INFO_FILE}")
    return {key: info[key] for key in stated_keys(info)}


def recording_camera(folder: Path, grasps: Sequence[Grasp], settings: Preprocessing) -> PhotoCamera:
    """Return the camera of a recording's photos: as its recording.json states it, or else as they suggest.

    Args:
        folder: The recording.
        grasps: Its grasps.
        settings: How the photos are prepared. If a model sees them as a whole, their camera does not matter.

    Raises:
        DatasetError: A stated value is impossible.
    """
    if not settings.finds_object:
        return USUAL_CAMERA
    stated = stated_by_recording(folder)
    assumed = assumed_camera((grasp.object_id, photo, stated) for grasp in grasps for photo in grasp.photos)
    for sentence in unusual(assumed):
        log.warning("%s. If that is wrong, state it in %s", sentence, folder / INFO_FILE)
    return stated_camera(stated, assumed)


def finger_count(grasps: Sequence[Grasp]) -> int:
    """Return the number of gel images of each touch. Raises DatasetError if it differs between grasps."""
    examples = {len(grasp.touches): grasp.grasp_id for grasp in reversed(grasps)}
    if len(examples) > 1:
        counts = ", ".join(f"{name} has {count}" for count, name in examples.items())
        raise DatasetError(
            f"every touch must have the same number of gel images; {counts}; use a separate recording for each sensor"
        )
    return next(iter(examples))


def data_digest(grasps: Iterable[Grasp]) -> str:
    """Return the SHA-256 (hex) of ids and image bytes; training on recordings with equal digests is equal."""
    digest = hashlib.sha256()
    for grasp in grasps:
        ids = [grasp.grasp_id, grasp.object_id, grasp.sequence_id]
        digest.update(json.dumps(ids if grasp.session is None else [*ids, grasp.session]).encode())
        for path in (*grasp.photos, *grasp.touches, *grasp.backgrounds):
            try:
                digest.update(bytes.fromhex(file_digest(path)))
            except OSError as error:
                raise DatasetError(f"{path} cannot be read ({error.strerror}); run `retrieve check`") from error
    return digest.hexdigest()


@dataclass(frozen=True)
class Split:
    """Objects for training, for validation (model selection and calibration), and for the final test only."""

    seed: int
    train: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return a plain dictionary, as stored in checkpoints and split files."""
        return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, data: Any) -> "Split":
        """Return the split of a dictionary made by `to_dict`. Raises DatasetError for anything else."""
        return typed(
            {"seed": 0} | data if isinstance(data, dict) else data, cls, "split", complete=True, error=DatasetError
        )

    def select(self, grasps: Iterable[Grasp], part: str) -> list[Grasp]:
        """Return the grasps whose object is in `part` ("train", "validation" or "test")."""
        objects = set(getattr(self, part))
        return [grasp for grasp in grasps if grasp.object_id in objects]


def make_split(grasps: Sequence[Grasp], *, validation: float, test: float, seed: int) -> Split:
    """Draw an object-disjoint split; objects that share a sequence stay together.

    `validation` and `test` are fractions of the objects. Whole groups approximate them; each requested part gets at
    least two objects, as pairs require. Raises DatasetError if the recording has too few objects.

    >>> len(retrieval.make_split(retrieval.load_grasps("lab"), validation=0.2, test=0.25, seed=0).train)
    7
    """
    groups = linked_objects(grasps)
    queue = [groups[index] for index in np.random.default_rng(seed).permutation(len(groups))]
    total = sum(len(group) for group in groups)
    wanted = {"test": test, "validation": validation}
    chosen = {name: _take(queue, fraction * total) if fraction > 0 else () for name, fraction in wanted.items()}
    train = tuple(sorted(name for group in queue for name in group))
    parts = [train, *(chosen[name] for name, fraction in wanted.items() if fraction > 0)]
    if min(map(len, parts)) < 2:
        raise DatasetError(
            f"a split into {len(parts)} parts needs two objects in each, and objects that share a sequence stay "
            f"together; the recording has {total} objects in {len(groups)} such groups: record more objects, or give "
            "your own split"
        )
    return Split(seed=seed, train=train, **chosen)


def _take(queue: list[list[str]], target: float) -> tuple[str, ...]:
    """Take groups off the queue that bring the count closer to `target`; then the smallest, up to two objects."""
    taken: list[str] = []
    for group in list(queue):
        if abs(len(taken) + len(group) - target) < abs(len(taken) - target):
            taken = taken + group
            queue.remove(group)
    for group in sorted(queue, key=len):
        if len(taken) < 2:
            taken = taken + group
            queue.remove(group)
    return tuple(sorted(taken))


def linked_objects(grasps: Iterable[Grasp]) -> list[list[str]]:
    """Return groups of objects that share sequences, which a split must not separate; groups and members sorted."""
    group_of: dict[str, set[str]] = {}
    first_of_sequence: dict[str, str] = {}
    for grasp in grasps:
        group = group_of.setdefault(grasp.object_id, {grasp.object_id})
        if grasp.sequence_id is None:
            continue
        other = group_of[first_of_sequence.setdefault(grasp.sequence_id, grasp.object_id)]
        if other is not group:
            group |= other
            group_of.update(dict.fromkeys(group, group))
    return sorted({id(group): sorted(group) for group in group_of.values()}.values())


class ImageCache:
    """Thread-safe cache of images that fit in `limit_bytes`; other images are loaded again each time."""

    def __init__(self, load: Callable[..., NDArray[Any]], limit_bytes: int = 4 << 30) -> None:
        self._load, self._limit = load, limit_bytes
        self._images: dict[tuple[Path | None, ...], NDArray[Any]] = {}
        self._used = 0

    def __call__(self, *paths: Path | None) -> NDArray[Any]:
        """Return the image that `load(*paths)` returns."""
        if (image := self._images.get(paths)) is None:
            image = self._load(*paths)
            if self._used + image.nbytes <= self._limit:
                self._images[paths] = image
                self._used += image.nbytes
        return image
