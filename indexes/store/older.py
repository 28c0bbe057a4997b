"""Generations of format 2: tables in segments, each written by one generation, and an order of their rows.

    rows-000005.jsonl, table-000005.npy, NAME-000005.npy   the records that generation 5 wrote; lines count from 0
    embeddings-000005.npy                                   the vectors that it wrote
    order.npy                                               which records are rows and in which order, where that is not
                                                            all of them as they lie

One that never grew is read where it lies, as one of today is. Of others the segments are put together in memory; the
next generation is written in today's format.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexes.errors import AGAIN, CorruptIndex
from indexes.store.manifest import Manifest

ORDER = "order.npy"


def table_files(manifest: Manifest) -> dict[str, list[str]]:
    """Name of a table ("rows", "table", "embeddings", those of the arrays) -> its files, one in today's format."""
    found = {}
    for name in ("rows", "table", "embeddings", *manifest.arrays):
        ending = "jsonl" if name == "rows" else "npy"
        segments = manifest.segments and manifest.segments["vectors" if name == "embeddings" else "records"]
        found[name] = [f"{name}-{number:06d}.{ending}" for number in segments] if segments else [f"{name}.{ending}"]
    return found


def joined(
    folder: Path, manifest: Manifest, texts: Sequence[NDArray[np.uint8]], parts: Mapping[str, Sequence[NDArray[Any]]]
) -> tuple[NDArray[np.uint8], dict[str, NDArray[Any]]]:
    """The text of all rows, and the tables by name, of what `table_files` names."""
    order = np.load(folder / ORDER, allow_pickle=False) if manifest.segments and ORDER in manifest.files else None
    if order is None and len(texts) == 1 and len(parts["embeddings"]) == 1:
        return texts[0], {name: part[0] for name, part in parts.items()}
    shifted = []
    for table, before in zip(parts["table"], np.cumsum([0, *map(len, texts)]), strict=False):
        shifted.append(table.copy())
        shifted[-1]["start"] += before
        shifted[-1]["stop"] += before
    tables = {name: np.concatenate(part) for name, part in (dict(parts) | {"table": shifted}).items()}
    records = len(tables["table"])
    if order is not None:
        if order.dtype != np.int64 or order.min() < 0 or order.max() >= records:
            raise CorruptIndex(f"{folder}: the order must name records 0 to {records - 1}; {AGAIN}")
        tables |= {name: table[order] for name, table in tables.items() if name != "embeddings"}
    return np.concatenate(texts), tables
