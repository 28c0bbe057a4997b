"""Pictures of your own, found by patterns or listed in a CSV or JSONL file.

    <object>/touch_*.png     by the pattern `touch`
    <object>/photo_*.jpg     by the pattern `photo`

In a pattern `{object}` stands for the name of the object, `{finger}` for that of a finger where a touch has several
pictures, `{sequence}` for grasps of one sitting, any other word in braces for what tells grasps apart, and `*` for
what does not matter; none of them crosses a "/". A pattern need not name the ending. Words that two patterns share
must agree: with `touch={object}/{n}_{finger}` and `photo={object}/{n}_photo` each touch has the photo of its own
number. Where an object has several photos that agree, its touches are dealt to them in turn. `background`, a pattern
too, finds the no-contact frames: `rest_{finger}.png` one a finger, `{object}/rest.png` one an object. Links to
folders elsewhere are followed.

`pairs` names a file below the folder instead: CSV with a header, or JSONL, a grasp a line, with `object`, `photo` and
`touch` (or `touch_a`, `touch_b`), and where they are known `background` (or `touch_a_before`, ...), `sequence`,
`force_n`, `opening_mm`, `time_s`. Paths are relative to the folder. It is read line by line.
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
from robot.importers.importing import DataSet, Images, Item, Progress, Skip, import_items, natural_sort_key, safe_name
from robot.recording.folder import Recording, SharedImage
from robot.storage import parse_object

DATA_SET = DataSet(
    source="pictures of one's own",
    licence="yours to say",
    citation="yours to say",
    sensor="yours to say",
    rig="unknown",
    expects="`<object>/touch_*.png`, `<object>/photo_*.jpg`, or what the patterns say, or a file of pairs",
    fingers=0,
)
_ENDINGS = (".png", ".jpg", ".jpeg")
_WORD = re.compile(r"(\{\w+\}|\*)")
_COLUMNS = {"object": "object_id", "touch": "touch_a", "background": "touch_a_before", "sequence": "sequence_id"}
_NUMBERS = ("force_n", "opening_mm", "time_s")
_TOUCH = re.compile("touch_[a-z]")
_LINE = 1 << 20
"""Characters of a line of a file of pairs; a longer one is broken off."""

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
    licence: str = "not stated",
) -> Recording:
    """Import pictures below `src`. Raises ImporterError for a wrong pattern, and where none fits."""
    src = Path(src)
    if not src.is_dir():
        raise ImporterError(f"{src} must be a folder of pictures, and is none")
    found: _PairsFile | _PatternMatches = (
        _PairsFile(src, pairs) if pairs else _PatternMatches(src, touch, photo, background)
    )
    facts = replace(
        DATA_SET,
        sensor=sensor,
        licence=licence,
        fingers=len(found.fingers),
        background="as the pictures say" if found.has_background else "none",
    )
    return import_items(facts, found.items(), out, total=found.total, progress=progress)


# By patterns -----------------------------------------------------------------------------------------------


class _Pattern:
    """A path with words in braces. Raises ImporterError for one that is none."""

    def __init__(self, option: str, text: str) -> None:
        parts: list[str] = []
        seen: set[str] = set()
        for number, part in enumerate(_WORD.split(text)):
            word = part.strip("{}")
            if number % 2 == 0:
                if "{" in part or "}" in part:
                    raise ImporterError(f"braces in the pattern {option} must hold one word each, got {text!r}")
                parts.append(re.escape(part))
            elif part == "*":
                parts.append(f"(?P<_{number}>[^/]*?)")
            elif not word.isidentifier() or word.startswith("_"):
                raise ImporterError(f"a word in the braces of the pattern {option} must be letters, got {part}")
            elif word in seen:
                parts.append(f"(?P={word})")
            else:
                seen.add(word)
                parts.append(f"(?P<{word}>[^/]+{'' if word == 'object' else '?'})")
        self.words = frozenset(seen)
        self._expression = re.compile("".join(parts))

    def fit(self, path: str) -> Words | None:
        """The words of a path that fits, with its ending or without; nameless ones are called _1, _3, ..."""
        found = self._expression.fullmatch(os.path.splitext(path)[0]) or self._expression.fullmatch(path)
        return found.groupdict() if found else None


class _PatternMatches:
    """What the patterns find. The names of all files are held in memory, their pictures are not."""

    def __init__(self, src: Path, touch: str, photo: str, background: str) -> None:
        self.src = src
        self._touch, self._photo = _Pattern("touch", touch), _Pattern("photo", photo)
        self._background = _Pattern("background", background) if background else None
        for option, pattern in (("touch", self._touch), ("photo", self._photo)):
            if "object" not in pattern.words:
                raise ImporterError(
                    f"the pattern {option} must say where {{object}} stands, such as {{object}}/touch_*"
                )
        self._photos = _MatchingFiles(self._photo, self._touch)
        self._frames = _MatchingFiles(self._background, self._touch)
        some, touched, names = "", False, set[str]()
        for path in _pictures(src):
            some = some or path
            words, seen = self._touch.fit(path), self._photo.fit(path)
            if words and seen:
                raise ImporterError(f"{path} fits both patterns; make touch and photo tell them apart")
            if words:
                touched = True
                names.add(words.get("finger", ""))
            self._photos.add(path)
            self._frames.add(path)
        for option, text, fits in (("touch", touch, touched), ("photo", photo, bool(self._photos))):
            if not fits:
                there = f"such as {some}" if some else "and no picture at all"
                raise ImporterError(
                    f"{src} must hold a {option} that fits {text!r}, and holds none, {there}; see --option"
                )
        if len(names) > len(ascii_lowercase):
            first = sorted(names, key=natural_sort_key)[:3]
            raise ImporterError(f"{{finger}} must name at most 26 fingers, got {len(names)}, such as {first}")
        self.fingers = dict(zip(sorted(names, key=natural_sort_key), ascii_lowercase, strict=False))
        self.has_background = bool(self._frames)
        self._repeated: list[str] = []
        self._grasps = self._group_by_words()

    def _group_by_words(self) -> dict[tuple[str, ...], list[str]]:
        """Grasps by their words but the finger's: the path of each finger's picture, empty where it has none."""
        grasps: dict[tuple[str, ...], list[str]] = {}
        place = {finger: number for number, finger in enumerate(self.fingers)}
        for path in _pictures(self.src):
            if (words := self._touch.fit(path)) and words.get("finger", "") in place:
                others = (value for key, value in words.items() if key not in ("object", "finger"))
                paths = grasps.setdefault((sys.intern(words["object"]), *others), [""] * len(place))
                if paths[place[words.get("finger", "")]]:
                    self._repeated.append(path)
                else:
                    paths[place[words.get("finger", "")]] = path
        return grasps

    @property
    def total(self) -> int:
        return len(self._grasps) + len(self._repeated)

    def items(self) -> Iterator[Item | Skip]:
        dealt: Counter[tuple[str, ...]] = Counter()
        yield from (Skip("another touch has the same words in its path", path) for path in self._repeated)
        for key, paths in self._grasps.items():
            name, words = safe_name(*key), self._touch.fit(next(filter(None, paths))) or {}
            choice, which = self._photos.of(words)
            if not all(paths):
                yield Skip("a finger has no picture", name)
            elif not choice:
                yield Skip("no photo agrees with it", name)
            else:
                photo = choice[dealt[which] % len(choice)]
                dealt[which] += 1
                images: Images = {"photo": _shared(self.src, photo)}
                for letter, path in zip(self.fingers.values(), paths, strict=True):
                    column = f"touch_{letter}"
                    before = self._frames.of(self._touch.fit(path) or {})[0]
                    images = {**images, column: self.src / path}
                    if before:
                        images[f"{column}_before"] = _shared(self.src, before[0])
                yield Item(name, key[0], images, {"sequence_id": words.get("sequence")})


class _MatchingFiles:
    """Files by the words that their pattern shares with that of the touches."""

    def __init__(self, pattern: _Pattern | None, others: _Pattern) -> None:
        self._pattern = pattern
        self._words = sorted(pattern.words & others.words) if pattern else []
        self._files: dict[tuple[str, ...], list[str]] = defaultdict(list)

    def add(self, path: str) -> None:
        """Take a file, where it fits the pattern."""
        if self._pattern and (words := self._pattern.fit(path)):
            self._files[self._key(words)].append(path)

    def __bool__(self) -> bool:
        return bool(self._files)

    def of(self, words: Words) -> tuple[list[str], tuple[str, ...]]:
        """The files that agree with a touch, and the words by which."""
        key = self._key(words)
        return self._files.get(key, []), key

    def _key(self, words: Words) -> tuple[str, ...]:
        return tuple(words[name] for name in self._words)


def _pictures(src: Path) -> Iterator[str]:
    """The pictures below a folder, by path from it, hidden ones left out, in the order of their numbers. A link to a
    folder is followed where it leads out of `src`, and each target once. Raises ImporterError.
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
    """A folder that cannot be listed would be an object that is silently missing."""
    raise ImporterError(f"{error.filename} cannot be listed: {error.strerror}") from error


def _shared(src: Path, path: str) -> SharedImage:
    return SharedImage(f"{sha256(path.encode(errors='surrogateescape')).hexdigest()[:24]}", src / path)


# By a file of pairs ----------------------------------------------------------------------------------------


class _PairsFile:
    """What a file of pairs lists, read line by line."""

    def __init__(self, src: Path, pairs: str) -> None:
        self.src, self._file = src, src / pairs
        if not os.path.isfile(self._file):
            raise ImporterError(f"{self._file} must be a CSV or JSONL file of pairs, and is not there")
        first = next((row for row in self._rows() if isinstance(row, dict)), None)
        if first is None or not (self._fingers(first) and {"object_id", "photo"} <= first.keys()):
            raise ImporterError(
                f"{self._file} must name object, photo and touch (or touch_a, touch_b, ...) in each line"
            )
        self.fingers = self._fingers(first)
        self.has_background = any(column.endswith("_before") for column in first)
        self.total = sum(1 for _ in self._rows())

    def items(self) -> Iterator[Item | Skip]:
        for number, row in enumerate(self._rows(), start=1):
            if isinstance(row, str):
                yield Skip(row, f"number {number}")
                continue
            name = safe_name(row.get("object_id") or "", str(number))
            columns = ("photo", *self.fingers, *(f"{each}_before" for each in self.fingers))
            paths = {column: row[column] for column in columns if row.get(column)}
            if self._fingers(row) != self.fingers or not paths.get("photo") or not row.get("object_id"):
                yield Skip("its line lacks its object, its photo or a touch", name)
            elif any(not _is_inside(path) for path in paths.values()):
                yield Skip("a path must lead to a file below the folder, from there on", name)
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
        """Rows by column name, or why one cannot be had."""
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
    """Columns by the recording's names; values that are no plain text or number count as absent."""
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
