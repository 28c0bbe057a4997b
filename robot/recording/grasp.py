"""One grasp of a recording: its fields, their checks, and its line in metadata.jsonl."""

import math
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from pathlib import PurePosixPath
from typing import Any, Self, cast

import numpy as np

from robot.errors import RecordingError

_NUMBERS = ("force_n", "opening_mm", "touch_skew_s", "time_s")
OUTCOMES = ("held", "missed", "slipped", "no_plan")
"""Outcomes of an attempt: held after the lift, nothing between the jaws, lost during the lift, or no grasp planned."""

_PLAIN_KEYS = ("grasp_id", "object_id", *_NUMBERS, "pose", "grasped", "outcome", "sequence_id")
_IMAGE_KEY = re.compile(r"(photo|depth|touch_([a-z])(_before|_after)?)_file_name")
_REPEATED_KEYS = re.compile(r"object_id|sequence_id|outcome|photo_file_name|touch_[a-z]_before_file_name")
"""Keys with equal values in many lines; their strings are interned."""


@dataclass(frozen=True, slots=True)
class RecordedGrasp:
    """One grasp. Images are POSIX paths relative to the recording, touches by finger; None if not recorded.

    Attributes:
        grasp_id: Unique id.
        object_id: The object.
        photo: Colour picture of the object before the grasp.
        touches: Gel images of the closed jaws.
        touches_before: No-contact frames, just before the jaws close.
        touches_after: Gel images after the lift, before the release.
        depth: Depth picture, uint16 in mm.
        force_n: Commanded force on each finger.
        opening_mm: Distance between the fingers.
        pose: Pose of the gripper, as in `robot.readings.Pose.as_tuple`.
        touch_skew_s: Time between the fingers' images.
        grasped: Whether the gate accepted the grasp, not if the object was held; training omits grasps with false.
        outcome: One of OUTCOMES, as the gripper reports.
        sequence_id: Id shared by grasps that no split separates.
        time_s: Time since the recording began.

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
        """Check every field and convert NumPy numbers to plain ones; raise RecordingError if one is invalid."""
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
            if isinstance(pose := cast(object, self.pose), str) or not isinstance(pose, Sequence | np.ndarray):
                raise RecordingError(f"pose must be a list of numbers, got {self.pose!r}")
            object.__setattr__(self, "pose", tuple(_number("pose", number) for number in self.pose))
        if not isinstance(self.grasped, bool | np.bool_ | None):
            raise RecordingError(f"grasped must be true or false, got {self.grasped!r}")
        if self.grasped is not None:
            object.__setattr__(self, "grasped", bool(self.grasped))
        if self.outcome is not None and self.outcome not in OUTCOMES:
            raise RecordingError(f"outcome must be one of {', '.join(OUTCOMES)}, got {self.outcome!r}")

    def images(self) -> dict[str, str]:
        """Return the files by column name without `_file_name`: photo, depth, touch_a, touch_a_before, ..."""
        files = {"photo": self.photo} | ({} if self.depth is None else {"depth": self.depth})
        by_moment = {"": self.touches, "_before": self.touches_before, "_after": self.touches_after}
        for moment, touches in by_moment.items():
            files |= {f"touch_{finger}{moment}": touches[finger] for finger in sorted(touches)}
        return files

    def to_row(self) -> dict[str, Any]:
        """Return the JSON object of this grasp's line, without the values that were not recorded."""
        row = {key: getattr(self, key) for key in _PLAIN_KEYS if getattr(self, key) is not None}
        return row | {f"{column}_file_name": path for column, path in self.images().items()}

    @classmethod
    def from_row(cls, row: Mapping[str, Any]) -> Self:
        """Parse a row of `to_row`; null means not recorded, unknown keys are ignored; raise RecordingError on error."""
        plain: dict[str, Any] = {}
        touches: dict[str, Any] = {"touches": {}, "touches_before": {}, "touches_after": {}}
        for key, value in row.items():
            if value is None:
                continue
            if type(value) is str and _REPEATED_KEYS.fullmatch(key):
                value = sys.intern(value)
            if key in _PLAIN_KEYS:
                plain[key] = value
            elif match := _IMAGE_KEY.fullmatch(key):
                whole, finger, moment = match.groups()
                if finger:
                    touches[f"touches{moment or ''}"][finger] = value
                else:
                    plain[whole] = value
        for key in ("grasp_id", "object_id", "photo"):
            if key not in plain:
                raise RecordingError(f"{key}{'_file_name' * (key == 'photo')} is missing")
        return cls(**plain, **touches)


def unknown_keys(row: Mapping[str, Any]) -> set[str]:
    """Return the keys of a line that the format does not define, such as those of other tools."""
    return {key for key in row if key not in _PLAIN_KEYS and not _IMAGE_KEY.fullmatch(key)}


def check_name(key: str, value: object, optional: bool = False) -> None:
    """Raise RecordingError unless `value` is a non-empty printable string, or None if `optional`."""
    if value is None and optional:
        return
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise RecordingError(f"{key} must be a non-empty printable string, got {value!r}")


def _check_path(column: str, path: Any) -> None:
    """Raise RecordingError unless the path stays inside the recording, also after the folder is copied."""
    if not _IMAGE_KEY.fullmatch(f"{column}_file_name"):
        raise RecordingError(f"{column!r} is not an image column; a finger is named by one letter, a to z")
    parts = PurePosixPath(path).parts if isinstance(path, str) and path.isprintable() else ()
    if not parts or ".." in parts or path.startswith("/") or re.match("[A-Za-z]:", path) or "\\" in path:
        raise RecordingError(f"{column}_file_name must be a path inside the recording, got {path!r}")


def _number(key: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise RecordingError(f"{key} must be a finite number, got {value!r}")
    return float(value)
