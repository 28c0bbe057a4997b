"""What evaluations keep on disk: a file holds the digest of what made it, and one of other settings is made again."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from _touch_retrieval.files import read_json, write_atomically
from retrieval.errors import CheckpointError, JobInterrupted
from retrieval.model.checkpoint import read_tensors, write_tensors

T = TypeVar("T")
CacheKey = Mapping[str, Any]
"""Everything that decides what a file holds, in JSON types."""


def _digest(cache_key: CacheKey) -> str:
    return hashlib.sha256(json.dumps(cache_key, sort_keys=True).encode()).hexdigest()


def write_cached(path: Path, cache_key: CacheKey, tensors: dict[str, Tensor], about: CacheKey) -> None:
    """Keep tensors, with what is said about them in JSON types."""
    write_tensors(path, tensors, {"cache_key": _digest(cache_key), **about})


def read_cached(path: Path, cache_key: CacheKey) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    """Return what `write_cached` wrote; None where it is missing, damaged, or made by something else."""
    if not path.is_file():
        return None
    try:
        tensors, header = read_tensors(path)
    except CheckpointError:
        return None
    return (tensors, header) if header.get("cache_key") == _digest(cache_key) else None


def cached_document(path: Path, cache_key: CacheKey, make: Callable[[], T]) -> T:
    """Return `make()`, a JSON document, or what it returned in an earlier run of the same `cache_key`."""
    key = _digest(cache_key)
    try:
        kept = read_json(path)
        if kept["cache_key"] == key:
            document: T = kept["document"]
            return document
    except (OSError, ValueError, KeyError, TypeError):  # missing or damaged
        pass
    made = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps({"cache_key": key, "document": made}, allow_nan=False).encode())
    return made


def write_document(path: Path, document: Mapping[str, Any]) -> None:
    """Write JSON whole or not at all; equal documents are equal to the byte."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, f"{json.dumps(document, sort_keys=True, indent=1, allow_nan=False)}\n".encode())


@contextmanager
def resumable(folder: Path) -> Iterator[None]:
    """Say after Ctrl-C that the work goes on from `folder`. Raises JobInterrupted."""
    try:
        yield
    except JobInterrupted as error:
        raise JobInterrupted(
            f"stopped; what was made is kept in {folder}, and the same command goes on with it"
        ) from error
