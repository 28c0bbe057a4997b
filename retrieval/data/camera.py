"""The camera of photos: as stated, or else as they suggest: its field by the size of all objects, and its roll.

One photo does not tell its scale, and a small network is often wrong about the roll of one photo. But the photos of a
catalogue or recording mostly come from one camera, and objects that a gripper holds have a usual size: if all of them
together appear half as large as usual, the photos probably show twice as much.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from retrieval.data.images import decode, read_bytes
from retrieval.data.object_finder import INPUT_PX, find_object
from retrieval.data.upright import RollEstimator, probable_roll
from retrieval.data.views import FIELD_MM
from retrieval.errors import DatasetError, ImageError

USUAL_SIZE = 0.32
"""Median root of the visible area of objects, relative to the shorter side, in photos of the field `FIELD_MM`."""
FEWEST, SAMPLE = 20, 64
"""Least and largest number of objects from whose photos a camera is estimated."""
_STEPS, _LEAST_STEPS = 4, 2
"""Steps in which the field doubles: it stays the same when the catalogue grows. A difference of one is ignored."""


class PhotoCamera(NamedTuple):
    """The camera of a photo.

    Attributes:
        field_mm: What the photo shows along its shorter side, at the object's distance, in millimetres.
        roll_deg: Angle in degrees by which the picture is turned anticlockwise.
    """

    field_mm: float = FIELD_MM
    roll_deg: float = 0.0


USUAL_CAMERA = PhotoCamera()
_STATED = {
    "field_mm": ("the millimetres that the photo shows along its shorter side", 10.0, 10_000.0),
    "roll_deg": ("the degrees by which the photo is turned anticlockwise", -180.0, 180.0),
}
CAMERA_KEYS = frozenset(_STATED)
"""Keys that state a camera in the metadata of a catalogue, or in the recording.json of a recording."""


def require_camera(metadata: Mapping[str, Any], where: str) -> None:
    """Raise DatasetError if a stated value of a camera is impossible; `where` names the file, and the photo."""
    for key, (what, low, high) in _STATED.items():
        if (value := metadata.get(key)) is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise DatasetError(f"{where}: {key} must be {what}, from {low:g} to {high:g}; got {value!r:.40}")


def stated_keys(metadata: Mapping[str, Any]) -> set[str]:
    """Return those of CAMERA_KEYS that metadata state; null states nothing."""
    return {key for key in CAMERA_KEYS if metadata.get(key) is not None}


def stated_camera(metadata: Mapping[str, Any], assumed: PhotoCamera) -> PhotoCamera:
    """Return the camera that metadata state, as assumed where they do not."""
    return assumed._replace(**{key: metadata[key] for key in stated_keys(metadata)})


def unusual(assumed: PhotoCamera) -> list[str]:
    """Return a sentence on each value of an assumed camera that is not the usual one."""
    found = []
    if assumed.field_mm != FIELD_MM:
        factor = max(assumed.field_mm / FIELD_MM, FIELD_MM / assumed.field_mm)
        found.append(
            f"objects appear {factor:.1f} times {'smaller' if assumed.field_mm > FIELD_MM else 'larger'} than usual, "
            f"so photos are assumed to show {assumed.field_mm:.0f} mm, not {FIELD_MM:.0f} (field_mm)"
        )
    if assumed.roll_deg:
        direction = "anticlockwise" if assumed.roll_deg > 0 else "clockwise"
        found.append(
            f"photos appear to be turned by {abs(assumed.roll_deg):.0f} degrees {direction}, and are turned back "
            f"(roll_deg {assumed.roll_deg:g})"
        )
    return found


class _Look(NamedTuple):
    """What one photo suggests: the relative size of its object, and the probabilities of its roll."""

    size: float
    rolls: NDArray[np.float64]


def assumed_camera(
    photos: Iterable[tuple[str, Path, Collection[str]]], before: PhotoCamera = USUAL_CAMERA
) -> PhotoCamera:
    """Return the camera to assume where it is not stated: what the photos that do not state it agree on.

    Args:
        photos: Object, file, and keys of CAMERA_KEYS that are stated, of each photo.
        before: What was assumed until now. It stays if fewer than FEWEST objects show the camera.
    """
    listed, look = list(photos), cache(partial(_look, cache(RollEstimator)))
    found = {}
    for key, estimate in (("field_mm", _field_mm), ("roll_deg", _roll_deg)):
        files = defaultdict[str, list[Path]](list)
        for name, file, stated in listed:
            if key not in stated:
                files[name].append(file)
        looks = _looks(files, look)
        if len(looks) >= FEWEST:
            found[key] = estimate(looks)
        elif files:
            found[key] = getattr(before, key)
    return USUAL_CAMERA._replace(**found)


def _looks(files: Mapping[str, Sequence[Path]], look: Callable[[Path], _Look | None]) -> list[_Look]:
    """Return a look at the first photo with a found object, of SAMPLE objects at most; none of too few objects."""
    if len(files) < FEWEST:
        return []
    chosen = list(files.values())[:: math.ceil(len(files) / SAMPLE)]
    looks = (next(filter(None, map(look, of_object)), None) for of_object in chosen)
    return [each for each in looks if each is not None]


def _look(estimator: Callable[[], RollEstimator], path: Path) -> _Look | None:
    """Look at a photo; None if it cannot be read, which is reported when it is encoded, or shows no object."""
    try:
        photo = decode(read_bytes(path), path, 2 * INPUT_PX)
    except ImageError:
        return None
    height, width = photo.shape[:2]
    found = find_object(photo)
    if found.area >= height * width:
        return None
    return _Look(math.sqrt(found.area) / min(height, width), estimator().probabilities(photo, found))


def _field_mm(looks: Sequence[_Look]) -> float:
    steps = round(_STEPS * math.log2(USUAL_SIZE / float(np.median([look.size for look in looks]))))
    return FIELD_MM * (2 ** (steps / _STEPS) if abs(steps) >= _LEAST_STEPS else 1)


def _roll_deg(looks: Sequence[_Look]) -> float:
    return probable_roll(np.mean([look.rolls for look in looks], axis=0))
