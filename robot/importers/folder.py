"""Pictures of your own, found by patterns or listed in a CSV or JSONL file.

    <object>/touch_*.png     by the pattern `touch`
    <object>/photo_*.jpg     by the pattern `photo`

A pattern is a path with words in braces. `{object}` is the name of the object, `{sequence}` the name of a session.
`{finger}` is the name of a finger; use it if a touch has one picture per finger. All other words, and the text that
each `*` matches, distinguish the grasps of an object. So by default `touch_0_a.png` and `touch_0_b.png` are two grasps;
with `touch={object}/touch_{n}_{finger}` they are the two fingers of one grasp. A word or `*` never matches a "/". The
suffix of the file name is optional. Words that occur in two patterns must have the same value: with
`touch={object}/{n}_{finger}` and `photo={object}/{n}_photo` each touch gets the photo with its number. If several
photos match, the first touch gets the first photo, the second touch the second photo, and so on, cyclically.
`background` is a pattern for the no-contact frames: `rest_{finger}.png` for one per finger, `{object}/rest.png` for one
per object. Links to other folders are followed.

Instead of patterns, `pairs` names a file below the folder: CSV with a header, or JSONL. Each line is a grasp with
`object`, `photo` and `touch` (or `touch_a`, `touch_b`), and optionally `background` (or `touch_a_before`, ...),
`sequence`, `force_n`, `opening_mm` and `time_s`. Paths are relative to the folder. The file is read line by line.
"""

import csv
import os
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from hashlib import sha256
from pathlib import Path, PurePosixPath
from string import ascii_lowercase
from typing import Any, NoReturn

from robot.errors import ImporterError, RecordingError
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    Images,
    Item,
    Progress,
    Skip,
    import_items,
    natural_sort_key,
    safe_name,
)
from robot.recording.folder import Recording, SharedImage
from robot.storage import parse_object

DATA_SET = DataSet(
    source="your own pictures",
    licence="set by you",
    citation="set by you",
    sensor="set by you",
    rig="unknown",
    expects="`<object>/touch_*.png` and `<object>/photo_*.jpg`, or files that match the patterns, or a file of pairs",
    fingers=0,
)
_ENDINGS = (".png", ".jpg", ".jpeg")
_WORD = re.compile(r"(\{\w+\}|\*)")
_COLUMNS = {"object": "object_id", "touch": "touch_a", "background": "touch_a_before", "sequence": "sequence_id"}
_NUMBERS = ("force_n", "opening_mm", "time_s")
_TOUCH = re.compile("touch_[a-z]")
_LINE = 1 << 20
"""Maximum characters of a line in a file of pairs; a longer line is split, and each part is read as a line."""

Words = Mapping[str, str]


def import_folder(
    src: Path,
    out: Path,
    progress: Progress | None = None,
    *,
    touch: str = "{object}/touch_*",
    photo: str = "{object}/photo_*",
    background: str = "",
    pairs: str = "",
    sensor: str = "unknown",
    licence: str = NOT_STATED,
) -> Recording:
    """Import pictures below `src`.

    Args:
        src: Folder with the pictures.
        out: Recording folder to write or continue.
        progress: Called with (done, total) after each grasp.
        touch: Pattern of the gel images.
        photo: Pattern of the photos.
        background: Pattern of the no-contact frames; empty if there are none.
        pairs: File of pairs, relative to `src`, instead of the patterns.
        sensor: Name of the sensor.
        licence: Licence of the pictures.

    Raises:
        ImporterError: A pattern is invalid, or no picture matches.
    """
    src = Path(src)
    if not src.is_dir():
        raise ImporterError(f"{src} must be a folder of pictures")
    matches: _PairsFile | _PatternMatches = (
        _PairsFile(src, pairs) if pairs else _PatternMatches(src, touch, photo, background)
    )
    data_set = replace(
        DATA_SET,
        sensor=sensor,
        licence=licence,
        fingers=len(matches.fingers),
        background="as in the pictures" if matches.has_background else "none",
    )
    return import_items(data_set, matches.items(), out, total=matches.total, progress=progress)


# By patterns -----------------------------------------------------------------------------------------------


class _Pattern:
    """A path with words in braces."""

    def __init__(self, option: str, text: str) -> None:
        parts: list[str] = []
        words: set[str] = set()
        for number, part in enumerate(_WORD.split(text)):
            word = part.strip("{}")
            if number % 2 == 0:
                if "{" in part or "}" in part:
                    raise ImporterError(f"braces in the pattern {option} must contain one word each, got {text!r}")
                parts.append(re.escape(part))
            elif part == "*":
                parts.append(f"(?P<_{number}>[^/]*?)")
            elif not word.isidentifier() or word.startswith("_"):
                raise ImporterError(f"a word in braces in the pattern {option} must consist of letters, got {part}")
            elif word in words:
                parts.append(f"(?P={word})")
            else:
                words.add(word)
                parts.append(f"(?P<{word}>[^/]+{'' if word == 'object' else '?'})")
        self.words = frozenset(words)
        self._expression = re.compile("".join(parts))

    def match(self, path: str) -> Words | None:
        """Return the words of a path that matches, with or without its suffix; the words of `*` are _1, _3, ..."""
        found = self._expression.fullmatch(os.path.splitext(path)[0]) or self._expression.fullmatch(path)
        return found.groupdict() if found else None


class _PatternMatches:
    """The grasps that the patterns match. The names of all files are in memory, their content is not."""

    def __init__(self, src: Path, touch: str, photo: str, background: str) -> None:
        self.src = src
        self._touch, self._photo = _Pattern("touch", touch), _Pattern("photo", photo)
        self._background = _Pattern("background", background) if background else None
        for option, pattern in (("touch", self._touch), ("photo", self._photo)):
            if "object" not in pattern.words:
                raise ImporterError(f"the pattern {option} must contain {{object}}, such as {{object}}/touch_*")
        self._photos = _MatchingFiles(self._photo, self._touch)
        self._frames = _MatchingFiles(self._background, self._touch)
        example, has_touch, names = "", False, set[str]()
        for path in _pictures(src):
            example = example or path
            words, photo_words = self._touch.match(path), self._photo.match(path)
            if words and photo_words:
                raise ImporterError(f"{path} matches both patterns; change touch or photo so that only one matches")
            if words:
                has_touch = True
                names.add(words.get("finger", ""))
            self._photos.add(path)
            self._frames.add(path)
        for option, text, is_found in (("touch", touch, has_touch), ("photo", photo, bool(self._photos))):
            if not is_found:
                content = f"only others, such as {example}" if example else "no picture at all"
                raise ImporterError(
                    f"{src} must contain a {option} that matches {text!r}, but contains {content}; "
                    "change the pattern with --option"
                )
        if len(names) > len(ascii_lowercase):
            first = sorted(names, key=natural_sort_key)[:3]
            raise ImporterError(f"{{finger}} must match at most 26 fingers, got {len(names)}, such as {first}")
        self.fingers = dict(zip(sorted(names, key=natural_sort_key), ascii_lowercase, strict=False))
        self.has_background = bool(self._frames)
        self._repeated: list[str] = []
        self._grasps = self._group_by_words()

    def _group_by_words(self) -> dict[tuple[str, ...], list[str]]:
        """Return a dictionary: words without the finger -> path of each finger's picture ("" if it is missing)."""
        grasps: dict[tuple[str, ...], list[str]] = {}
        position = {finger: number for number, finger in enumerate(self.fingers)}
        for path in _pictures(self.src):
            if (words := self._touch.match(path)) and words.get("finger", "") in position:
                others = (value for key, value in words.items() if key not in ("object", "finger"))
                paths = grasps.setdefault((sys.intern(words["object"]), *others), [""] * len(position))
                if paths[position[words.get("finger", "")]]:
                    self._repeated.append(path)
                else:
                    paths[position[words.get("finger", "")]] = path
        return grasps

    @property
    def total(self) -> int:
        """Number of items."""
        return len(self._grasps) + len(self._repeated)

    def items(self) -> Iterator[Item | Skip]:
        """Yield the grasps, and a `Skip` for each unusable touch."""
        assigned: Counter[tuple[str, ...]] = Counter()
        yield from (Skip("another picture of the same grasp and finger was found", path) for path in self._repeated)
        for key, paths in self._grasps.items():
            name, words = safe_name(*key), self._touch.match(next(filter(None, paths))) or {}
            photos, group = self._photos.of(words)
            if not all(paths):
                yield Skip("a finger has no picture", name)
            elif not photos:
                yield Skip("no photo matches it", name)
            else:
                photo = photos[assigned[group] % len(photos)]
                assigned[group] += 1
                images: Images = {"photo": _shared(self.src, photo)}
                for letter, path in zip(self.fingers.values(), paths, strict=True):
                    column = f"touch_{letter}"
                    before = self._frames.of(self._touch.match(path) or {})[0]
                    images = {**images, column: self.src / path}
                    if before:
                        images[f"{column}_before"] = _shared(self.src, before[0])
                yield Item(name, key[0], images, {"sequence_id": words.get("sequence")})


class _MatchingFiles:
    """The files that match a pattern, grouped by the words that it has in common with the pattern of the touches."""

    def __init__(self, pattern: _Pattern | None, others: _Pattern) -> None:
        self._pattern = pattern
        self._words = sorted(pattern.words & others.words) if pattern else []
        self._files: dict[tuple[str, ...], list[str]] = defaultdict(list)

    def add(self, path: str) -> None:
        """Add a file if it matches the pattern."""
        if self._pattern and (words := self._pattern.match(path)):
            self._files[self._key(words)].append(path)

    def __bool__(self) -> bool:
        return bool(self._files)

    def of(self, words: Words) -> tuple[list[str], tuple[str, ...]]:
        """Return the files that match a touch, and the values of their common words."""
        key = self._key(words)
        return self._files.get(key, []), key

    def _key(self, words: Words) -> tuple[str, ...]:
        return tuple(words[name] for name in self._words)


def _pictures(src: Path) -> Iterator[str]:
    """Yield the pictures below a folder as relative paths, without hidden ones, in natural order.

    A link to a folder outside `src` is followed; each target is followed only once.
    """
    root, followed = Path(os.path.realpath(src)), set[Path]()

    def is_walked(path: str) -> bool:
        if not os.path.islink(path):
            return True
        target = Path(os.path.realpath(path))
        if target in followed or target.is_relative_to(root) or root.is_relative_to(target):
            return False
        followed.add(target)
        return True

    for folder, below, files in os.walk(src, onerror=_raise_unlistable, followlinks=True):
        shown = sorted((name for name in below if not name.startswith(".")), key=natural_sort_key)
        below[:] = [name for name in shown if is_walked(os.path.join(folder, name))]
        for name in sorted(files, key=natural_sort_key):
            if name.lower().endswith(_ENDINGS) and not name.startswith("."):
                yield (Path(folder) / name).relative_to(src).as_posix()


def _raise_unlistable(error: OSError) -> NoReturn:
    """Raise an error for a folder that cannot be listed, so that no object is missing without a message."""
    raise ImporterError(f"{error.filename} cannot be listed: {error.strerror}") from error


def _shared(src: Path, path: str) -> SharedImage:
    return SharedImage(f"{sha256(path.encode(errors='surrogateescape')).hexdigest()[:24]}", src / path)


# By a file of pairs ----------------------------------------------------------------------------------------


class _PairsFile:
    """The grasps in a file of pairs, read line by line."""

    def __init__(self, src: Path, pairs: str) -> None:
        self.src, self._file = src, src / pairs
        if not os.path.isfile(self._file):
            raise ImporterError(f"{self._file} must be a CSV or JSONL file of pairs, but does not exist")
        first = next((row for row in self._rows() if isinstance(row, dict)), None)
        if first is None or not (self._fingers(first) and {"object_id", "photo"} <= first.keys()):
            raise ImporterError(
                f"{self._file} must contain object, photo and touch (or touch_a, touch_b, ...) in each line"
            )
        self.fingers = self._fingers(first)
        self.has_background = any(column.endswith("_before") for column in first)
        self.total = sum(1 for _ in self._rows())

    def items(self) -> Iterator[Item | Skip]:
        """Yield a grasp for each line, and a `Skip` for each unusable one."""
        for number, row in enumerate(self._rows(), start=1):
            if isinstance(row, str):
                yield Skip(row, f"number {number}")
                continue
            name = safe_name(row.get("object_id") or "", str(number))
            columns = ("photo", *self.fingers, *(f"{finger}_before" for finger in self.fingers))
            paths = {column: row[column] for column in columns if row.get(column)}
            if self._fingers(row) != self.fingers or not paths.get("photo") or not row.get("object_id"):
                yield Skip("its line lacks the object, the photo or a touch", name)
            elif any(not _is_inside(path) for path in paths.values()):
                yield Skip("a path must be relative to the folder and lead to a file below it", name)
            elif (numbers := _numbers(row)) is None:
                yield Skip(f"{', '.join(_NUMBERS)} must be numbers", name)
            else:
                images: Images = {
                    column: self.src / path if column in self.fingers else _shared(self.src, path)
                    for column, path in paths.items()
                }
                yield Item(name, row["object_id"], images, {"sequence_id": row.get("sequence_id") or None, **numbers})

    def _fingers(self, row: Mapping[str, Any]) -> list[str]:
        return sorted(column for column in row if _TOUCH.fullmatch(column) and row[column])

    def _rows(self) -> Iterator[dict[str, Any] | str]:
        """Yield rows by column name, or the reason why a row is unusable."""
        try:
            with open(self._file, encoding="utf-8-sig", newline="") as file:
                lines = iter(lambda: file.readline(_LINE), "")
                rows = csv.DictReader(lines) if self._file.suffix.lower() == ".csv" else _documents(lines)
                for row in rows:
                    yield row if isinstance(row, str) else _rename_columns(row)
        except (csv.Error, UnicodeDecodeError) as error:
            raise ImporterError(f"{self._file} must be CSV with a header, or JSONL, in UTF-8: {error}") from error


def _documents(lines: Iterator[str]) -> Iterator[dict[str, Any] | str]:
    for line in lines:
        if line.strip():
            try:
                yield parse_object(line.encode(), RecordingError)
            except RecordingError:
                yield "its line is not a JSON object"


def _rename_columns(row: Mapping[Any, Any]) -> dict[str, Any]:
    """Rename columns as in a recording. Values other than text and numbers are treated as missing."""
    plain = {str(key).removesuffix("_file_name"): value for key, value in row.items() if key is not None}
    return {
        _COLUMNS.get(key, key): value
        for key, value in plain.items()
        if isinstance(value, str | int | float) and (key in _NUMBERS or isinstance(value, str))
    }


def _is_inside(path: str) -> bool:
    parts = PurePosixPath(path).parts
    return bool(parts) and ".." not in parts and not path.startswith("/") and "\\" not in path and path.isprintable()


def _numbers(row: Mapping[str, Any]) -> dict[str, float] | None:
    try:
        return {name: float(row[name]) for name in _NUMBERS if row.get(name) not in (None, "")}
    except (ValueError, OverflowError):
        return None
