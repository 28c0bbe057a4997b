"""Touches in a catalogue: gel images next to an object's photos, recognised by their file names.

    catalog/<object_id>/touch_<name>.png                             one touch of a sensor with one finger
    catalog/<object_id>/touch_<name>_a.png, touch_<name>_b.png       one touch of two fingers, in this order

`<name>` distinguishes the touches of an object, such as a number. Fingers are called a, b, ... as in recordings.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

from retrieval.data.naming import STEM, Naming

_TOUCH = re.compile(r"(touch_.*?)(?:_([a-z]))?", re.DOTALL)


@dataclass(frozen=True, slots=True)
class CatalogueTouch:
    """One touch of a catalogue.

    Attributes:
        object_id: The touched object.
        paths: Paths of the gel images relative to the catalogue, in finger order.
        metadata: The user's own keys and values.
    """

    object_id: str
    paths: tuple[str, ...]
    metadata: dict[str, Any] = field(default_factory=dict, hash=False)


def touch_name(path: str, naming: Naming) -> tuple[str, str] | None:
    """Return a gel image's touch name (with its folder) and finger ("" for one finger), or None for a photo.

    A picture outside every folder is a photo, and so is every picture if the file stem names the object.
    """
    if "/touch_" not in path or naming.text == STEM:
        return None
    place = PurePosixPath(path)
    found = _TOUCH.fullmatch(place.stem)
    return None if found is None else (f"{place.parent}/{found[1]}", found[2] or "")


def group_touches(images: Iterable[tuple[str, str]], naming: Naming) -> tuple[CatalogueTouch, ...]:
    """Group gel images, (path, object) each, into touches, sorted by name."""
    groups: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for path, object_id in images:
        name = touch_name(path, naming)
        assert name is not None
        groups.setdefault((name[0], object_id), []).append((name[1], path))
    return tuple(
        CatalogueTouch(owner, tuple(path for _, path in sorted(fingers)))
        for (_, owner), fingers in sorted(groups.items())
    )
