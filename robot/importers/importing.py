"""The common part of all importers: the facts of a data set, and the loop that writes its grasps to a recording.

An importer yields the grasps of its data set one by one as `Item`, or as `Skip` for one that is not available;
`import_items` does the rest. Grasps that the recording already contains are not read again, so a stopped import
resumes where it stopped. It is refused if its options differ, or if a file of the source changed or is gone; new files
are added.

    recording.json        also: licence, terms, citation, fingers, notes (caveats, and unverified parts of the layout),
                          objects (object_id -> metadata of the data set), skipped (reason -> count),
                          left_out (video -> number of its first images without use, such as black ones)
    sources.json          options of the import, and size, time (ns) and SHA-256 of each file of the source
    splits/published.json a published split: {"seed": 0, "train": [object ids], "validation": [...], "test": [...]}
"""

import contextlib
import io
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from _touch_retrieval.files import file_digest, write_atomically
from _touch_retrieval.names import is_system_name
from robot.errors import ImporterError, RecordingError
from robot.recording.folder import Recording, RecordingWriter, SharedImage, read_recording
from robot.storage import ImageSource, file_content, read_content, read_json_object, storage_errors

Progress = Callable[[int, int], None]
"""Called with (done, total) after each grasp, whether it was read, already stored or skipped."""

Source = ImageSource | Callable[[], ImageSource]
"""An image, or a function that returns it."""

Images = Mapping[str, Source | SharedImage]
"""Column without `_file_name` -> image, as for `RecordingWriter`. A `SharedImage` is read and stored once."""

NOT_STATED = "not stated"
"""Licence of a data set whose files and repository state none, or of which we know none."""

SPLITS_FOLDER = "splits"
SOURCES_FILE = "sources.json"


@dataclass(frozen=True)
class DataSet:
    """Facts of a data set that are known before its files are opened.

    Attributes:
        source: Name or address.
        licence: Licence of the data, such as "CC BY 4.0"; `NOT_STATED` if none is known.
        citation: Publication to cite.
        sensor: Tactile sensor.
        rig: Robot, camera and other devices.
        expects: Required content of its folder, in Markdown.
        fingers: Gel images per touch; 0 if that varies.
        background: When no-contact frames were taken, or "none".
        terms: Conditions of use, or where to find them.
        caveats: Risks for results, one sentence each.
        unverified: Parts of the layout that were not verified on the data itself.
    """

    source: str
    licence: str
    citation: str
    sensor: str
    rig: str
    expects: str
    fingers: int = 1
    background: str = "none"
    terms: str = ""
    caveats: tuple[str, ...] = ()
    unverified: tuple[str, ...] = ()

    def notes(self) -> list[str]:
        """Return caveats and unverified parts as sentences for the user."""
        return [*self.caveats, *(f"not verified on the data itself: {part}" for part in self.unverified)]

    def info(self) -> dict[str, Any]:
        """Return the entries of recording.json on the data set."""
        plain = {key: value for key, value in vars(self).items() if key not in ("expects", "caveats", "unverified")}
        return {**plain, "notes": self.notes()}

    def mismatch_error(self, src: Path, lacking: str) -> ImporterError:
        """Return the error for a source that is not this data set, with a sentence on the missing part."""
        return ImporterError(f"{src} must contain {self.expects.replace('`', '')}; {lacking}")


@dataclass(frozen=True)
class Item:
    """One grasp to append, with the arguments of `RecordingWriter.append`."""

    grasp_id: str
    object_id: str
    images: Images
    fields: Mapping[str, Any] = field(default_factory=dict)
    left_out: Mapping[str, int] = field(default_factory=dict)
    """Video -> number of its first images that were left out; it may be filled while the images are read."""


@dataclass(frozen=True)
class Skip:
    """One grasp, or its file, that is not available; `reason` completes "skipped 3: ..."."""

    reason: str
    name: str


def import_items(
    data_set: DataSet,
    items: Iterable[Item | Skip],
    out: Path,
    *,
    total: int,
    progress: Progress | None = None,
    source: Path | None = None,
    options: Mapping[str, Any] = {},
    objects: Mapping[str, Mapping[str, Any]] = {},
    split: Mapping[str, Sequence[str]] | None = None,
) -> Recording:
    """Write items to the recording `out`, or continue it.

    Args:
        data_set: Facts of the data set.
        items: Grasps, read one by one.
        out: Recording folder to write or continue.
        total: Number of items, for the progress.
        progress: Called with (done, total) after each item.
        source: File or folder that is imported; None does not check its files.
        options: Options of the import.
        objects: object_id -> metadata, plain JSON.
        split: The published split: part (train, validation, test) -> object ids.

    Returns:
        The recording. Its notes list skipped grasps with reasons, and the caveats of the data set.

    Raises:
        ImporterError: No grasp can be imported.
        RecordingError: The recording cannot be continued, or was imported with other options or files.
        StorageError: The recording cannot be written.
    """
    skipped: dict[str, list[str]] = {}  # reason -> names
    notes = data_set.notes()
    with RecordingWriter(out, data_set.info()) as writer:
        _check_same_import(writer, data_set, source, options)
        names: set[str] = set()
        infinite: list[str] = []
        for done, item in enumerate(_readable(items), start=1):
            if isinstance(item, Skip):
                skip: Skip | None = item
            else:
                finite = {
                    key: value
                    for key, value in item.fields.items()
                    if not isinstance(value, float) or math.isfinite(value)
                }
                infinite += [key for key in item.fields if key not in finite]
                skip = _append(writer, replace(item, fields=finite), names)
                stored = writer.info.get("left_out", {})
                if item.left_out.items() - stored.items():
                    writer.update_info(left_out={**stored, **item.left_out})
            if skip is not None:
                skipped.setdefault(skip.reason, []).append(skip.name)
            if progress is not None:
                progress(done, max(total, done))
        skips = [f"skipped {len(some)}: {reason}, such as {some[0]}" for reason, some in skipped.items()]
        if not writer.grasp_ids:
            raise ImporterError(f"no grasp could be imported: {'; '.join(skips) or 'the source contains none'}")
        if split is not None:
            notes = [*_write_split(out, split), *notes]
        if infinite:
            notes.insert(0, f"left out {len(infinite)} number(s) that are not finite, such as {infinite[0]}")
        if left_out := writer.info.get("left_out", {}):
            starts = ", ".join(f"{number} of {video}" for video, number in list(left_out.items())[:5])
            notes = [
                f"left out first images that are black, dim or of another colour than all later ones: {starts}"
                f"{' ...' if len(left_out) > 5 else ''}; the next image is the first one used",
                *notes,
            ]
        writer.update_info(
            objects=dict(objects), skipped={reason: len(some) for reason, some in skipped.items()}, notes=notes
        )
    recording = read_recording(out)
    return replace(recording, notes=(*recording.notes, *skips, *notes))


def _check_same_import(
    writer: RecordingWriter, data_set: DataSet, source: Path | None, options: Mapping[str, Any]
) -> None:
    """Store options and files of the source, or raise RecordingError that names what differs from the stored ones."""
    path = writer.folder / SOURCES_FILE
    old = read_json_object(path, RecordingError) if path.is_file() else None
    if old is None and source is not None and writer.grasp_ids:
        raise RecordingError(f"{writer.folder} has grasps but no {SOURCES_FILE}; give another folder")
    stored = old or {"options": {}, "files": {}}
    options = {"licence": data_set.licence, "fingers": data_set.fingers, **options}
    new = {"options": options, "files": _source_files(source, writer.folder, stored["files"]) if source else {}}
    before = stored["options"]
    changes = [
        f"{key} {before.get(key)!r}, not {now!r}" for key, now in options.items() if old and before.get(key) != now
    ]
    for name, (*_, digest) in stored["files"].items():
        if digest != (now := new["files"].get(name, ("is gone",))[-1]):
            changes.append(f"the file {name}, which {now if now == 'is gone' else 'has changed'}")
    if changes:
        more = f" and {len(changes) - 3} more differences" if len(changes) > 3 else ""
        raise RecordingError(
            f"{writer.folder} was imported with {'; '.join(changes[:3])}{more}, and its grasps would stay as they are; "
            "give another folder, or delete this one"
        )
    if old != new:
        with storage_errors(path):
            write_atomically(path, json.dumps(new, indent=1).encode() + b"\n")


def _source_files(source: Path, out: Path, known: Mapping[str, list[Any]]) -> dict[str, list[Any]]:
    """Return size, time (ns) and SHA-256 of the files of a source, except those of systems and of the recording.

    A file whose size and time are known is not read.
    """
    paths = [source] if source.is_file() else []
    for folder, folders, names in os.walk(source):
        folders[:] = [
            name for name in folders if not is_system_name(name) and not os.path.samefile(Path(folder, name), out)
        ]
        paths += [path for name in names if not is_system_name(name) and (path := Path(folder, name)).is_file()]
    files = {}
    for path in sorted(paths):
        name = os.fsencode(path.relative_to(source) if path != source else path.name).decode(errors="backslashreplace")
        facts = [path.stat().st_size, path.stat().st_mtime_ns]
        stored = known.get(name, [])
        with contextlib.suppress(OSError):  # what cannot be read is no source
            files[name] = stored if stored[:2] == facts else [*facts, file_digest(path)]
    return files


def _readable(items: Iterable[Item | Skip]) -> Iterator[Item | Skip]:
    try:
        yield from items
    except OSError as error:
        raise ImporterError(f"{error.filename or 'the source'} cannot be read: {error.strerror or error}") from error


def _append(writer: RecordingWriter, item: Item, names: set[str]) -> Skip | None:
    """Append one grasp unless it is stored, or return why it was skipped; `names` are those of the grasps before."""
    if item.grasp_id in names:
        return Skip("another grasp has the same name", item.grasp_id)
    names.add(item.grasp_id)
    if item.grasp_id in writer.grasp_ids:
        return None
    images: dict[str, ImageSource | SharedImage] = {}
    try:
        for column, source in item.images.items():
            if not isinstance(source, SharedImage):
                images[column] = picture_bytes(column, source)
            elif writer.shared_path(source.name):
                images[column] = source
            else:
                images[column] = SharedImage(source.name, picture_bytes(column, source.source))
        writer.append(item.grasp_id, item.object_id, images, **item.fields)
    except (ImporterError, RecordingError) as error:
        return Skip(str(error), item.grasp_id)
    return None


def _png_or_jpeg(image: bytes | str | Path) -> bytes:
    """Return the content of a picture file, BMP, TIFF and WebP as PNG; anything else unchanged."""
    from PIL import Image, ImageOps

    data = image if isinstance(image, bytes) else read_content(image, RecordingError)
    with contextlib.suppress(Exception), Image.open(io.BytesIO(data), formats=("BMP", "TIFF", "WEBP")) as picture:
        if picture.mode in ("L", "RGB"):
            png = io.BytesIO()
            ImageOps.exif_transpose(picture).convert("RGB").save(png, "PNG")
            return png.getvalue()
    return data


def picture_bytes(column: str, source: Source) -> bytes:
    """Return the content of a complete PNG or JPEG file; a BMP, TIFF or WebP file becomes PNG.

    Raises:
        ImporterError: The image is missing, cut off or not a picture. The message does not name the file.
    """
    from PIL import Image

    label = column.replace("_", " ")
    image = source() if callable(source) else source
    if isinstance(image, str | Path) and not os.path.isfile(image):
        raise ImporterError(f"its {label} is missing")
    if isinstance(image, np.ndarray):
        try:
            return file_content(column, image)[0]
        except RecordingError as error:
            raise ImporterError(f"its {label} is not a picture with 8-bit colours") from error
    try:
        data, _ = file_content(column, _png_or_jpeg(image))
    except RecordingError as error:
        raise ImporterError(f"its {label} is not a readable picture of 8 bits (PNG, JPEG, BMP, TIFF, WebP)") from error
    try:  # OpenCV fills what is missing with grey; what follows the picture, such as a film, is not read
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG")) as picture:
            picture.draft(None, (1, 1))
            picture.load()
    except Exception as error:  # of Pillow: OSError, SyntaxError, struct.error, ...
        raise ImporterError(f"its {label} is cut off or damaged") from error
    return data


def _write_split(out: Path, split: Mapping[str, Sequence[str]]) -> list[str]:
    """Write the published split if its parts have different objects, else return a sentence for the user."""
    parts = {part: sorted(split.get(part, ())) for part in ("train", "validation", "test")}
    names = [name for objects in parts.values() for name in objects]
    if len(set(names)) < len(names):
        return ["the published split has objects in two parts, so it does not test unseen objects; it is not stored"]
    with storage_errors(out / SPLITS_FOLDER):
        (out / SPLITS_FOLDER).mkdir(exist_ok=True)
        document = json.dumps({"seed": 0, **parts}, indent=1).encode() + b"\n"
        write_atomically(out / SPLITS_FOLDER / "published.json", document)
    return []


def numbered_files(folder: Path, pattern: re.Pattern[str]) -> list[tuple[re.Match[str], Path]]:
    """Return the files of a folder whose names match, in natural order; none if the folder does not exist."""
    names = sorted(os.listdir(folder), key=natural_sort_key) if folder.is_dir() else []
    return [(match, folder / name) for name in names if (match := pattern.fullmatch(name))]


def subfolders(parent: Path) -> list[Path]:
    """Return the folders in `parent` except those of systems, in natural order; none if it does not exist."""
    names = sorted(os.listdir(parent), key=natural_sort_key) if parent.is_dir() else []
    return [parent / name for name in names if not is_system_name(name) and (parent / name).is_dir()]


def natural_sort_key(name: str) -> tuple[list[str | int], str]:
    """Return a sort key that compares digits as numbers."""
    return [int(part) if part.isascii() and part.isdigit() else part for part in re.split("([0-9]+)", name)], name
