"""The common part of all importers: the facts of a data set, and the loop that writes its grasps to a recording.

An importer yields the grasps of its data set one by one as `Item`, or as `Skip` for one that is not available;
`import_items` does the rest. Only the current item is in memory. Grasps that the recording already contains are not
read again, so a stopped import resumes where it stopped.

    recording.json        also: licence, terms, citation, fingers, notes (caveats, and unverified parts of the layout),
                          objects (object_id -> metadata of the data set), skipped (reason -> count)
    splits/<name>.json    a published split: {"seed": 0, "train": [object ids], "validation": [...], "test": [...]}
"""

import json
import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import Any

from _touch_retrieval.files import write_atomically
from robot.errors import ImporterError, RecordingError
from robot.recording.folder import GRASP_ID, Recording, RecordingWriter, SharedImage, read_recording
from robot.storage import ImageSource, file_content, storage_errors

Progress = Callable[[int, int], None]
"""Called with (done, total) after each grasp, whether it was read, already stored or skipped."""

Source = ImageSource | Callable[[], ImageSource]
"""An image, or a function that returns it."""

Images = Mapping[str, Source | SharedImage]
"""Column without `_file_name` -> image, as for `RecordingWriter`. A `SharedImage` is read and stored once."""

NOT_STATED = "not stated"
"""Licence of a data set whose files and repository state none, or of which we know none."""

SPLITS_FOLDER = "splits"
_MAX_REASONS, _EXAMPLES = 20, 3
_END_MARKERS = {".png": b"IEND\xaeB`\x82", ".jpg": b"\xff\xd9"}
_DIGITS = re.compile(r"[0-9]{1,4000}")
_TAIL = 65536
"""Bytes that a camera may write after the end of a JPEG."""


@dataclass(frozen=True)
class DataSet:
    """Facts of a data set that are known before its files are opened.

    Attributes:
        source: Name or address of the data set.
        licence: Name of the licence of the data, such as "CC BY 4.0"; `NOT_STATED` if none is known.
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
        """Return the error for a source that is not this data set.

        Args:
            src: The source.
            lacking: Sentence on the missing part.
        """
        return ImporterError(f"{src} must contain {self.expects.replace('`', '')}; {lacking}")


@dataclass(frozen=True)
class Item:
    """One grasp to append.

    Attributes:
        grasp_id: Unique id.
        object_id: Its object.
        images: Its images by column.
        fields: sequence_id, grasped and further arguments of `RecordingWriter.append`.
    """

    grasp_id: str
    object_id: str
    images: Images
    fields: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Skip:
    """One grasp that is not available.

    Attributes:
        reason: Completes "skipped 3: ..."; grasps are counted by reason.
        name: Name of the grasp or its file.
    """

    reason: str
    name: str


@dataclass(frozen=True)
class DataSetMetadata:
    """Metadata of a data set besides its grasps.

    Attributes:
        objects: object_id -> plain JSON.
        splits: Name -> part (train, validation, test) -> object ids.
    """

    objects: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    splits: Mapping[str, Mapping[str, Sequence[str]]] = field(default_factory=dict)


def import_items(
    data_set: DataSet,
    items: Iterable[Item | Skip],
    out: Path,
    *,
    total: int,
    progress: Progress | None = None,
    metadata: DataSetMetadata | None = None,
) -> Recording:
    """Write items to the recording `out`, or continue it.

    Args:
        data_set: Facts of the data set.
        items: Grasps, read one by one.
        out: Recording folder to write or continue.
        total: Number of items, for the progress.
        progress: Called with (done, total) after each item.
        metadata: Metadata of objects, and published splits.

    Returns:
        The recording. Its notes list skipped grasps with reasons, and the caveats of the data set.

    Raises:
        ImporterError: No grasp can be imported.
        RecordingError: The recording cannot be continued.
        StorageError: The recording cannot be written.
    """
    metadata = metadata or DataSetMetadata()
    skipped = _SkipCounts()
    notes = data_set.notes()
    with RecordingWriter(out, data_set.info()) as writer:
        names: set[str] = set()
        for done, item in enumerate(_readable(items), start=1):
            if isinstance(item, Skip):
                skipped.add(item)
            elif item.grasp_id in names:
                skipped.add(Skip("another grasp has the same name", item.grasp_id))
            else:
                names.add(item.grasp_id)
                if item.grasp_id not in writer.grasp_ids:
                    skipped.add(_append(writer, item))
            if progress is not None:
                progress(done, max(total, done))
        if not writer.grasp_ids:
            raise ImporterError(
                f"no grasp could be imported: {'; '.join(skipped.notes()) or 'the source contains none'}"
            )
        rejected = _write_splits(out, metadata.splits)
        writer.update_info(objects=dict(metadata.objects), skipped=dict(skipped.counts), notes=[*notes, *rejected])
    recording = read_recording(out)
    return replace(recording, notes=(*recording.notes, *skipped.notes(), *rejected, *notes))


def _readable(items: Iterable[Item | Skip]) -> Iterator[Item | Skip]:
    try:
        yield from items
    except OSError as error:
        raise ImporterError(f"{error.filename or 'the source'} cannot be read: {error.strerror or error}") from error


def _append(writer: RecordingWriter, item: Item) -> Skip | None:
    """Append one grasp, or return why it was skipped."""
    images: dict[str, ImageSource | SharedImage] = {}
    for column, source in item.images.items():
        if isinstance(source, SharedImage) and writer.has_shared(source.name):
            images[column] = source
            continue
        try:
            data = picture_bytes(column, source.source if isinstance(source, SharedImage) else source)
        except ImporterError as error:
            return Skip(str(error), item.grasp_id)
        images[column] = SharedImage(source.name, data) if isinstance(source, SharedImage) else data
    try:
        writer.append(item.grasp_id, item.object_id, images, **item.fields)
    except RecordingError as error:
        return Skip(str(error), item.grasp_id)
    return None


def picture_bytes(column: str, source: Source) -> bytes:
    """Return the content of a complete PNG or JPEG file.

    Args:
        column: Column of the image, for errors.
        source: The image, or a function that returns it.

    Raises:
        ImporterError: The image is missing, cut off or not a picture. The message does not name the file.
    """
    label = column.replace("_", " ")
    image = source() if callable(source) else source
    if isinstance(image, str | Path) and not os.path.isfile(image):
        raise ImporterError(f"its {label} is missing")
    try:
        data, suffix = file_content(column, image)
    except RecordingError as error:
        is_file = isinstance(image, str | Path | bytes)
        required = "a readable PNG or JPEG file" if is_file else "a picture with 8-bit colours"
        raise ImporterError(f"its {label} is not {required}") from error
    if _END_MARKERS[suffix] not in data[-_TAIL:]:
        raise ImporterError(f"its {label} is cut off")
    return data


class _SkipCounts:
    """Counts of skipped grasps by reason, with the first names."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._names: dict[str, list[str]] = defaultdict(list)

    def add(self, skip: Skip | None) -> None:
        if skip is not None:
            known = skip.reason in self.counts or len(self.counts) < _MAX_REASONS
            reason = skip.reason if known else "another reason"
            self.counts[reason] += 1
            self._names[reason].append(skip.name)
            del self._names[reason][_EXAMPLES:]

    def notes(self) -> list[str]:
        return [f"skipped {n}: {reason}, such as {', '.join(self._names[reason])}" for reason, n in self.counts.items()]


def _write_splits(out: Path, splits: Mapping[str, Mapping[str, Sequence[str]]]) -> list[str]:
    """Write the splits whose parts have different objects; return a sentence on each other split."""
    rejected = []
    for name, parts in splits.items():
        counts = Counter(object_id for objects in parts.values() for object_id in set(objects))
        if shared := sum(count > 1 for count in counts.values()):
            rejected.append(
                f"the published split {name!r} has grasps of {shared} object(s) in two parts, so it does not test "
                "unseen objects; it is not stored, draw a split by objects"
            )
            continue
        split = {"seed": 0, **{part: sorted(parts.get(part, ())) for part in ("train", "validation", "test")}}
        with storage_errors(out / SPLITS_FOLDER):
            (out / SPLITS_FOLDER).mkdir(exist_ok=True)
            write_atomically(out / SPLITS_FOLDER / f"{name}.json", json.dumps(split, indent=1).encode() + b"\n")
    return rejected


# Files and names of a source --------------------------------------------------------------------------------


def safe_name(*parts: str) -> str:
    """Return the parts as a grasp_id, joined by "-".

    If the result is not a valid grasp_id, invalid characters are replaced and a digest of the parts is appended.

    >>> safe_name("mug", "01"), safe_name("my mug", "01")
    ('mug-01', 'my-mug-01-b68d33c2')
    """
    joined = "-".join(parts)
    if GRASP_ID.fullmatch(joined):
        return joined
    plain = re.sub(r"[^A-Za-z0-9._-]", "-", joined)[:100].lstrip("._-") or "grasp"
    # Names of unknown encoding and JSON escapes can contain surrogates.
    return f"{plain}-{sha256('/'.join(parts).encode(errors='surrogatepass')).hexdigest()[:8]}"


def numbered_files(folder: Path, pattern: re.Pattern[str]) -> list[tuple[re.Match[str], Path]]:
    """Return the files of a folder whose names match, in natural order; none if the folder does not exist.

    Raises:
        ImporterError: `folder` cannot be read.
    """
    names = sorted(_list(folder), key=natural_sort_key) if folder.is_dir() else []
    return [(match, folder / name) for name in names if (match := pattern.fullmatch(name))]


def subfolders(parent: Path) -> list[Path]:
    """Return the folders in `parent` except hidden ones, in natural order.

    Raises:
        ImporterError: `parent` cannot be read.
    """
    names = sorted((name for name in _list(parent) if not name.startswith(".")), key=natural_sort_key)
    return [parent / name for name in names if (parent / name).is_dir()]


def _list(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError as error:
        raise ImporterError(f"{folder} cannot be read: {error.strerror}") from error


def natural_sort_key(name: str) -> str:
    """Return a sort key that compares digits as numbers: each number is preceded by its count of digits."""
    key = _DIGITS.sub(lambda digits: f"\0{len(number := str(int(digits[0]))):04}{number}", name)
    return f"{key}\0{name}"


def import_extra(name: str, purpose: str) -> Any:
    """Import a package of the extra `importers`.

    Args:
        name: Package or module.
        purpose: The format that needs it, for the error.

    Raises:
        ImporterError: The package is missing.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise ImporterError(
            f"{purpose} needs {name}, which is missing; run pip install 'touch-retrieval[importers]'"
        ) from error
