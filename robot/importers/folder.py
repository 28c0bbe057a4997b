"""Pictures of your own, found by patterns.

    <object>/touch_*.png     by the pattern `touch`
    <object>/photo_*.jpg     by the pattern `photo`

A pattern is a path with words in braces. `{object}` is the name of the object, `{session}` that of a sitting, such as a
day, and `{sequence}` that of grasps which a split must keep together. `{finger}` is the name of a finger; use it if a
touch has one picture per finger. All other words, and the text that each `*` matches, distinguish the grasps of an
object. So by default `touch_0_a.png` and `touch_0_b.png` are two grasps; with `touch={object}/touch_{n}_{finger}` they
are the two fingers of one grasp. A word or `*` never matches a "/". The suffix of the file name is optional; BMP, TIFF
and WebP are stored as PNG, and HEIC and AVIF are named as left out. Words that occur in two patterns must have the same
value: with `touch={object}/{n}_{finger}` and `photo={object}/{n}_photo` each touch gets the photo with its number. If
several photos match, the first touch gets the first photo, the second touch the second photo, and so on, cyclically.
With `photo=` there are touches only. `background` is a pattern for the no-contact frames: `rest_{finger}.png` for one
per finger, `{object}/rest.png` for one per object. Grasps are in the order of the files' names.
"""

import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from string import ascii_lowercase
from typing import NoReturn

from _touch_retrieval.names import is_system_name
from robot.errors import ImporterError
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    Item,
    Progress,
    Skip,
    import_items,
    natural_sort_key,
)
from robot.recording.folder import Recording, SharedImage, safe_name

DATA_SET = DataSet(
    source="your own pictures",
    licence="set by you",
    citation="set by you",
    sensor="set by you",
    rig="unknown",
    expects="`<object>/touch_*.png` and `<object>/photo_*.jpg`, or files that match the patterns",
    fingers=0,
)
_ENDINGS = (".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".bmp", ".tif", ".tiff", ".webp", ".heic", ".heif", ".avif")
_WORD = re.compile(r"(\{\w+\}|\*)")

Words = Mapping[str, str]


def import_folder(
    src: Path,
    out: Path,
    progress: Progress | None = None,
    *,
    touch: str = "{object}/touch_*",
    photo: str = "{object}/photo_*",
    background: str = "",
    sensor: str = "unknown",
    licence: str = NOT_STATED,
) -> Recording:
    """Import pictures below `src`.

    Raises:
        ImporterError: A pattern is invalid, or no picture matches.
    """
    if not src.is_dir():
        raise ImporterError(f"{src} must be a folder of pictures")
    matches = _PatternMatches(src, touch, photo, background)
    data_set = replace(
        DATA_SET,
        sensor=sensor,
        licence=licence,
        fingers=len(matches.fingers),
        background="as in the pictures" if matches.has_background else "none",
    )
    return import_items(
        data_set,
        matches.items(),
        out,
        total=matches.total,
        progress=progress,
        source=src,
        options={"touch": touch, "photo": photo, "background": background, "sensor": sensor, "licence": licence},
    )


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
        match = self._expression.fullmatch(os.path.splitext(path)[0]) or self._expression.fullmatch(path)
        return match.groupdict() if match else None


class _PatternMatches:
    """The grasps that the patterns match. The names of all files are in memory, their content is not."""

    def __init__(self, src: Path, touch: str, photo: str, background: str) -> None:
        self.src = src
        self._touch, photo_pattern = _Pattern("touch", touch), _Pattern("photo", photo)
        for option, pattern in (("touch", self._touch), ("photo", photo_pattern)):
            if "object" not in pattern.words and (option == "touch" or photo):
                raise ImporterError(f"the pattern {option} must contain {{object}}, such as {{object}}/touch_*")
        files = _pictures(src)
        touches = [(path, words) for path in files if (words := self._touch.match(path))]
        if both := next((path for path, _ in touches if photo_pattern.match(path)), None):
            raise ImporterError(f"{both} matches both patterns; change touch or photo so that only one matches")
        self._photos = _MatchingFiles(photo_pattern, self._touch, files if photo else ())
        self._frames = _MatchingFiles(_Pattern("background", background), self._touch, files if background else ())
        self.has_background = bool(self._frames.files)
        for option, text, matches in (("touch", touch, touches), ("photo", photo, self._photos.files)):
            if text and not matches:
                content = f"only others, such as {files[0]}" if files else "no picture at all"
                raise ImporterError(
                    f"{src} must contain a {option} that matches {text!r}, but contains {content}; "
                    "change the pattern with --option; photo= is for touches without photos"
                )
        names = sorted({words.get("finger", "") for _, words in touches}, key=natural_sort_key)
        self.fingers = dict(zip(names, ascii_lowercase, strict=False))
        self._repeated: list[str] = []
        # The words without finger -> finger -> path.
        self._grasps: dict[tuple[str, ...], dict[str, str]] = defaultdict(dict)
        for path, words in touches:
            others = (value for key, value in words.items() if key not in ("object", "finger"))
            grasp = self._grasps[words["object"], *others]
            if grasp.setdefault(words.get("finger", ""), path) != path:
                self._repeated.append(path)
        self.total = len(self._grasps) + len(self._repeated)

    def items(self) -> Iterator[Item | Skip]:
        """Yield the grasps, and a `Skip` for each unusable touch."""
        assigned: Counter[tuple[str, ...]] = Counter()
        yield from (Skip("another picture of the same grasp and finger was found", path) for path in self._repeated)
        for key, paths in self._grasps.items():
            name, words = safe_name(*key), self._touch.match(next(iter(paths.values()))) or {}
            photos, group = self._photos.of(words), self._photos.key(words)
            if len(paths) < len(self.fingers):
                yield Skip("a finger has no picture", name)
            elif self._photos.files and not photos:
                yield Skip("no photo matches it", name)
            else:
                images: dict[str, Path | SharedImage] = {}
                if photos:
                    images["photo"] = self._shared(photos[assigned[group] % len(photos)])
                assigned[group] += 1
                for finger, letter in self.fingers.items():
                    images[f"touch_{letter}"] = self.src / paths[finger]
                    if before := self._frames.of(self._touch.match(paths[finger]) or {}):
                        images[f"touch_{letter}_before"] = self._shared(before[0])
                fields = {"sequence_id": words.get("sequence"), "session": words.get("session")}
                yield Item(name, key[0], images, fields)

    def _shared(self, path: str) -> SharedImage:
        return SharedImage(sha256(path.encode(errors="surrogateescape")).hexdigest()[:24], self.src / path)


class _MatchingFiles:
    """The files that match a pattern, grouped by the words that it has in common with the pattern of the touches."""

    def __init__(self, pattern: _Pattern, others: _Pattern, files: Iterable[str]) -> None:
        self._words = sorted(pattern.words & others.words)
        self.files: dict[tuple[str, ...], list[str]] = defaultdict(list)
        for path in files:
            if words := pattern.match(path):
                self.files[self.key(words)].append(path)

    def key(self, words: Words) -> tuple[str, ...]:
        """Return the values of the common words."""
        return tuple(words[name] for name in self._words)

    def of(self, words: Words) -> list[str]:
        """Return the files that match a touch."""
        return self.files.get(self.key(words), [])


def _pictures(src: Path) -> list[str]:
    """Return the pictures below a folder as relative paths, without those of systems, in natural order."""

    def fail(error: OSError) -> NoReturn:  # else an object would be missing without a message
        raise ImporterError(f"{error.filename} cannot be listed: {error.strerror}") from error

    files = (Path(folder, name) for folder, _, names in os.walk(src, onerror=fail) for name in names)
    paths = (path.relative_to(src) for path in files if path.suffix.lower() in _ENDINGS)
    shown = [path.as_posix() for path in paths if not any(map(is_system_name, path.parts))]
    return sorted(shown, key=natural_sort_key)
