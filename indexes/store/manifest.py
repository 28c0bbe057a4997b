"""`manifest.json`: the description of a generation, with the size and SHA-256 of its files."""

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

from msgspec import Meta

from _touch_retrieval.documents import typed
from _touch_retrieval.files import file_digest, open_regular, parse_json, read_regular
from indexes.errors import AGAIN, CorruptIndex, UnsupportedFormat

FORMAT = 8
NAME = "manifest.json"
MAX_BYTES = 4 * 2**20
"""Largest manifest. With the names and digests of 4096 shards it has 1 MiB."""

T = TypeVar("T")
Count = Annotated[int, Meta(ge=0, lt=10**9)]
Word = Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_]*\Z")]
FileName = Annotated[str, Meta(pattern=r"^[a-z0-9_]+\.(json|jsonl|npy|faiss)\Z")]


@dataclass(frozen=True)
class FileChecksum:
    """Size and SHA-256 of a file."""

    bytes: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """Fields of the file, in its order.

    Attributes:
        generation: Name of the generation, such as gen-000007.
        created: Time of the build.
        software: Version of the software.
        fingerprint: Origin of the vectors.
        about: Further entries.
        dim: Number of components of a vector.
        kind: Kind of index.
        recall: Measured recall and time of the kind.
        photos: Number of rows.
        objects: Number of objects.
        arrays: Names of the per-row arrays.
        documents: Names of the documents.
        files: Size and SHA-256 of every other file.
    """

    generation: str
    created: str
    software: str
    fingerprint: dict[str, str]
    about: dict[str, Any]
    dim: Count
    kind: str
    recall: dict[str, Any]
    photos: Count
    objects: Count
    arrays: list[Word]
    documents: list[Word]
    files: dict[FileName, FileChecksum]


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of a generation's folder. Raises `CorruptIndex` or `UnsupportedFormat`."""
    return read_document(folder / NAME, FORMAT, Manifest)


def encode_document(content: Any, version: int) -> bytes:
    """Return the JSON of a dataclass, with the format version first and the digest of the content last."""
    document = {"format": version} | asdict(content)
    return json.dumps(document | {"sha256": content_digest(document)}, allow_nan=False, indent=2).encode() + b"\n"


def read_document(path: Path, version: int, kind: type[T]) -> T:
    """Read a file that `encode_document` made of a dataclass.

    Args:
        path: The file.
        version: Supported format version.
        kind: The dataclass.

    Raises:
        CorruptIndex: The file is missing or damaged.
        UnsupportedFormat: The file has another format version.
    """
    try:
        content = parse_json(read_regular(path, MAX_BYTES), own=True)
    except OSError as error:
        raise CorruptIndex(f"{path}: cannot be read ({error.strerror}); {AGAIN}") from error
    except ValueError as error:
        raise CorruptIndex(f"{path}: must be JSON, but is truncated or damaged ({error}); {AGAIN}") from error
    stored = content.get("format") if isinstance(content, dict) else None
    if type(stored) is not int:
        raise CorruptIndex(f"{path}: must be a JSON object with a format version, got {stored!r}; {AGAIN}")
    if stored != version:
        age, remedy = ("newer", f"update the software, or {AGAIN}") if stored > version else ("older", AGAIN)
        raise UnsupportedFormat(f"{path}: has the {age} format {stored}, but this software reads {version}; {remedy}")
    if content.pop("sha256", None) != content_digest(content):
        raise CorruptIndex(f"{path}: the content does not match its SHA-256: the file was altered; {AGAIN}")
    del content["format"]
    try:  # check every field: software that alters the file can also write the right digest
        return typed(content, kind, path.stem)
    except ValueError as error:
        raise CorruptIndex(f"{path}: the file was altered ({error}); {AGAIN}") from error


def check_files(folder: Path, manifest: Manifest, *, verify: bool) -> None:
    """Check the size and, with `verify`, the SHA-256 of every file. Raises `CorruptIndex` for the first bad file."""
    for name, checksum in manifest.files.items():
        path = folder / name
        try:
            with open_regular(path) as file:
                size = os.fstat(file.fileno()).st_size
            if size != checksum.bytes:
                raise CorruptIndex(f"{path}: must have {checksum.bytes} bytes, but has {size}; {AGAIN}")
            if verify and file_digest(path) != checksum.sha256:
                raise CorruptIndex(f"{path}: the SHA-256 differs from the manifest: the file was altered; {AGAIN}")
        except OSError as error:
            raise CorruptIndex(f"{path}: cannot be read ({error.strerror}); {AGAIN}") from error


def content_digest(content: Mapping[str, Any]) -> str:
    """Return the digest of all other entries of a document, which it stores under "sha256"."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
