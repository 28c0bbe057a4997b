"""A catalogue: a folder of photos to search, with the user's own metadata.

    catalog/<object_id>/<photo>     the first folder names the object; the photo may be at any depth below it
    catalog/<object_id>.<ext>       or one photo per object, named like the object; other rules: retrieval.data.naming
    catalog/<object_id>/touch_<name>.png                         a touch of the object, of a sensor with one finger
    catalog/<object_id>/touch_<name>_a.png, touch_<name>_b.png   or of two fingers, in this order
    catalog/metadata.jsonl          optional: one JSON object per line, with `file_name` (a photo's path in the
                                    catalogue) or `object_id` (all its photos) and any other keys; a photo's
                                    value of a key takes precedence over its object's; `opening_mm` in the line
                                    of a touch's gel image, or of the object, is the opening of the jaws; `field_mm`
                                    is what a photo shows along its shorter side, at the object's distance, `roll_deg`
                                    by how much it is turned anticlockwise, and a line with these keys alone is for
                                    all photos

A picture is recognised by its extension, or by its content if it has no extension of a picture. Hidden files and those
of systems and network drives are left out (`_touch_retrieval.names`). A photo's path in the catalogue, with forward
slashes, is its stable id.

A recording is a catalogue, too: of the photos and touches of its accepted grasps, with their openings.
"""

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path, PurePosixPath
from string import ascii_lowercase
from typing import Any

import msgspec

from _touch_retrieval.files import open_regular, parse_json, read_regular
from _touch_retrieval.names import is_system_name, lookup_key
from _touch_retrieval.text import decode_text
from retrieval.console.output import abbreviate_list
from retrieval.data.camera import CAMERA_KEYS, require_camera
from retrieval.data.dataset import load_grasps, stated_by_recording
from retrieval.data.images import EXTENSIONS, is_picture
from retrieval.data.naming import MAX_EXAMPLES, STEM, Naming
from retrieval.data.opening import believed, require_opening
from retrieval.data.text import is_utf8
from retrieval.errors import BadInput, DatasetError

METADATA_FILE = "metadata.jsonl"
_ALL_PHOTOS = ""
"""Name of the object whose metadata are those of all photos."""
HISTORY = "history.sqlite"
"""File with the queries of a service, in the folder of its history."""
_OWN_FILES = frozenset({"CURRENT", "SHARDS.json", HISTORY})
"""Files in the folder of an index, of a sharded index, and of the history of a service. Its pictures are no photos."""
UNSUPPORTED_EXTENSIONS = frozenset(
    {".arw", ".cr2", ".cr3", ".dng", ".gif", ".jp2", ".jxl", ".nef", ".orf", ".raf", ".rw2", ".svg", ".tga"}
)
"""Extensions of picture formats that are not read, some of which begin like TIFF."""
_TABLES = frozenset({".csv", ".json", ".jsonl", ".ods", ".tsv", ".xls", ".xlsx"})
_TOUCH = re.compile(r"(touch_.*?)(?:_([a-z]))?", re.DOTALL)
_NEARLY_TOUCH = re.compile(r"touch_.*|touch[ -].*[ _-][a-z]", re.DOTALL | re.IGNORECASE)
_NEARLY_FINGER = re.compile(r"touch_.+[ _-][a-z]([ (].*| ?- ?copy.*)?", re.DOTALL | re.IGNORECASE)
_TOUCH_NAMES = "gel images of a touch are named touch_<name>_a, touch_<name>_b and so on, each once"
_LAYOUT = "put photos in <object_id>/<photo> or <object_id>.<ext>"


@dataclass(frozen=True)
class SkippedPhoto:
    """A file or folder that cannot be used, with the reason."""

    path: str
    reason: str


@dataclass(frozen=True, slots=True)
class CataloguePhoto:
    """One photo of a catalogue.

    Attributes:
        path: Its path relative to the catalogue.
        object_id: Its object.
        metadata: The user's own keys and values.
    """

    path: str
    object_id: str
    metadata: dict[str, Any] = field(default_factory=dict, hash=False)


@dataclass(frozen=True, slots=True)
class CatalogueTouch:
    """One touch of an object.

    Attributes:
        object_id: The object.
        paths: Paths of its gel images relative to the catalogue, in finger order.
        metadata: Metadata of the object and of these images; the first image takes precedence.
        opening_mm: Distance between the fingers, from these metadata.
    """

    object_id: str
    paths: tuple[str, ...]
    metadata: dict[str, Any] = field(default_factory=dict, hash=False)
    opening_mm: float | None = None


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

    @property
    def paths(self) -> list[str]:
        """The paths of all photos and gel images."""
        return [*(photo.path for photo in self.photos), *(path for touch in self.touches for path in touch.paths)]

    @property
    def object_ids(self) -> tuple[str, ...]:
        """The distinct objects, sorted; some may have no readable photo."""
        return tuple(sorted({photo.object_id for photo in self.photos} | {touch.object_id for touch in self.touches}))


def require_separate_folders(catalogue: str | Path, index: str | Path) -> None:
    """Raise BadInput if the index folder is the catalogue folder, or a folder of photos below it."""
    root, target = Path(catalogue).resolve(), Path(index).resolve()
    is_new_inside = root in target.parents and not any((target / name).exists() for name in _OWN_FILES)
    if target == root or (is_new_inside and any(path.suffix.lower() in EXTENSIONS for path in target.rglob("*"))):
        raise BadInput(f"the index would be written among the photos in {index}; name another folder with --out")


def list_catalogue(folder: str | Path, naming: Naming | None = None) -> Catalogue:
    """List the photos and touches below `folder`, sorted by path.

    Args:
        folder: The catalogue folder, or a recording, which names its objects itself.
        naming: Rule that names the object of each photo; None for the rule "folder".

    Raises:
        DatasetError: The folder does not exist, contains no photo or touch, or only ones that do not fit the
            naming; or the metadata are invalid.
    """
    root, naming = Path(folder), naming or Naming()
    if not root.is_dir():
        what = "is a file" if root.exists() else "does not exist"
        raise DatasetError(f"a catalogue must be a folder of photos, but {root} {what}: {_LAYOUT}")
    if (root / "recording.json").is_file():
        return _list_recording(root)
    names, skipped, system = _list_files(root)
    by_object, by_photo = _read_metadata(root / METADATA_FILE, naming)

    def metadata_of(name: str, *paths: str) -> dict[str, Any]:
        metadata = {**by_object.get(_ALL_PHOTOS, {}), **by_object.get(lookup_key(name), {})}
        for path in reversed(paths):
            metadata = {**metadata, **by_photo.get(lookup_key(path), {})}
        return metadata

    photos: list[CataloguePhoto] = []
    gels: dict[tuple[str, str], list[tuple[str, str]]] = defaultdict(list)  # (touch, object) -> (finger, path)
    ignored: list[str] = []
    unfit: list[SkippedPhoto] = []
    for path in sorted(names):
        extension = os.path.splitext(path)[1].lower()
        if extension not in EXTENSIONS and (path == METADATA_FILE or not _has_picture(root / path, extension)):
            if extension in UNSUPPORTED_EXTENSIONS:
                skipped.append(SkippedPhoto(path, f"{extension} pictures are not read: save it as PNG or JPEG"))
            elif path != METADATA_FILE:
                ignored.append(path)
        elif (name := naming.object_of(path)) is None:
            why = ": the name is only a number" if naming.text == STEM else ""
            unfit.append(SkippedPhoto(path, f"does not fit --objects-from {naming.text}{why}"))
        # A picture outside every folder is a photo, and so is every picture if the file stem names the object.
        elif "/" not in path or naming.text == STEM or not _NEARLY_TOUCH.fullmatch(PurePosixPath(path).stem):
            metadata = metadata_of(name, path)
            require_camera(metadata, f"{METADATA_FILE}, {path}")
            photos.append(CataloguePhoto(path, name, metadata))
        elif (touch := _touch_name(path)) is None:
            skipped.append(SkippedPhoto(path, f"neither a photo nor a touch: {_TOUCH_NAMES}"))
        else:
            gels[touch[0], name].append((touch[1], path))

    touches = []
    for (_, name), fingers in sorted(gels.items()):
        letters, paths = zip(*sorted(fingers), strict=True)
        if letters not in (("",), tuple(ascii_lowercase[: len(letters)])):
            reason = f"its touch has the images {', '.join(paths)}; {_TOUCH_NAMES}"
            skipped += [SkippedPhoto(path, reason) for path in paths]
        else:
            metadata = metadata_of(name, *paths)
            opening = metadata.get("opening_mm")
            if opening is not None:
                opening = require_opening(opening, f"{root / METADATA_FILE}: opening_mm of {paths[0]}")
            touches.append(CatalogueTouch(name, paths, metadata, opening))
    if not photos and not touches:
        raise _no_photo_error(root, ignored, skipped, unfit, naming)
    catalogue = Catalogue(root, tuple(photos), tuple(ignored), (*skipped, *unfit), touches=tuple(touches))
    unknown = [
        *sorted(by_photo.keys() - set(map(lookup_key, catalogue.paths))),
        *sorted(by_object.keys() - {_ALL_PHOTOS, *map(lookup_key, catalogue.object_ids)}),
    ]
    notes = [f"{METADATA_FILE} names {name}, which is not in the catalogue" for name in unknown]
    return replace(catalogue, notes=(*notes, *_notes_on_files(catalogue, names, system)))


def _list_recording(root: Path) -> Catalogue:
    grasps, camera = load_grasps(root), stated_by_recording(root)

    def paths(files: Iterable[Path]) -> tuple[str, ...]:
        return tuple(file.relative_to(root).as_posix() for file in files)

    photos = {path: CataloguePhoto(path, grasp.object_id, camera) for grasp in grasps for path in paths(grasp.photos)}
    touches = {
        CatalogueTouch(grasp.object_id, paths(grasp.touches), opening_mm=believed(grasp.opening_mm)) for grasp in grasps
    }
    return Catalogue(
        root,
        tuple(photos[path] for path in sorted(photos)),
        touches=tuple(sorted(touches, key=attrgetter("paths"))),
    )


def _has_picture(path: Path, extension: str) -> bool:
    """Whether a file without the extension of a picture contains one; a raw photo of a camera only looks like TIFF."""
    try:
        with open_regular(path) as file:
            head = file.read(64)
    except OSError:
        return False
    return is_picture(head) and (extension not in UNSUPPORTED_EXTENSIONS or head[:2] not in (b"II", b"MM"))


def _notes_on_files(catalogue: Catalogue, names: Sequence[str], system: Sequence[str]) -> Iterator[str]:
    """Yield remarks on what a user may have expected to be in the catalogue."""
    if system:
        yield f"{len(system)} file(s) or folder(s) of the system left out: {abbreviate_list(system, MAX_EXAMPLES)}"
    used, folders = _folders(catalogue.paths), _folders(names)
    if empty := sorted(folder for folder in folders - used if str(PurePosixPath(folder).parent) in used):
        yield f"no picture in {len(empty)} folder(s) that contain files: {abbreviate_list(empty, MAX_EXAMPLES)}"
    if tables := [name for name in catalogue.ignored if PurePosixPath(name).suffix.lower() in _TABLES]:
        yield (
            f"{abbreviate_list(tables, MAX_EXAMPLES)}: not read; titles and other facts of objects can be given in "
            f'{METADATA_FILE}, a line such as {{"object_id": "mug", "title": "Blue mug"}} for each'
        )


def _folders(paths: Iterable[str]) -> set[str]:
    """Return all folders above these files; the catalogue itself is "."."""
    nearest = {path.rpartition("/")[0] for path in paths}
    return {str(folder) for path in nearest for folder in PurePosixPath(path, "file").parents}


def _list_files(folder: Path) -> tuple[list[str], list[SkippedPhoto], list[str]]:
    """Return the files below a folder as posix paths relative to it, what cannot be used, and names of the system.

    A link to a folder is followed if it leads out of `folder`, and each target once: no loop is endless.
    """
    root = Path(os.path.realpath(folder))
    names: list[str] = []
    skipped: list[SkippedPhoto] = []
    system: list[str] = []
    targets: set[Path] = set()

    def walk(place: str, prefix: str) -> None:
        try:
            entries = sorted(os.scandir(place), key=attrgetter("name"))
        except OSError as error:
            raise DatasetError(f"cannot list the catalogue folder {place}: {error.strerror}") from error
        if prefix and any(entry.name in _OWN_FILES for entry in entries):
            return
        for entry in entries:
            path = prefix + entry.name
            if is_system_name(entry.name):
                if not entry.name.startswith("."):
                    system.append(path)
            elif not path.isascii() and not is_utf8(path):
                printable = path.encode(errors="surrogateescape").decode(errors="backslashreplace")
                skipped.append(SkippedPhoto(printable, "the name is not valid UTF-8; rename it"))
            elif not os.path.isdir(entry):  # False for a link that leads to itself
                names.append(path)
            elif not entry.is_symlink():
                walk(entry.path, f"{path}/")
            elif (target := Path(os.path.realpath(entry.path))).is_relative_to(root) or root.is_relative_to(target):
                skipped.append(SkippedPhoto(path, "a link into or around the catalogue itself is not followed"))
            elif target in targets:
                skipped.append(SkippedPhoto(path, f"a link to {target}, which another link has listed already"))
            else:
                targets.add(target)
                walk(entry.path, f"{path}/")

    walk(str(folder), "")
    return names, skipped, system


def _touch_name(path: str) -> tuple[str, str] | None:
    """Return a gel image's touch name (with its folder) and finger ("" for one finger); None if it is not exact."""
    place = PurePosixPath(path)
    match = _TOUCH.fullmatch(place.stem)
    if match is None or (match[2] is None and _NEARLY_FINGER.fullmatch(match[1])):
        return None
    return f"{place.parent}/{match[1]}", match[2] or ""


def _no_photo_error(
    where: Path, ignored: list[str], skipped: list[SkippedPhoto], unfit: list[SkippedPhoto], naming: Naming
) -> DatasetError:
    if unfit:
        return DatasetError(
            f"no photo in {where} fits --objects-from {naming.text}; the first of {len(unfit)}: "
            f"{unfit[0].path}. Use folder, stem, or a pattern for paths like this one"
        )
    others = f", only {len(ignored)} other file(s) such as {ignored[0]}" if ignored else ""
    left_out = "".join(f"; {item.path}: {item.reason}" for item in skipped[:1])
    return DatasetError(
        f"no photo ({', '.join(sorted(EXTENSIONS))}) in the catalogue {where}{others}{left_out}: {_LAYOUT}"
    )


def _read_metadata(file: Path, naming: Naming) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Any]]]:
    """Return the user's keys by object_id, and by photo path. Raises DatasetError with the number of a bad line."""
    by_object: dict[str, dict[str, Any]] = {}
    by_photo: dict[str, dict[str, Any]] = {}
    try:
        lines = decode_text(read_regular(file)).split("\n") if os.path.lexists(file) else []
    except OSError as error:
        raise DatasetError(f"{file} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise DatasetError(f"{file}, {error}") from error
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            name, is_photo, metadata = _parse_line(line, naming)
            name, table = lookup_key(name), by_photo if is_photo else by_object
            if name in table:
                raise ValueError(f"{f'{name} has' if name else 'all photos have'} two lines; merge them")
        except msgspec.DecodeError as error:
            raise DatasetError(f"{file}, line {number}: must be one JSON object a line, no NaN: {error}") from error
        except ValueError as error:
            raise DatasetError(f"{file}, line {number}: {error}") from error
        table[name] = metadata
    return by_object, by_photo


def _parse_line(line: str, naming: Naming) -> tuple[str, bool, dict[str, Any]]:
    """Return (photo path or object_id, whether it is a photo, the other keys)."""
    row = parse_json(line)
    if not isinstance(row, dict):
        raise ValueError("must be one JSON object a line, in braces")
    if row and row.keys() <= CAMERA_KEYS:
        return _ALL_PHOTOS, False, row
    keys = [key for key in ("file_name", "object_id") if key in row]
    if not keys:
        raise ValueError(
            "must name a photo (file_name) or an object (object_id), or have no other keys than "
            f"{' and '.join(sorted(CAMERA_KEYS))}, for all photos; it has {', '.join(row) or 'nothing'}"
        )
    if bad := [key for key in keys if not isinstance(row[key], str) or not row[key]]:
        raise ValueError(f"{bad[0]} must be a non-empty string, got {row[bad[0]]!r}")
    metadata = {key: value for key, value in row.items() if key not in keys}
    if "file_name" not in row:
        return row["object_id"], False, metadata
    path = PurePosixPath(row["file_name"].replace("\\", "/")).as_posix()  # scripts write paths of Windows, too
    name = naming.object_of(path)
    if name is not None and lookup_key(row.get("object_id", name)) != lookup_key(name):
        raise ValueError(f"{path} belongs to object {name}, but the line names {row['object_id']}")
    return path, True, metadata
