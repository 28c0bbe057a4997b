"""A catalogue: a folder of photos to search, with the user's own metadata beside them.

    catalog/<object_id>/<photo>     the first folder names the object, however deep the photo lies below it
    catalog/<object_id>.<ext>       or one photo per object, named by its file; other rules: retrieval.data.naming
    catalog/metadata.jsonl          optional: one JSON object a line, with `file_name` (a photo's path in the
                                    catalogue) or `object_id` (all its photos) and any other keys; where both
                                    give a key, the photo's own wins

Names that start with a dot are not looked at. A photo's stable id is its path in the catalogue, forward slashes.
Listing opens no photo; `read_photo` reads one, and one broken file never stops the rest.
"""

import hashlib
import json
import math
import os
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, NoReturn

from indexes.store.regular import read_regular
from retrieval.data.images import EXTENSIONS, decode_rgb, read_bytes
from retrieval.data.naming import STEM, Naming
from retrieval.data.resize import RgbImage
from retrieval.errors import DatasetError, ImageError

METADATA_FILE = "metadata.jsonl"
UNREAD = frozenset(
    {".arw", ".cr2", ".cr3", ".dng", ".gif", ".jfif", ".jp2", ".jxl", ".nef", ".orf", ".raf", ".rw2", ".svg", ".tga"}
)
"""Endings of pictures that are not read: their objects may be left without a photo."""
_LAYOUT = "put photos in <object_id>/<photo> or <object_id>.<ext>"


@dataclass(frozen=True)
class CataloguePhoto:
    """One photo: `photo_id` is its `path`, relative to the catalogue; `metadata` is the user's own."""

    photo_id: str
    object_id: str
    path: str
    metadata: dict[str, Any] = field(default_factory=dict, hash=False)


@dataclass(frozen=True)
class SkippedPhoto:
    """A file or folder that could not be used, and why."""

    path: str
    reason: str


@dataclass(frozen=True)
class Catalogue:
    """What a folder holds: photos by id, files that are no photos by name, what was left out, remarks.

    unread: objects of pictures that were left out by their names' endings.
    """

    folder: Path
    photos: tuple[CataloguePhoto, ...]
    ignored: tuple[str, ...] = ()
    skipped: tuple[SkippedPhoto, ...] = ()
    notes: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()

    @property
    def object_ids(self) -> tuple[str, ...]:
        """The objects, sorted, each once; some may have no photo that can be read."""
        return tuple(sorted({photo.object_id for photo in self.photos} | set(self.unread)))


@dataclass(frozen=True)
class PhotoBytes:
    """A photo's file as it was read, and the SHA-256 (hex) of those bytes."""

    photo: CataloguePhoto
    data: bytes = field(repr=False)
    digest: str

    def decode(self) -> RgbImage:
        """(H, W, 3) float32 RGB in 0..1 from these bytes. Raises ImageError."""
        return decode_rgb(self.data, self.photo.path)


def list_catalogue(folder: str | Path, naming: Naming | None = None) -> Catalogue:
    """List the photos below `folder`, by id. naming: which object each shows; by folder where None.

    Raises DatasetError: no folder, no photo, none that fits the naming, bad metadata.
    """
    root, naming = Path(folder), naming or Naming()
    if not root.is_dir():
        what = "is a file" if root.exists() else "does not exist"
        raise DatasetError(f"a catalogue must be a folder of photos, but {root} {what}: {_LAYOUT}")
    walk = _Walk(root)
    objects = {path: naming.object_of(path) for path in sorted(walk.files) if _ending(path) in EXTENSIONS | UNREAD}
    listed = [
        CataloguePhoto(path, name, path)
        for path, name in objects.items()
        if name is not None and _ending(path) in EXTENSIONS
    ]
    skipped = [
        SkippedPhoto(path, reason) for path, name in objects.items() if (reason := _unusable(path, name, naming))
    ]
    ignored = sorted(set(walk.files) - set(objects) - {METADATA_FILE})
    skipped = [*walk.skipped, *skipped]
    if not listed and (unfit := [path for path in objects if _ending(path) in EXTENSIONS]):
        raise DatasetError(
            f"no photo in {root} fits --objects-from {naming.text}; the first of {len(unfit)}: {unfit[0]}. "
            "Give folder, stem, or a pattern for paths like this one"
        )
    if not listed:
        raise DatasetError(_no_photos(root, ignored, skipped))
    listed, notes = _with_metadata(listed, root / METADATA_FILE, naming)
    unread = {name for path, name in objects.items() if name is not None and _ending(path) in UNREAD}
    return Catalogue(root, tuple(listed), tuple(ignored), tuple(skipped), tuple(notes), tuple(sorted(unread)))


def read_photo(catalogue: Catalogue, photo: CataloguePhoto) -> PhotoBytes | SkippedPhoto:
    """Read a photo's bytes, once; an unreadable one is a SkippedPhoto."""
    try:
        data = read_bytes(catalogue.folder / photo.path)
    except ImageError as error:
        return SkippedPhoto(photo.path, error.reason)
    return PhotoBytes(photo, data, hashlib.sha256(data).hexdigest())


def decode_photo(item: PhotoBytes | SkippedPhoto) -> RgbImage | SkippedPhoto:
    """Decode what `read_photo` gave to (H, W, 3) float32, or say why it is left out."""
    if isinstance(item, SkippedPhoto):
        return item
    try:
        return item.decode()
    except ImageError as error:
        return SkippedPhoto(item.photo.path, error.reason)


def _ending(path: str) -> str:
    return os.path.splitext(path)[1].lower()


def _unusable(path: str, name: str | None, naming: Naming) -> str:
    """Why a picture is left out by its path; empty for all else."""
    if _ending(path) in UNREAD:
        return f"{_ending(path)} pictures are not read: save it as PNG or JPEG"
    if name is None:
        return f"does not fit --objects-from {naming.text}" + (": a number alone" if naming.text == STEM else "")
    return ""


def _no_photos(root: Path, ignored: list[str], skipped: list[SkippedPhoto]) -> str:
    found = f"{len(ignored)} other files" + (f" such as {ignored[0]}" if ignored else "")
    left_out = "".join(f"; {item.path}: {item.reason}" for item in skipped[:1])
    kinds = ", ".join(sorted(EXTENSIONS))
    return f"no photo ({kinds}) in the catalogue {root}, only {found}{left_out}: {_LAYOUT}"


class _Walk:
    """All files below a folder as relative posix paths.

    A link to a folder is followed when it leads out of the catalogue, and each target once: no loop can hang.
    """

    def __init__(self, root: Path) -> None:
        self.files: list[str] = []
        self.skipped: list[SkippedPhoto] = []
        self._root = Path(os.path.realpath(root))
        self._followed: set[Path] = set()
        self._folder(root, "")

    def _folder(self, folder: Path, prefix: str) -> None:
        try:
            entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
        except OSError as error:
            raise DatasetError(f"cannot list the catalogue folder {folder}: {error.strerror}") from error
        for entry in entries:
            if not entry.name.startswith("."):
                self._entry(entry, prefix + entry.name)

    def _entry(self, entry: "os.DirEntry[str]", path: str) -> None:
        if reason := _bad_name(entry.name) or self._bad_link(entry):
            self.skipped.append(SkippedPhoto(os.fsencode(path).decode(errors="backslashreplace"), reason))
        elif _is_dir(entry):
            self._folder(Path(entry.path), path + "/")
        else:
            self.files.append(path)

    def _bad_link(self, entry: "os.DirEntry[str]") -> str:
        """Why a link to a folder is not followed; empty for all else. Remembers what is followed."""
        if not (entry.is_symlink() and _is_dir(entry)):
            return ""
        target = Path(os.path.realpath(entry.path))
        if target.is_relative_to(self._root) or self._root.is_relative_to(target):
            return "a link into or around the catalogue itself is not followed"
        if target in self._followed:
            return f"a link to {target}, which another link has listed already"
        self._followed.add(target)
        return ""


def _is_dir(entry: "os.DirEntry[str]") -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a link that leads to itself
        return False


def _bad_name(name: str) -> str:
    try:
        name.encode()
    except UnicodeEncodeError:
        return "the name is not valid UTF-8; rename it"
    return ""


# The user's own metadata -----------------------------------------------------------------------------------


def _with_metadata(photos: list[CataloguePhoto], path: Path, naming: Naming) -> tuple[list[CataloguePhoto], list[str]]:
    """Add what metadata.jsonl says of each photo and its object; remark on lines that fit no photo."""
    by_object, by_photo = _read_metadata(path, naming)
    listed = []
    for photo in photos:
        metadata = {**by_object.get(photo.object_id, {}), **by_photo.get(photo.path, {})}
        listed.append(CataloguePhoto(photo.photo_id, photo.object_id, photo.path, metadata))
    unknown = sorted(set(by_photo) - {photo.path for photo in photos})
    unknown += sorted(set(by_object) - {photo.object_id for photo in photos})
    return listed, [f"{METADATA_FILE} speaks of {name}, which is not in the catalogue" for name in unknown]


_Table = dict[str, dict[str, Any]]


def _read_metadata(path: Path, naming: Naming) -> tuple[_Table, _Table]:
    """Return (by object_id, by photo path) without the two keys. Raises DatasetError with the line number."""
    by_object: _Table = {}
    by_photo: _Table = {}
    for number, line in enumerate(_lines(path), start=1):
        if not line.strip():
            continue
        try:
            name, is_photo, metadata = _parse_line(line, naming)
            table = by_photo if is_photo else by_object
            if name in table:
                raise ValueError(f"{name} has a line already; join the two")
        except (ValueError, RecursionError) as error:
            raise DatasetError(f"{path}, line {number}: {error}") from error
        table[name] = metadata
    return by_object, by_photo


def _lines(path: Path) -> list[bytes]:
    try:
        return read_regular(path).split(b"\n")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}") from error


def _parse_line(line: bytes, naming: Naming) -> tuple[str, bool, dict[str, Any]]:
    """Return (photo path or object_id, whether it is a photo, the other keys). Raises ValueError."""
    row = json.loads(line.decode(), parse_constant=_refuse_number, parse_float=_finite)
    if not isinstance(row, dict):
        raise ValueError("must hold one JSON object in braces")
    keys = [key for key in ("file_name", "object_id") if key in row]
    if not keys:
        raise ValueError("must name a photo (file_name) or an object (object_id)")
    if bad := [key for key in keys if not isinstance(row[key], str) or not row[key]]:
        raise ValueError(f"{bad[0]} must be a non-empty string, got {row[bad[0]]!r}")
    metadata = {key: value for key, value in row.items() if key not in keys}
    if "file_name" not in row:
        return row["object_id"], False, metadata
    path = PurePosixPath(row["file_name"]).as_posix()
    name = naming.object_of(path)
    if row.get("object_id", name) != name:
        raise ValueError(f"{path} lies in object {name}, but the line says {row['object_id']}")
    return path, True, metadata


def _finite(text: str) -> float:
    number = float(text)
    return number if math.isfinite(number) else _refuse_number(text)


def _refuse_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a finite number")
