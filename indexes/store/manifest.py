"""`manifest.json`: what a generation is and what its files must be."""

import hashlib
import json
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from _touch_retrieval.files import durable, encoded, file_digest, open_regular, read_json
from indexes.errors import AGAIN, CorruptIndex, RowError, UnsupportedFormat

FORMAT, OLDER = 3, 2
"""Of what is written; also read."""
NAME = "manifest.json"
MAX_BYTES = 4 * 2**20
"""Of a manifest: of 4096 shards with their names and digests it has 1 MiB."""
_NUMBER = range(10**9)
_WORD = re.compile(r"[a-z][a-z0-9_]*")


@dataclass(frozen=True)
class Counts:
    """Rows; slots (distinct vectors); tombstones (slots without a row).

    built_slots were there when the structure was trained, structure_slots are in it; those after them are scanned.
    """

    rows: int
    slots: int
    tombstones: int
    built_slots: int
    structure_slots: int


@dataclass(frozen=True)
class Manifest:
    """The fields of the file, in its order. `asked` are the parameters before None was filled in.

    segments: see `indexes.store.older`; None in today's format, where the file has no such field.
    """

    generation: str
    parent: str | None
    created: str
    software: str
    fingerprint: dict[str, str]
    about: dict[str, Any]
    dim: int
    metric: str
    kind: str
    parameters: dict[str, Any]
    asked: dict[str, Any]
    seed: int
    recall: dict[str, Any]
    counts: Counts
    arrays: list[str]
    documents: list[str]
    files: dict[str, dict[str, Any]]
    segments: dict[str, list[int]] | None = None


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the file, with a digest of its own content at the end."""
    content = {"format": FORMAT} | asdict(manifest)
    del content["segments"]
    content["sha256"] = own_digest(content)
    text = encoded(content, indent=2) + b"\n"
    if len(text) > MAX_BYTES:
        raise RowError(f"a manifest must have at most {MAX_BYTES} bytes, has {len(text)}; shorten `about`")
    with durable(folder / NAME) as handle:
        handle.write(text)


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a generation's folder; `CorruptIndex` or `UnsupportedFormat` where it is bad."""
    return _parsed(folder / NAME, read_document(folder / NAME, OLDER, FORMAT))


def read_document(path: Path, oldest: int, newest: int) -> dict[str, Any]:
    """A JSON object of one of these formats that ends with the digest of its own content, without that digest. Raises
    CorruptIndex or UnsupportedFormat."""
    try:
        content = read_json(path, MAX_BYTES)
    except OSError as error:
        raise CorruptIndex(f"{path}: cannot be read ({error.strerror}); {AGAIN}") from error
    except ValueError as error:
        raise CorruptIndex(f"{path}: must be JSON, is cut short or damaged ({error}); {AGAIN}") from error
    if not isinstance(content, dict):
        raise CorruptIndex(f"{path}: must be a JSON object; {AGAIN}")
    _check_format(path, content.get("format"), oldest, newest)
    if content.pop("sha256", None) != own_digest(content):
        raise CorruptIndex(f"{path}: the content does not fit its own SHA-256, it was altered; {AGAIN}")
    return content


def sealed(folder: Path) -> dict[str, dict[str, Any]]:
    """Size and SHA-256 of every file in the folder."""
    return {path.name: {"bytes": path.stat().st_size, "sha256": file_digest(path)} for path in sorted(folder.iterdir())}


def check_files(folder: Path, manifest: Manifest, *, verify: bool) -> None:
    """Every file has its size and, with `verify`, its SHA-256; or `CorruptIndex` naming the file."""
    for name, must in manifest.files.items():
        path = folder / name
        try:
            with open_regular(path) as file:
                size = os.fstat(file.fileno()).st_size
            if size != must["bytes"]:
                raise CorruptIndex(f"{path}: must have {must['bytes']} bytes, has {size}; {AGAIN}")
            if verify and file_digest(path) != must["sha256"]:
                raise CorruptIndex(f"{path}: the SHA-256 differs from the manifest's, it was altered; {AGAIN}")
        except OSError as error:
            raise CorruptIndex(f"{path}: cannot be read ({error.strerror}); {AGAIN}") from error


def _check_format(path: Path, version: object, oldest: int, newest: int) -> None:
    if not isinstance(version, int) or isinstance(version, bool):
        raise CorruptIndex(f"{path}: must say its format version, says {version!r}; {AGAIN}")
    if not oldest <= version <= newest:
        age, remedy = ("newer", f"update the software, or {AGAIN}") if version > newest else ("older", AGAIN)
        known = f"{newest}" if oldest == newest else f"{oldest} to {newest}"
        raise UnsupportedFormat(f"{path}: has the {age} format {version}, this software reads {known}; {remedy}")


def own_digest(content: Mapping[str, Any]) -> str:
    """What a document says of itself under "sha256": the digest of all else in it."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _parsed(path: Path, content: dict[str, Any]) -> Manifest:
    version, right = content.pop("format"), dict(_RIGHT)
    if version == OLDER:
        right["segments"] = _is_segments
        if isinstance(content.get("counts"), dict):
            content["counts"].pop("records", None)  # those that no row showed any more too
    if set(content) != set(right):
        odd = ", ".join(sorted(set(content) ^ set(right)))
        raise CorruptIndex(f"{path}: must have exactly the fields of format {version}; differs in {odd}; {AGAIN}")
    wrong = [name for name, is_right in right.items() if not is_right(content[name])]
    if wrong:
        raise CorruptIndex(f"{path}: {wrong[0]} is not what the format says, the file was altered; {AGAIN}")
    names = [*content["arrays"], *content["documents"]]
    if len(set(names)) < len(names):
        raise CorruptIndex(f"{path}: arrays and documents must have distinct names, got {names}; {AGAIN}")
    return Manifest(**content | {"counts": Counts(**content["counts"])})


def _is_count(value: object) -> bool:
    return type(value) is int and value in _NUMBER


def _is_texts(value: object) -> bool:
    return isinstance(value, dict) and all(isinstance(each, str) for each in value.values())


def _is_words(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(each, str) and bool(_WORD.fullmatch(each)) for each in value)


def _is_counts(value: object) -> bool:
    names = {field.name for field in fields(Counts)}
    return isinstance(value, dict) and set(value) == names and all(_is_count(each) for each in value.values())


def _is_segments(value: object) -> bool:
    if not isinstance(value, dict) or set(value) != {"records", "vectors"}:
        return False
    return all(
        isinstance(part, list) and part and all(map(_is_count, part)) and len(set(part)) == len(part)
        for part in value.values()
    )


def _is_files(value: object) -> bool:
    """Names inside the folder, each with its size and digest."""
    if not isinstance(value, dict):
        return False
    return all(
        Path(name).name == name
        and name.isprintable()
        and isinstance(must, dict)
        and set(must) == {"bytes", "sha256"}
        and type(must["bytes"]) is int
        and isinstance(must["sha256"], str)
        for name, must in value.items()
    )


def _is(*types: type) -> Callable[[object], bool]:
    return lambda value: type(value) in types


_RIGHT: Mapping[str, Callable[[object], bool]] = {
    "generation": _is(str),
    "parent": _is(str, type(None)),
    "created": _is(str),
    "software": _is(str),
    "fingerprint": _is_texts,
    "about": _is(dict),
    "dim": _is_count,
    "metric": _is(str),
    "kind": _is(str),
    "parameters": _is(dict),
    "asked": _is(dict),
    "seed": _is(int),
    "recall": _is(dict),
    "counts": _is_counts,
    "arrays": _is_words,
    "documents": _is_words,
    "files": _is_files,
}
"""What each field must be: whoever alters a file can write the digest that fits."""
