"""Cache files of evaluations: each contains a digest of its inputs and is made again when the inputs change."""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from _touch_retrieval.files import read_json, write_atomically
from retrieval.errors import CheckpointError
from retrieval.model.checkpoint import read_tensors, write_tensors

T = TypeVar("T")
CacheKey = Mapping[str, Any]
"""All inputs that determine the content of a file, in JSON types."""


def _digest(cache_key: CacheKey) -> str:
    return hashlib.sha256(json.dumps(cache_key, sort_keys=True).encode()).hexdigest()


def write_cached(path: Path, cache_key: CacheKey, tensors: dict[str, Tensor], about: CacheKey) -> None:
    """Write tensors and a header to a cache file.

    Args:
        path: The file.
        cache_key: All inputs that determine the tensors.
        tensors: Tensors by name.
        about: Further header entries, JSON types.
    """
    write_tensors(path, tensors, {"cache_key": _digest(cache_key), **about})


def read_cached(path: Path, cache_key: CacheKey) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    """Return tensors and header of a cache file; None if it is missing, damaged, or has another key."""
    if not path.is_file():
        return None
    try:
        tensors, header = read_tensors(path)
    except CheckpointError:
        return None
    return (tensors, header) if header.get("cache_key") == _digest(cache_key) else None


def cached_document(path: Path, cache_key: CacheKey, make: Callable[[], T]) -> T:
    """Return the JSON document `make()`, or the stored one of an earlier run with the same key."""
    key = _digest(cache_key)
    try:
        stored = read_json(path)
        if stored["cache_key"] == key:
            document: T = stored["document"]
            return document
    except (OSError, ValueError, KeyError, TypeError):  # missing or damaged
        pass
    made = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps({"cache_key": key, "document": made}, allow_nan=False).encode())
    return made


def write_document(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON file atomically. Equal documents give equal bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, f"{json.dumps(document, sort_keys=True, indent=1, allow_nan=False)}\n".encode())
