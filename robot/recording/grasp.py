"""One grasp of a recording: its fields, their checks, and its line in metadata.jsonl."""

import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any, Literal, Self

from _touch_retrieval.documents import typed
from robot.errors import RecordingError

Outcome = Literal["held", "missed", "slipped", "no_plan"]
"""Outcome of an attempt: held after the lift, nothing between the jaws, lost during the lift, or no grasp planned."""

_NUMBERS = ("force_n", "opening_mm", "touch_skew_s", "time_s")
_PLAIN_KEYS = ("grasp_id", "object_id", *_NUMBERS, "pose", "grasped", "outcome", "sequence_id", "session")
_REPEATED_KEY = re.compile(r"object_id|sequence_id|session|outcome|photo_file_name|touch_[a-z]_before_file_name")
"""Keys with equal values in many lines; their strings are interned."""
_IMAGE_KEY = re.compile(r"(photo|depth|touch_([a-z])(_before|_after)?)_file_name")


@dataclass(frozen=True, slots=True)
class RecordedGrasp:
    """One grasp. Images are POSIX paths relative to the recording, touches by finger; None if not recorded.

    Attributes:
        grasp_id: Unique id.
        object_id: The object.
        photo: Colour picture of the object before the grasp; None in a recording of touches only.
        touches: Gel images of the closed jaws.
        touches_before: No-contact frames, just before the jaws close.
        touches_after: Gel images after the lift, before the release.
        depth: Depth picture, uint16 in mm.
        force_n: Commanded force on each finger.
        opening_mm: Distance between the fingers.
        pose: Pose of the gripper, as in `robot.readings.Pose.as_tuple`.
        touch_skew_s: Time between the fingers' images.
        grasped: Whether the gate accepted the grasp, not if the object was held; training omits grasps with false.
        outcome: What the gripper reports.
        sequence_id: Id shared by grasps that no split separates.
        session: Name of the sitting in which the grasp was recorded; light and gels drift from one session to the next.
        time_s: Time since the recording began.

    >>> grasp = robot.read_recording("recording").grasps[0]
    >>> sorted(grasp.touches)
    ['a', 'b']
    >>> sorted(grasp.images())[:2]
    ['photo', 'touch_a']
    """

    grasp_id: str
    object_id: str
    photo: str | None
    touches: Mapping[str, str] = field(hash=False)
    touches_before: Mapping[str, str] = field(default_factory=dict, hash=False)
    touches_after: Mapping[str, str] = field(default_factory=dict, hash=False)
    depth: str | None = None
    force_n: float | None = None
    opening_mm: float | None = None
    pose: tuple[float, ...] | None = None
    touch_skew_s: float | None = None
    grasped: bool | None = None
    outcome: Outcome | None = None
    sequence_id: str | None = None
    session: str | None = None
    time_s: float | None = None

    def __post_init__(self) -> None:
        """Raise RecordingError for an invalid name or path, or without a touch; `from_row` checks types too."""
        for key in ("grasp_id", "object_id", "sequence_id", "session"):
            if getattr(self, key) is not None:
                check_name(key, getattr(self, key))
        for column, path in self.images().items():
            if not _IMAGE_KEY.fullmatch(f"{column}_file_name"):
                raise RecordingError(f"{column!r} is not an image column; a finger is named by one letter, a to z")
            parts = PurePosixPath(path).parts if path.isprintable() else ()
            if not parts or ".." in parts or path.startswith("/") or re.match("[A-Za-z]:", path) or "\\" in path:
                raise RecordingError(f"{column}_file_name must be a path inside the recording, got {path!r}")
        if not self.touches:
            raise RecordingError("a grasp must have at least one touch (touch_a_file_name)")

    def images(self) -> dict[str, str]:
        """Return the files by column name without `_file_name`: photo, depth, touch_a, touch_a_before, ..."""
        views = {"photo": self.photo, "depth": self.depth}
        files = {column: path for column, path in views.items() if path is not None}
        for moment, touches in {"": self.touches, "_before": self.touches_before, "_after": self.touches_after}.items():
            files |= {f"touch_{finger}{moment}": touches[finger] for finger in sorted(touches)}
        return files

    def to_row(self) -> dict[str, Any]:
        """Return the JSON object of this grasp's line, without the values that were not recorded."""
        row = {key: getattr(self, key) for key in _PLAIN_KEYS if getattr(self, key) is not None}
        return row | {f"{column}_file_name": path for column, path in self.images().items()}

    @classmethod
    def from_row(cls, row: Mapping[str, Any]) -> Self:
        """Parse a row of `to_row`; null means not recorded, unknown keys are ignored; raise RecordingError on error."""
        values: dict[str, Any] = {"photo": None, "touches": {}, "touches_before": {}, "touches_after": {}}
        for key, value in row.items():
            if value is None:
                continue
            if type(value) is str and _REPEATED_KEY.fullmatch(key):
                value = sys.intern(value)
            if key in _PLAIN_KEYS:
                values[key] = value
            elif match := _IMAGE_KEY.fullmatch(key):
                whole, finger, moment = match.groups()
                if finger:
                    values[f"touches{moment or ''}"][finger] = value
                else:
                    values[whole] = value
        for key in ("grasp_id", "object_id"):
            if key not in values:
                raise RecordingError(f"{key} is missing")
        return typed(values, cls, error=RecordingError)


def check_name(key: str, value: object) -> None:
    """Raise RecordingError unless `value` is a non-empty printable string."""
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise RecordingError(f"{key} must be a non-empty printable string, got {value!r}")
