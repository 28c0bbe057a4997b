"""One grasp of a recording: its fields, what they must hold, and its line in metadata.jsonl."""

import contextlib
import math
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Real
from pathlib import PurePosixPath
from typing import Any, Self

import numpy as np

from robot.errors import RecordingError

_NUMBERS = ("force_n", "opening_mm", "touch_skew_s", "time_s")
OUTCOMES = ("held", "missed", "slipped", "no_plan")
"""What came of an attempt: held or lost (slipped) after the lift, nothing between the jaws, or nothing tried."""

_PLAIN_KEYS = ("grasp_id", "object_id", *_NUMBERS, "pose", "grasped", "outcome", "sequence_id")
_IMAGE_KEY = re.compile(r"(photo|depth|touch_([a-z])(_before|_after)?)_file_name")
_REPEATED_KEYS = re.compile(r"object_id|sequence_id|outcome|photo_file_name|touch_[a-z]_before_file_name")
"""Keys under which many lines say the same; their text is in memory once."""


@dataclass(frozen=True, slots=True)
class RecordedGrasp:
    """One grasp. Images are posix paths relative to the recording, touches by finger; None: not recorded.

    grasped: what the gate decided; training keeps these. outcome: one of OUTCOMES, what the gripper felt.
    touch_skew_s: how far apart in time the fingers' images were taken.

    >>> grasp = robot.read_recording("recording").grasps[0]
    >>> sorted(grasp.touches)
    ['a', 'b']
    >>> sorted(grasp.images())[:2]
    ['photo', 'touch_a']
    """

    grasp_id: str
    object_id: str
    photo: str
    touches: Mapping[str, str] = field(hash=False)
    touches_before: Mapping[str, str] = field(default_factory=dict, hash=False)
    touches_after: Mapping[str, str] = field(default_factory=dict, hash=False)
    depth: str | None = None
    force_n: float | None = None
    opening_mm: float | None = None
    pose: tuple[float, ...] | None = None
    touch_skew_s: float | None = None
    grasped: bool | None = None
    outcome: str | None = None
    sequence_id: str | None = None
    time_s: float | None = None

    def __post_init__(self) -> None:
        """Check every field, and make numbers of NumPy's plain ones. Raises RecordingError."""
        for key in ("grasp_id", "object_id", "sequence_id"):
            check_name(key, getattr(self, key), optional=key == "sequence_id")
        for key, path in self.images().items():
            _check_path(key, path)
        if not self.touches:
            raise RecordingError("a grasp must have at least one touch (touch_a_file_name)")
        for key in _NUMBERS:
            if getattr(self, key) is not None:
                object.__setattr__(self, key, _number(key, getattr(self, key)))
        if self.pose is not None:
            object.__setattr__(self, "pose", _pose(self.pose))
        if not isinstance(self.grasped, bool | np.bool_ | None):
            raise RecordingError(f"grasped must be true or false, got {self.grasped!r}")
        if self.grasped is not None:
            object.__setattr__(self, "grasped", bool(self.grasped))
        if self.outcome is not None and self.outcome not in OUTCOMES:
            raise RecordingError(f"outcome must be one of {', '.join(OUTCOMES)}, got {self.outcome!r}")

    def images(self) -> dict[str, str]:
        """The files by column name without `_file_name`: photo, depth, touch_a, touch_a_before, ..."""
        files = {"photo": self.photo} | ({} if self.depth is None else {"depth": self.depth})
        by_moment = {"": self.touches, "_before": self.touches_before, "_after": self.touches_after}
        for moment, touches in by_moment.items():
            files |= {f"touch_{finger}{moment}": touches[finger] for finger in sorted(touches)}
        return files

    def to_row(self) -> dict[str, Any]:
        """The JSON object of this grasp's line; what was not recorded is left out."""
        row = {key: getattr(self, key) for key in _PLAIN_KEYS if getattr(self, key) is not None}
        return row | {f"{column}_file_name": path for column, path in self.images().items()}

    @classmethod
    def from_row(cls, row: Mapping[str, Any]) -> Self:
        """Inverse of `to_row`; null counts as left out, other keys are passed over. Raises RecordingError."""
        present: dict[str, Any] = {
            key: sys.intern(value) if type(value) is str and _REPEATED_KEYS.fullmatch(key) else value
            for key, value in row.items()
            if value is not None
        }
        files = {key: value for key, value in present.items() if _IMAGE_KEY.fullmatch(key)}
        plain = {key: value for key, value in present.items() if key in _PLAIN_KEYS}
        for key in ("grasp_id", "object_id", "photo_file_name"):
            if key not in plain and key not in files:
                raise RecordingError(f"{key} is missing")
        return cls(**plain, **_image_fields(files))


def unknown_keys(row: Mapping[str, Any]) -> set[str]:
    """Keys of a line that mean nothing to us: other tools may keep their own there."""
    return {key for key in row if key not in _PLAIN_KEYS and not _IMAGE_KEY.fullmatch(key)}


def _image_fields(files: Mapping[str, str]) -> dict[str, Any]:
    """Columns with or without `_file_name` to the image fields of RecordedGrasp."""
    found: dict[str, Any] = {"touches": {}, "touches_before": {}, "touches_after": {}}
    for key, path in files.items():
        match = _IMAGE_KEY.fullmatch(key)
        assert match is not None
        whole, finger, moment = match.groups()
        if finger:
            found["touches" + (moment or "")][finger] = path
        else:
            found[whole] = path
    return found


def check_name(key: str, value: object, optional: bool = False) -> None:
    """Raise RecordingError unless `value` is a non-empty printable string, or None where that may be."""
    if value is None and optional:
        return
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise RecordingError(f"{key} must be a non-empty printable string, got {value!r}")


def _check_path(column: str, path: Any) -> None:
    """A path must stay inside the recording wherever the folder is copied to."""
    if not _IMAGE_KEY.fullmatch(f"{column}_file_name"):
        raise RecordingError(f"{column!r} is no image column; fingers are named by one letter, a to z")
    parts = PurePosixPath(path).parts if isinstance(path, str) and path.isprintable() else ()
    if not parts or ".." in parts or path.startswith("/") or re.match("[A-Za-z]:", path) or "\\" in path:
        raise RecordingError(f"{column}_file_name must be a path inside the recording, got {path!r}")


def _number(key: str, value: object) -> float:
    if not isinstance(value, bool) and isinstance(value, Real):
        with contextlib.suppress(OverflowError):
            if math.isfinite(value):
                return float(value)
    raise RecordingError(f"{key} must be a finite number, got {value!r}")


def _pose(value: object) -> tuple[float, ...]:
    if isinstance(value, str | bytes | Mapping) or not hasattr(value, "__iter__"):
        raise RecordingError(f"pose must be a list of numbers, got {value!r}")
    return tuple(_number("pose", number) for number in value)
