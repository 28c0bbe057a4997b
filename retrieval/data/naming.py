"""Which object a photo shows, by the photo's path in the catalogue: the rule of `build-index --objects-from`.

    folder     the first folder, however deep the photo lies below it; a photo in no folder is named by its file
    stem       the file's name without its ending and without a number at the end, whatever folder it lies in:
               mug_0.jpg, mug-12.jpg and "mug (3).jpg" show mug
    PATTERN    a path in which {object} stands for the name, and any other word in braces for what does not matter:
               {split}/{object}/{photo}, or {object}_{view}.jpg

A pattern is held to the photo's whole path without its ending, and where that does not fit, with it. A word in braces
stands for one character or more, but no "/"; {object} takes as many as it can, the others as few. The same word twice
stands for the same text.
"""

import re
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import PurePosixPath

from retrieval.console.output import abbreviate_list
from retrieval.errors import BadInput

FOLDER, STEM = "folder", "stem"
OBJECT = "object"

NOT_OBJECTS = frozenset(
    {"catalog", "catalogue", "data", "dataset", "dev", "gallery", "image", "images", "img", "imgs", "jpeg", "jpg"}
    | {"object", "objects", "photo", "photos", "pic", "pics", "picture", "pictures", "png", "raw", "rgb"}
    | {"test", "testing", "train", "training", "val", "valid", "validation"}
)
"""Names of folders that hold many objects, as data sets have them."""

_FIELD = re.compile(r"\{(\w+)\}")
_NUMBER = re.compile(r"[\s._#-]*\(?\d+\)?$")
_MAX_EXAMPLES = 3


@dataclass(frozen=True)
class Naming:
    """The rule `text`. Raises BadInput for a pattern without {object} or with braces that hold no word."""

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
            raise BadInput(f"braces in a pattern must hold one word each, {example}; got {self.text!r}")
        if "}{" in self.text:
            raise BadInput(f"two words of a pattern must have text between them, {example}; got {self.text!r}")

    def object_of(self, path: str) -> str | None:
        """The object of the photo at `path`, forward slashes; None where the path does not fit the rule."""
        if self.text == FOLDER:
            first, _, rest = path.partition("/")
            if first not in ("", ".") and rest.strip("./"):  # most paths, without taking them apart
                return first
        name = PurePosixPath(path)
        if self.text == FOLDER:
            return name.parts[0] if len(name.parts) > 1 else name.stem
        if self.text == STEM:
            return without_number(name.stem) or None
        found = self._pattern.fullmatch(path.removesuffix(name.suffix)) or self._pattern.fullmatch(path)
        return found[OBJECT] if found else None

    @cached_property
    def _pattern(self) -> re.Pattern[str]:
        parts, seen = [], set()
        for number, part in enumerate(_FIELD.split(self.text)):  # text, word, text, word, ..., text
            if number % 2 == 0:
                parts.append(re.escape(part))
            elif part in seen:
                parts.append(f"(?P={part})")
            else:
                parts.append(f"(?P<{part}>[^/]+{'' if part == OBJECT else '?'})")
                seen.add(part)
        return re.compile("".join(parts))


def without_number(name: str) -> str:
    """The name without the number that it ends with, and without what joins the two: "mug" of "mug_12"."""
    return _NUMBER.sub("", name)


def naming_warnings(photos: Mapping[str, int], naming: Naming) -> list[str]:
    """What looks wrong about objects with these numbers of photos: a sentence each."""
    names, found = sorted(photos), []
    if strange := [name for name in names if name.casefold() in NOT_OBJECTS]:
        found.append(
            f"{abbreviate_list(strange, _MAX_EXAMPLES)} {'is' if len(strange) == 1 else 'are'} taken for the name of an object, with "
            f"{sum(photos[name] for name in strange)} photo(s): if the objects' folders lie below it, say "
            f"--objects-from '{{split}}/{{object}}/{{photo}}'"
        )
    elif len(names) == 1 and photos[names[0]] > 1:
        found.append(f"all {photos[names[0]]} photos are taken for photos of one object, {names[0]}")
    stem_of = {name: without_number(name) for name in names}
    stems = Counter(stem_of.values())
    alike = [name for name, stem in stem_of.items() if stem and stems[stem] > 1]
    if naming.text != STEM and alike:
        single = all(photos[name] == 1 for name in names)
        what = "every object has one photo, and " if single else ""
        found.append(
            f"{what}{len(alike)} of {len(names)} objects have names that differ from another's by a number only: "
            f"{abbreviate_list(alike, _MAX_EXAMPLES)}; if these show one object, say --objects-from stem, or a pattern"
        )
    return found


def count_summary(counts: Sequence[int]) -> dict[str, float]:
    """Least, median and largest number of photos of an object."""
    return {"min": min(counts), "median": statistics.median(counts), "max": max(counts)}
