"""A catalogue: a folder of photos to search, with the user's own metadata.

    catalog/<object_id>/<photo>     the first folder names the object; the photo may be at any depth below it
    catalog/<object_id>.<ext>       or one photo per object, named like the object; other rules: retrieval.data.naming
    catalog/<object_id>/touch_<name>.png                         a touch of the object, of a sensor with one finger
    catalog/<object_id>/touch_<name>_a.png, touch_<name>_b.png   or of two fingers, in this order
    catalog/metadata.jsonl          optional: one JSON object per line, with `file_name` (a photo's path in the
                                    catalogue) or `object_id` (all its photos) and any other keys; a photo's
                                    value of a key takes precedence over its object's

Names that start with a dot are skipped. A photo's path in the catalogue, with forward slashes, is its stable id.
Listing opens no photo.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

from _touch_retrieval.files import parse_json, read_regular
from retrieval.data.folder_walk import SkippedPhoto, list_files
from retrieval.data.images import EXTENSIONS, read_bytes
from retrieval.data.naming import STEM, Naming
from retrieval.data.text import require_utf8
from retrieval.errors import BadInput, DatasetError

METADATA_FILE = "metadata.jsonl"
UNSUPPORTED_EXTENSIONS = frozenset(
    {".arw", ".cr2", ".cr3", ".dng", ".gif", ".jfif", ".jp2", ".jxl", ".nef", ".orf", ".raf", ".rw2", ".svg", ".tga"}
)
"""Extensions of picture formats that are not read. An object with only such files has no photo."""
_TOUCH = re.compile(r"(touch_.*?)(?:_([a-z]))?", re.DOTALL)
_LAYOUT = "put photos in <object_id>/<photo> or <object_id>.<ext>"


@dataclass(frozen=True, slots=True)
class CataloguePhoto:
    """One photo of a catalogue.

    Attributes:
        path: Path relative to the catalogue.
        object_id: The object that the photo shows.
        metadata: The user's own keys and values.
    """

    path: str
    object_id: str
    metadata: dict[str, Any] = field(default_factory=dict, hash=False)


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


@dataclass(frozen=True)
class Catalogue:
    """The photos and touches of a catalogue folder.

    Attributes:
        folder: The catalogue folder.
        photos: Photos, sorted by path.
        ignored: Names of files that are not pictures.
        skipped: Pictures that are left out, with reasons.
        notes: Remarks for the user.
        touches: Touches of the objects, with or without photos.
    """

    folder: Path
    photos: tuple[CataloguePhoto, ...]
    ignored: tuple[str, ...] = ()
    skipped: tuple[SkippedPhoto, ...] = ()
    notes: tuple[str, ...] = ()
    touches: tuple[CatalogueTouch, ...] = ()

    @property
    def where(self) -> str:
        """The absolute path of the folder, which indexes store."""
        return str(self.folder.resolve())

    def read(self, path: str) -> bytes:
        """Return the bytes of a photo's file.

        Raises:
            ImageError: The file cannot be read.
        """
        return read_bytes(self.folder / path)

    @property
    def paths(self) -> list[str]:
        """The paths of all photos and gel images."""
        return [*(photo.path for photo in self.photos), *(path for touch in self.touches for path in touch.paths)]

    @property
    def object_ids(self) -> tuple[str, ...]:
        """The distinct objects, sorted; some may have no readable photo."""
        return tuple(sorted({photo.object_id for photo in self.photos} | {touch.object_id for touch in self.touches}))


def require_separate_folders(catalogue: str | Path, index: str | Path) -> None:
    """Check that an index folder contains no photos of the catalogue.

    An index may be a folder below the catalogue that contains no photos, such as `./index` in the catalogue `.`.

    Raises:
        BadInput: The index folder is the catalogue folder, or a folder below it that contains photos.
    """
    root, target = Path(catalogue).resolve(), Path(index).resolve()
    has_photos = root in target.parents and any(path.suffix.lower() in EXTENSIONS for path in target.rglob("*"))
    if target == root or has_photos:
        raise BadInput(f"the index would be written among the photos in {index}; name another folder with --out")


def list_catalogue(folder: str | Path, naming: Naming | None = None) -> Catalogue:
    """List the photos and touches below `folder`, sorted by path.

    Args:
        folder: The catalogue folder.
        naming: Rule that names the object of each photo; None for the rule "folder".

    Raises:
        DatasetError: The folder does not exist, contains no photo or touch, or only ones that do not fit the
            naming; or the metadata are invalid.
    """
    root, naming = Path(folder), naming or Naming()
    if not root.is_dir():
        what = "is a file" if root.exists() else "does not exist"
        raise DatasetError(f"a catalogue must be a folder of photos, but {root} {what}: {_LAYOUT}")
    names, unlisted = list_files(root)
    metadata_file = root / METADATA_FILE
    try:
        lines = read_regular(metadata_file)
    except FileNotFoundError:
        lines = b""
    except OSError as error:
        raise DatasetError(f"{metadata_file} cannot be read: {error.strerror}") from error
    found = _classify_files(names, naming)
    found.skipped[:0] = unlisted
    if not found.photos and not found.gels:
        raise _no_photo_error(root, found, naming)
    by_object, by_photo = _read_metadata(metadata_file, lines, naming)
    touches = group_touches(found.gels, naming)
    unknown = sorted(by_photo.keys() - [*found.photos, *(path for path, _ in found.gels)])
    unknown += sorted(by_object.keys() - [*found.objects, *(touch.object_id for touch in touches)])
    return Catalogue(
        root,
        tuple(
            CataloguePhoto(path, name, {**by_object.get(name, {}), **by_photo.get(path, {})})
            for path, name in zip(found.photos, found.objects, strict=True)
        ),
        tuple(found.ignored),
        tuple(found.skipped),
        tuple(f"{METADATA_FILE} names {name}, which is not in the catalogue" for name in unknown),
        tuple(
            replace(touch, metadata={**by_object.get(touch.object_id, {}), **by_photo.get(touch.paths[0], {})})
            for touch in touches
        ),
    )


@dataclass
class _FileGroups:
    """Files of a catalogue, classified by name.

    Attributes:
        photos: Paths of the photos.
        objects: The object of each photo.
        gels: (path, object) of each gel image.
        ignored: Files that are not pictures.
        skipped: Pictures that are left out, with reasons.
        unfit: Paths among `skipped` that do not fit the naming.
    """

    photos: list[str] = field(default_factory=list)
    objects: list[str] = field(default_factory=list)
    gels: list[tuple[str, str]] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)
    skipped: list[SkippedPhoto] = field(default_factory=list)
    unfit: list[str] = field(default_factory=list)


def _classify_files(names: Iterable[str], naming: Naming) -> _FileGroups:
    """Classify files by name and extension, in alphabetical order."""
    found = _FileGroups()
    for path in sorted(names):
        dot = path.rfind(".")
        extension = path[dot:].lower() if dot > path.rfind("/") + 1 else ""
        if extension not in EXTENSIONS and extension not in UNSUPPORTED_EXTENSIONS:
            found.ignored += [path] if path != METADATA_FILE else []
            continue
        name = naming.object_of(path)
        if extension in UNSUPPORTED_EXTENSIONS:
            found.skipped.append(SkippedPhoto(path, f"{extension} pictures are not read: save it as PNG or JPEG"))
        elif name is None:
            why = ": the name is only a number" if naming.text == STEM else ""
            found.skipped.append(SkippedPhoto(path, f"does not fit --objects-from {naming.text}{why}"))
            found.unfit.append(path)
        elif touch_name(path, naming) is None:
            found.photos.append(path)
            found.objects.append(name)
        else:
            found.gels.append((path, name))
    return found


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


def _no_photo_error(where: Path, found: _FileGroups, naming: Naming) -> DatasetError:
    """Return the error for a catalogue without photos and touches."""
    if found.unfit:
        return DatasetError(
            f"no photo in {where} fits --objects-from {naming.text}; the first of {len(found.unfit)}: "
            f"{found.unfit[0]}. Use folder, stem, or a pattern for paths like this one"
        )
    others = f", only {len(found.ignored)} other file(s) such as {found.ignored[0]}" if found.ignored else ""
    if not found.ignored and not found.skipped:
        others = ", and no other file"
    left_out = "".join(f"; {item.path}: {item.reason}" for item in found.skipped[:1])
    kinds = ", ".join(sorted(EXTENSIONS))
    return DatasetError(f"no photo ({kinds}) in the catalogue {where}{others}{left_out}: {_LAYOUT}")


# The user's own metadata -----------------------------------------------------------------------------------


_MetadataTable = dict[str, dict[str, Any]]


def _read_metadata(where: Path, text: bytes, naming: Naming) -> tuple[_MetadataTable, _MetadataTable]:
    """Return the user's keys by object_id, and by photo path.

    Raises:
        DatasetError: A line is invalid; the message gives its number.
    """
    by_object: _MetadataTable = {}
    by_photo: _MetadataTable = {}
    for number, line in enumerate(text.split(b"\n"), start=1):
        if not line.strip():
            continue
        try:
            name, is_photo, metadata = _parse_line(line, naming)
            table = by_photo if is_photo else by_object
            if name in table:
                raise ValueError(f"{name} has two lines; merge them")
        except ValueError as error:
            raise DatasetError(f"{where}, line {number}: {error}") from error
        table[name] = metadata
    return by_object, by_photo


def _parse_line(line: bytes, naming: Naming) -> tuple[str, bool, dict[str, Any]]:
    """Return (photo path or object_id, whether it is a photo, the other keys)."""
    row = parse_json(line.decode(), finite=True)
    if not isinstance(row, dict):
        raise ValueError("must be one JSON object in braces")
    if b"\\u" in line:
        require_utf8(row)
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
        raise ValueError(f"{path} belongs to object {name}, but the line names {row['object_id']}")
    return path, True, metadata
