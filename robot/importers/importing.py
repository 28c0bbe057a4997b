"""What importers share: the facts of a data set, and the loop that writes its grasps into a recording.

An importer finds the grasps of its data set one after the other and hands them over as `Item`, or as `Skip` where one
cannot be had; `import_items` does the rest. Only the item at hand is in memory. A grasp that the recording holds is
passed over unread, so an import that was stopped goes on where it stopped.

    recording.json        also: licence, citation, fingers, notes (traps, and what of the layout was never verified),
                          objects (object_id -> what the data set says of it), skipped (reason -> how many)
    splits/<name>.json    a published split: {"seed": 0, "train": [object ids], "validation": [...], "test": [...]}
"""

import json
import os
import re
from collections import Counter
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
"""Called with (done, total) after each grasp, whether it was read, held already or skipped."""

Source = ImageSource | Callable[[], ImageSource]
"""An image, or what makes it when it is its turn."""

Images = Mapping[str, Source | SharedImage]
"""As RecordingWriter takes them: column without `_file_name` to image. A `SharedImage` one is read and kept once."""

SPLITS_FOLDER = "splits"
_MAX_REASONS, _EXAMPLES = 20, 3
_END_MARKERS = {".png": b"IEND\xaeB`\x82", ".jpg": b"\xff\xd9"}
_DIGITS = re.compile(r"[0-9]{1,4000}")
_TAIL = 65536
"""Bytes after the end of a JPEG that a camera may have put there."""
_MAX_VIDEO_PIXELS = 50_000_000


@dataclass(frozen=True)
class DataSet:
    """What is known of a data set before its files are opened.

    expects: what its folder must hold, in Markdown. fingers: gel images of a touch, 0 where that differs.
    background: when no-contact frames were taken, or "none". traps: what spoils a result, a sentence each.
    unverified: what of the layout was not seen on the data itself.
    """

    source: str
    licence: str
    citation: str
    sensor: str
    rig: str
    expects: str
    fingers: int = 1
    background: str = "none"
    caveats: tuple[str, ...] = ()
    unverified: tuple[str, ...] = ()

    def notes(self) -> list[str]:
        """Sentences for who imports it."""
        return [*self.caveats, *(f"not verified on the data itself: {each}" for each in self.unverified)]

    def info(self) -> dict[str, Any]:
        """What recording.json says of it."""
        plain = {key: value for key, value in vars(self).items() if key not in ("expects", "traps", "unverified")}
        return {**plain, "notes": self.notes()}

    def mismatch_error(self, src: Path, lacking: str) -> ImporterError:
        """The error for a source that is not this data set: what it must hold, and what it lacks."""
        return ImporterError(f"{src} must hold {self.expects.replace('`', '')}; {lacking}")


@dataclass(frozen=True)
class Item:
    """One grasp to append. fields: sequence_id, grasped and what else RecordingWriter.append takes."""

    grasp_id: str
    object_id: str
    images: Images
    fields: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Skip:
    """One grasp that cannot be had. `reason` completes "skipped 3: ..." and is what they are counted by."""

    reason: str
    name: str


@dataclass(frozen=True)
class DataSetMetadata:
    """What a data set says beside its grasps. objects: object_id -> plain JSON. splits: name -> part (train,
    validation, test) -> object ids.
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
    """Write the items into the recording `out`, or continue it. `total`: how many items there are, for the progress.

    The notes of the returned recording say what was skipped and why, and the traps of the data set. Raises
    ImporterError where nothing can be imported, RecordingError, StorageError.
    """
    said = metadata or DataSetMetadata()
    skipped = _SkipCounts()
    notes = data_set.notes()
    with RecordingWriter(out, data_set.info()) as writer:
        seen: set[str] = set()
        for done, item in enumerate(_readable(items), start=1):
            if isinstance(item, Skip):
                skipped.add(item)
            elif item.grasp_id in seen:
                skipped.add(Skip("another grasp has its name", item.grasp_id))
            else:
                seen.add(item.grasp_id)
                if item.grasp_id not in writer.grasp_ids:
                    skipped.add(_append(writer, item))
            if progress is not None:
                progress(done, max(total, done))
        if not writer.grasp_ids:
            raise ImporterError(f"no grasp could be imported: {'; '.join(skipped.notes()) or 'the source holds none'}")
        splits, refused = _split_disjoint(said.splits)
        writer.update_info(objects=dict(said.objects), skipped=dict(skipped.counts), notes=[*notes, *refused])
        _write_splits(out, splits)
    recording = read_recording(out)
    return replace(recording, notes=(*recording.notes, *skipped.notes(), *refused, *notes))


def _readable(items: Iterable[Item | Skip]) -> Iterator[Item | Skip]:
    try:
        yield from items
    except OSError as error:
        raise ImporterError(f"{error.filename or 'the source'} cannot be read: {error.strerror or error}") from error


def _append(writer: RecordingWriter, item: Item) -> Skip | None:
    """Append one grasp; return why it was skipped, if it was."""
    images: dict[str, ImageSource | SharedImage] = {}
    for column, source in item.images.items():
        if isinstance(source, SharedImage) and writer.has_shared(source.name):
            images[column] = source
            continue
        try:
            whole = picture_bytes(column, source.source if isinstance(source, SharedImage) else source)
        except ImporterError as error:
            return Skip(str(error), item.grasp_id)
        images[column] = SharedImage(source.name, whole) if isinstance(source, SharedImage) else whole
    try:
        writer.append(item.grasp_id, item.object_id, images, **item.fields)
    except RecordingError as error:
        return Skip(str(error), item.grasp_id)
    return None


def picture_bytes(column: str, source: Source) -> bytes:
    """The content of a PNG or JPEG file that is there to its end. Raises ImporterError, which says no file's name."""
    what = column.replace("_", " ")
    made = source() if callable(source) else source
    if isinstance(made, str | Path) and not os.path.isfile(made):
        raise ImporterError(f"its {what} is missing")
    try:
        data, suffix = file_content(column, made)
    except RecordingError as error:
        readable = (
            "a readable PNG or JPEG file" if isinstance(made, str | Path | bytes) else "a picture of 8-bit colours"
        )
        raise ImporterError(f"its {what} is not {readable}") from error
    if _END_MARKERS[suffix] not in data[-_TAIL:]:
        raise ImporterError(f"its {what} is cut off")
    return data


class _SkipCounts:
    """How many were skipped, by reason, with the first names; of a hostile source at most so many reasons."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._names: dict[str, list[str]] = {}

    def add(self, skip: Skip | None) -> None:
        if skip is None:
            return
        reason = skip.reason if skip.reason in self.counts or len(self.counts) < _MAX_REASONS else "another reason"
        self.counts[reason] += 1
        if len(names := self._names.setdefault(reason, [])) < _EXAMPLES:
            names.append(skip.name)

    def notes(self) -> list[str]:
        return [f"skipped {n}: {reason}, such as {', '.join(self._names[reason])}" for reason, n in self.counts.items()]


# Splits ----------------------------------------------------------------------------------------------------

_Splits = Mapping[str, Mapping[str, Sequence[str]]]


def _split_disjoint(splits: _Splits) -> tuple[_Splits, list[str]]:
    """Those that part objects, and a sentence on each of the others: it judges no unseen object."""
    kept, refused = {}, []
    for name, parts in splits.items():
        counts = Counter(object_id for part in parts.values() for object_id in set(part))
        if shared := sum(count > 1 for count in counts.values()):
            refused.append(
                f"the published split {name!r} has grasps of {shared} object(s) on two sides, so that it judges no "
                "unseen object; it is not kept, draw one by objects"
            )
        else:
            kept[name] = parts
    return kept, refused


def _write_splits(out: Path, splits: _Splits) -> None:
    if not splits:
        return
    folder = out / SPLITS_FOLDER
    with storage_errors(folder):
        folder.mkdir(exist_ok=True)
        for name, parts in splits.items():
            split = {"seed": 0, **{part: sorted(parts.get(part, ())) for part in ("train", "validation", "test")}}
            write_atomically(folder / f"{name}.json", json.dumps(split, indent=1).encode() + b"\n")


# What importers need of their source -----------------------------------------------------------------------


def safe_name(*parts: str) -> str:
    """The parts as a grasp_id, joined by "-"; where that is none, what differs is told by a digest at the end.

    >>> safe_name("mug", "01"), safe_name("my mug", "01")
    ('mug-01', 'my-mug-01-b68d33c2')
    """
    joined = "-".join(parts)
    if GRASP_ID.fullmatch(joined):
        return joined
    plain = re.sub(r"[^A-Za-z0-9._-]", "-", joined)[:100].lstrip("._-") or "grasp"
    # Names of unknown coding and what JSON escapes may hold what UTF-8 cannot.
    return f"{plain}-{sha256('/'.join(parts).encode(errors='surrogatepass')).hexdigest()[:8]}"


@dataclass(frozen=True)
class NumberedFiles:
    """Files of a folder whose names fit a pattern, in the order of their numbers. Only their names are in memory."""

    folder: Path
    pattern: re.Pattern[str]
    names: Sequence[str]

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[tuple[re.Match[str], Path]]:
        for name in self.names:
            match = self.pattern.fullmatch(name)
            assert match is not None
            yield match, self.folder / name


def numbered_files(folder: Path, pattern: re.Pattern[str]) -> NumberedFiles:
    """The files of a folder whose names fit, sorted by their numbers as numbers; none where there is no folder."""
    names = os.listdir(folder) if folder.is_dir() else []
    return NumberedFiles(folder, pattern, sorted(filter(pattern.fullmatch, names), key=natural_sort_key))


def subfolders(parent: Path) -> list[Path]:
    """The folders in `parent`, hidden ones left out, sorted by their numbers as numbers. Raises ImporterError."""
    try:
        return sorted(
            (path for path in parent.iterdir() if path.is_dir() and not path.name.startswith(".")),
            key=lambda path: natural_sort_key(path.name),
        )
    except OSError as error:
        raise ImporterError(f"{parent} cannot be read: {error.strerror}") from error


def natural_sort_key(name: str) -> str:
    """A key by which digits compare as numbers, after all text: the number of their digits goes before them."""
    key = _DIGITS.sub(lambda digits: f"\0{len(number := str(int(digits[0]))):04}{number}", name)
    return f"{key}\0{name}"


def import_extra(name: str, what: str) -> Any:
    """A package of the extra `importers`. Raises ImporterError where it is missing."""
    try:
        return import_module(name)
    except ImportError as error:
        raise ImporterError(
            f"{what} needs {name}, which is missing; run pip install 'touch-retrieval[importers]'"
        ) from error


def video_stream(film: Any) -> Any:
    """Return the video stream of a film that PyAV opened. Raises ImporterError for too many pixels."""
    stream = film.streams.video[0]
    if stream.codec_context.width * stream.codec_context.height > _MAX_VIDEO_PIXELS:
        raise ImporterError(f"its video has more than {_MAX_VIDEO_PIXELS} pixels")
    return stream
