"""Derive the object of a photo from its path in the catalogue: the rule of `build-index --objects-from`.

    folder     the first folder, also for photos in its subfolders; without a folder, the name of the file
    stem       the file's name without extension and without a number at the end, in any folder:
               mug_0.jpg, mug-12.jpg and "mug (3).jpg" show mug
    PATTERN    a path in which {object} stands for the name, and any other word in braces for an ignored part:
               {split}/{object}/{photo}, or {object}_{view}.jpg

A pattern must match the photo's whole path, first without its extension, then with it. A word in braces matches one
character or more, but no "/"; {object} matches as many as possible, the others as few as possible. A second {object}
matches the same text as the first.
"""

import re
from collections import Counter
from collections.abc import Mapping
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
"""Names that data sets give to folders of many objects."""

_FIELD = re.compile(r"\{(\w+)\}")
_ESCAPED_FIELD = re.compile(r"\\\{(\w+)\\\}")  # as re.escape writes it
_NUMBER = re.compile(r"[\s._#-]*\(?\d+\)?$")
_MAX_EXAMPLES = 3


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
        found = self._pattern.fullmatch(path.removesuffix(name.suffix)) or self._pattern.fullmatch(path)
        return found[OBJECT] if found else None

    @cached_property
    def _pattern(self) -> re.Pattern[str]:
        again = f"(?P={OBJECT})"
        escaped = re.escape(self.text)
        pattern = _ESCAPED_FIELD.sub(lambda field: again if field[1] == OBJECT else "[^/]+?", escaped)
        return re.compile(pattern.replace(again, f"(?P<{OBJECT}>[^/]+)", 1))


def naming_warnings(photos: Mapping[str, int], naming: Naming) -> list[str]:
    """Return a warning sentence for each suspicious property of the object names, given their numbers of photos."""
    names, warnings = sorted(photos), []
    if generic := [name for name in names if name.casefold() in NOT_OBJECTS]:
        warnings.append(
            f"{abbreviate_list(generic, _MAX_EXAMPLES)} {'is' if len(generic) == 1 else 'are'} used as the name of an "
            f"object, with {sum(photos[name] for name in generic)} photo(s): if the objects' folders are below it, use "
            f"--objects-from '{{split}}/{{object}}/{{photo}}'"
        )
    stem_of = {name: _NUMBER.sub("", name) for name in names}
    stems = Counter(stem_of.values())
    similar = [name for name, stem in stem_of.items() if stem and stems[stem] > 1]
    if naming.text != STEM and similar:
        warnings.append(
            f"the names of {len(similar)} of {len(names)} objects differ from another name only by a number: "
            f"{abbreviate_list(similar, _MAX_EXAMPLES)}; if these show one object, use --objects-from stem or a pattern"
        )
    return warnings
