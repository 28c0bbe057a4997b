"""Touches in a catalogue: gel images beside an object's photos, by their files' names.

    catalog/<object_id>/touch_<name>.png                             one touch of a sensor with one finger
    catalog/<object_id>/touch_<name>_a.png, touch_<name>_b.png       one touch of two fingers, in this order

`<name>` tells the touches of an object apart, a number or whatever else; fingers are called a, b, ... as in recordings.
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
    """One touch: paths of its gel images in the catalogue, a finger after the other; metadata: the user's own."""

    object_id: str
    paths: tuple[str, ...]
    metadata: dict[str, Any] = field(default_factory=dict, hash=False)


def touch_name(path: str, naming: Naming) -> tuple[str, str] | None:
    """Of a gel image the name of its touch, folder and all, and its finger, perhaps ""; None for a photo.

    In no folder, and where objects are named by the stem of a file, every picture is a photo.
    """
    if "/touch_" not in path or naming.text == STEM:
        return None
    place = PurePosixPath(path)
    found = _TOUCH.fullmatch(place.stem)
    return None if found is None else (f"{place.parent}/{found[1]}", found[2] or "")


def group_touches(images: Iterable[tuple[str, str]], naming: Naming) -> tuple[CatalogueTouch, ...]:
    """Touches of gel images, each with its object; in the order of their names."""
    found: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for path, object_id in images:
        named = touch_name(path, naming)
        assert named is not None
        found.setdefault((named[0], object_id), []).append((named[1], path))
    return tuple(
        CatalogueTouch(owner, tuple(path for _, path in sorted(own))) for (_, owner), own in sorted(found.items())
    )
