"""The files of a generation's tables: the parent's by a second name, the new segment from a plan."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexes.kinds.base import VectorIndex
from indexes.kinds.checks import BLOCK_ROWS
from indexes.kinds.scores import Slots
from indexes.kinds.stack import blocks_of, stacked
from indexes.store import files
from indexes.store.generation import ORDER, STRUCTURE, Generation, file_identity, segment_name
from indexes.store.plan import Plan
from indexes.store.rows import Records
from indexes.store.spool import SPOOLED, SPOOLED_TEXT


class Heirlooms:
    """The parent's files that a new generation has too, and what the manifest says of them: they are not read again."""

    def __init__(self, parent: Generation, folder: Path) -> None:
        self.parent, self.folder = parent, folder
        self.sealed: dict[str, dict[str, Any]] = {}

    def take(self, name: str) -> None:
        """Give the parent's file a second name in the folder; where that cannot be, copy what the parent holds."""
        old, new = self.parent.folder / name, self.folder / name
        try:
            if file_identity(old) != self.parent.identities[name]:
                raise FileNotFoundError(f"{old} is another file than was opened")
            os.link(old, new)
        except OSError:
            if name == STRUCTURE:
                write_structure(self.parent.index, self.folder)  # its bytes may differ: the manifest's are not its
                return
            with files.durable(new) as handle:
                handle.write(self.parent.file_bytes(name))
        self.sealed[name] = self.parent.manifest.files[name]


def write_structure(index: VectorIndex, folder: Path) -> None:
    """Write the structure of an index, where it has one."""
    if index.save(folder / STRUCTURE):
        files.sync(folder / STRUCTURE)


def write_segments(folder: Path, plan: Plan, number: int, heirlooms: Heirlooms | None) -> dict[str, list[int]]:
    """Write the plan's rows, arrays and vectors; the spool's files in `folder` become the new segment or go.

    Returns the numbers of the segments of each table: the parent's for those shared, `number` for the new one.
    """
    segments: dict[str, list[int]] = {"records": [], "vectors": []}
    if heirlooms is not None:
        before, arrays = heirlooms.parent.manifest.segments, heirlooms.parent.arrays
        segments["records"] = before["records"][: plan.record_table.kept]
        segments["vectors"] = before["vectors"][: plan.vector_table.kept]
        for old in segments["records"]:
            for name in ("rows", "table", *arrays):
                heirlooms.take(segment_name(name, old))
        for old in segments["vectors"]:
            heirlooms.take(segment_name("embeddings", old))
    if len(plan.record_table.take):
        _write_records(folder, plan, number)
        segments["records"].append(number)
    if len(plan.vector_table.take):
        _write_vectors(folder, plan, number)
        segments["vectors"].append(number)
    for path in folder.glob(f"*{SPOOLED}"):
        path.unlink()
    if not np.array_equal(plan.places, np.arange(plan.record_table.count)):
        files.write_array(folder / ORDER, np.int64, (), [plan.places])
    return segments


def _write_records(folder: Path, plan: Plan, number: int) -> None:
    table, records, take = plan.record_table, plan.records, plan.record_table.take
    text = folder / segment_name("rows", number)
    if table.spooled:
        (folder / SPOOLED_TEXT).rename(text)
    else:
        with files.durable(text) as handle:
            handle.writelines(records.line(int(place)) + b"\n" for place in take)
    new = _table(records, take, plan.slot_of)
    files.write_array(folder / segment_name("table", number), new.dtype, (), [new])
    for name in records.segments[0].arrays:
        array = records.array(name)
        blocks = (array[places] for places in blocks_of(take, BLOCK_ROWS))
        spooled = folder / f"{name}{SPOOLED}" if table.spooled else None
        _put(folder / segment_name(name, number), spooled, array, blocks)


def _write_vectors(folder: Path, plan: Plan, number: int) -> None:
    vectors, table = stacked(plan.vectors), plan.vector_table
    blocks = (vectors[slots] for slots in blocks_of(table.take, BLOCK_ROWS))
    spooled = folder / f"embeddings{SPOOLED}" if table.spooled else None
    _put(folder / segment_name("embeddings", number), spooled, vectors, blocks)


def _table(records: Records, take: Slots, slot_of: Slots | None) -> NDArray[Any]:
    """The table of records whose lines are written one after another in the order of `take`."""
    new: NDArray[Any] = np.concatenate([segment.table for segment in records.segments])[take]
    if slot_of is not None:
        new["slot"] = slot_of[new["slot"]]
    size = new["stop"] - new["start"]
    new["stop"] = np.cumsum(size)
    new["start"] = new["stop"] - size
    return new


def _put(path: Path, spooled: Path | None, like: Any, blocks: Iterable[NDArray[Any]]) -> None:
    if spooled is None:
        files.write_array(path, like.dtype, like.shape[1:], blocks)
    else:
        spooled.rename(path)
