"""What an index says of itself and of its photos, checked as it is read: an index may come from anyone."""

from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from indexes.errors import AGAIN, CorruptIndex
from indexes.store.generation import Generation


@dataclass(frozen=True)
class ListedPhoto:
    """A row of an index. path: inside the catalogue, relative to it; metadata: the user's own."""

    object_id: str
    path: str
    metadata: dict[str, Any]


def listed_photo(row: dict[str, Any]) -> ListedPhoto:
    """The photo of a row. Raises CorruptIndex for one whose parts are missing or that lies outside the catalogue, from
    where its picture would be put into pages."""
    object_id, path, metadata = (row.get(name) for name in ("object_id", "path", "metadata"))
    if not (isinstance(object_id, str) and isinstance(path, str) and isinstance(metadata, dict)):
        raise CorruptIndex(f"row {row['id']!r} must have an object_id, a path and metadata; {AGAIN}")
    parts = PurePosixPath(path)
    if not parts.parts or parts.is_absolute() or ".." in parts.parts or "\0" in path:
        raise CorruptIndex(f"row {row['id']!r} must name a photo inside the catalogue, names {path!r}; {AGAIN}")
    return ListedPhoto(object_id, path, metadata)


def require_usable(generation: Generation, hidden: int) -> None:
    """Raise CorruptIndex unless the index says where its catalogue and checkpoint lie, and holds halves of `hidden`
    numbers."""
    about, halves = generation.manifest.about, generation.arrays.get("halves")
    candidates = about.get("candidates")
    if candidates is not None and not (isinstance(candidates, dict) and _is_count(candidates.get("k"))):
        raise CorruptIndex(f"{generation.folder}: its number of candidates must be 1 or more; {AGAIN}")
    if not all(isinstance(about.get(name), str) and "\0" not in about[name] for name in ("catalogue", "checkpoint")):
        raise CorruptIndex(f"{generation.folder}: it must say its catalogue and its checkpoint; {AGAIN}")
    if halves is None or halves.ndim != 2 or halves.shape[1] != hidden or halves.dtype.kind != "f":
        got = "none" if halves is None else f"{halves.dtype} {halves.shape}"
        raise CorruptIndex(f"{generation.folder}: it must hold halves of {hidden} numbers, holds {got}; {AGAIN}")


def _is_count(value: object) -> bool:
    return type(value) is int and 1 <= value < 2**31
