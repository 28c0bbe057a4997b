"""Derive the object of a photo from its path in the catalogue: the rule of `build-index --objects-from`.

    folder     the first folder, also for photos in its subfolders; without a folder, the name of the file
    stem       the file's name without extension and without a number at the end, in any folder:
               mug_0.jpg, mug-12.jpg and "mug (3).jpg" show mug
    PATTERN    a path in which {object} stands for the name, and any other word in braces for an ignored part:
               {split}/{object}/{photo}, or {object}_{view}.jpg

A pattern must match the photo's whole path, first without its extension, then with it (JPG or jpg). A word in braces
matches one character or more, but no "/"; {object} matches as many as possible, the others as few as possible. A
second {object} matches the same text as the first.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import PurePosixPath

from _touch_retrieval.names import same_object_key
from retrieval.console.output import abbreviate_list
from retrieval.errors import BadInput

FOLDER, STEM = "folder", "stem"
OBJECT = "object"
NOT_OBJECTS = frozenset(
    {"catalog", "catalogue", "data", "dataset", "dev", "gallery", "image", "images", "img", "imgs", "jpeg", "jpg"}
    | {"object", "objects", "photo", "photos", "pic", "pics", "picture", "pictures", "png", "raw", "rgb"}
    | {"test", "testing", "train", "training", "val", "valid", "validation"}
)
"""Names that data sets give to folders of many objects."""

_FIELD = re.compile(r"\{(\w+)\}")
_ESCAPED_FIELD = re.compile(r"\\\{(\w+)\\\}")  # as re.escape writes it
_NUMBER = re.compile(r"[\s._#-]*\(?\d+\)?$")
_LAST_WORD = re.compile(r"(.*\w)[\s._-]+([^\W\d_]+)")
MAX_EXAMPLES = 3


@dataclass(frozen=True)
class Naming:
    """The naming rule `text`: folder, stem, or a pattern.

    Raises:
        BadInput: A pattern has no {object}, has braces without a word, or has two words without text between them.
    """

    text: str = FOLDER

    def __post_init__(self) -> None:
        if self.text in (FOLDER, STEM):
            return
        words, example = _FIELD.findall(self.text), "such as {split}/{object}/{photo}"
        if OBJECT not in words:
            raise BadInput(
                f"objects must be named from folder, stem, or a pattern with {{object}} {example}; got {self.text!r}"
            )
        rest = _FIELD.sub("/", self.text)
        if "{" in rest or "}" in rest or any(not word.isidentifier() for word in words):
            raise BadInput(f"braces in a pattern must contain one word each, {example}; got {self.text!r}")
        if "}{" in self.text:
            raise BadInput(f"two words of a pattern must have text between them, {example}; got {self.text!r}")

    def object_of(self, path: str) -> str | None:
        """Return the object of the photo at `path` (forward slashes), or None if the path does not fit the rule."""
        if self.text == FOLDER and "/" in path:
            return path.partition("/")[0]
        name = PurePosixPath(path)
        if self.text == FOLDER:
            return name.stem
        if self.text == STEM:
            return _NUMBER.sub("", name.stem) or None
        match = self._pattern.fullmatch(path.removesuffix(name.suffix)) or self._pattern.fullmatch(path)
        return match[OBJECT] if match else None

    @cached_property
    def _pattern(self) -> re.Pattern[str]:
        again = f"(?P={OBJECT})"
        suffix = PurePosixPath(self.text).suffix
        suffix = "" if "{" in suffix else suffix
        escaped = re.escape(self.text.removesuffix(suffix)) + f"(?i:{re.escape(suffix)})"
        pattern = _ESCAPED_FIELD.sub(lambda field: again if field[1] == OBJECT else "[^/]+?", escaped)
        return re.compile(pattern.replace(again, f"(?P<{OBJECT}>[^/]+)", 1))


def same_name_warnings(objects: Iterable[str]) -> list[str]:
    """Return a warning if names of objects are nearly the same."""
    names = sorted(set(objects))
    keys = Counter(map(same_object_key, names))
    if same := [name for name in names if keys[same_object_key(name)] > 1]:
        return [
            f"the names of {len(same)} objects differ only by case, spaces or the form of their characters: "
            f"{_some(list(map(repr, same)))}; they are searched as different objects: rename those that are one"
        ]
    return []


def naming_warnings(photos: Iterable[tuple[str, str]], naming: Naming) -> list[str]:
    """Return a warning sentence for each suspicious property of the objects of photos, given as (object, path)."""
    paths: dict[str, list[str]] = defaultdict(list)
    for name, path in photos:
        paths[name].append(path)
    names, warnings = sorted(paths), []
    if generic := [name for name in names if name.casefold() in NOT_OBJECTS]:
        remedy = f"check the rule {naming.text!r}"
        if naming.text == FOLDER:
            remedy = "if the objects' folders are below it, use --objects-from '{split}/{object}/{photo}'"
        warnings.append(
            f"{_some(generic)} {'is' if len(generic) == 1 else 'are'} used as the name of an object, with "
            f"{sum(len(paths[name]) for name in generic)} photo(s): {remedy}"
        )
    if naming.text == FOLDER and (inner := _object_folders(paths)):
        warnings.append(
            f"{_some([name for name in names if name in inner])}: photos in {sum(map(len, inner.values()))} folders "
            f"below count as one object for each of these names; if those folders are the objects, use "
            "--objects-from '{shop}/{object}/{photo}'"
        )
    if naming.text in (FOLDER, STEM) and (recurring := _views(names)):
        views, similar = recurring
        place = "{object}_{view}/{photo}" if any("/" in path for path in paths[similar[0]]) else "{object}_{view}"
        warnings.append(
            f"the names of {len(similar)} objects differ from another name only by {_some(views)}: {_some(similar)}; "
            f"if these show one object, use --objects-from '{place}'"
        )
    elif naming.text == FOLDER:
        stem_of = {name: _NUMBER.sub("", name) for name in names}
        stems = Counter(stem_of.values())
        if similar := [name for name, stem in stem_of.items() if stem and stems[stem] > 1]:
            warnings.append(
                f"the names of {len(similar)} of {len(names)} objects differ from another name only by a number: "
                f"{_some(similar)}; if these show one object, use --objects-from stem or a pattern"
            )
    return warnings


def _some(names: Sequence[str]) -> str:
    return abbreviate_list(names, MAX_EXAMPLES)


def _object_folders(paths: Mapping[str, Sequence[str]]) -> dict[str, set[str]]:
    """Return the folders with photos below each object's folder, where they may be the objects themselves.

    That is so for two folders or more whose names the other objects do not have: views, such as front and back, recur.
    """
    inner = {
        name: {path.split("/")[1] for path in of_object if path.count("/") > 1} for name, of_object in paths.items()
    }
    often = Counter(folder for folders in inner.values() for folder in folders)
    return {name: folders for name, folders in inner.items() if sum(often[folder] == 1 for folder in folders) > 1}


def _views(names: Sequence[str]) -> tuple[list[str], list[str]] | None:
    """Return the last words that recur after two or more beginnings of names, and these names; None without such."""
    words_of: dict[str, dict[str, str]] = defaultdict(dict)  # beginning -> last word -> name
    for name in names:
        if match := _LAST_WORD.fullmatch(_NUMBER.sub("", name)):
            words_of[match[1]][match[2].casefold()] = name
    groups = [words for words in words_of.values() if len(words) > 1]
    often = Counter(word for words in groups for word in words)
    views = sorted(word for word, count in often.items() if count > 1)
    similar = sorted(name for words in groups for word, name in words.items() if word in views)
    return (views, similar) if len(views) > 1 else None
