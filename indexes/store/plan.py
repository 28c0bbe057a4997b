"""How a new generation lies on the disk: which segments it shares with the parent, and what its new one holds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from indexes.kinds.scores import Floats, Mask, Slots
from indexes.kinds.stack import Vectors, blocks_of, parts_of, segments_kept, stacked
from indexes.store.rows import Records
from indexes.store.spool import Content

MOST_GARBAGE = 0.10
"""Share of slots without a row, or of records that no row shows, beyond which everything is written anew."""

HASHED_ROWS = 8192


@dataclass(frozen=True)
class Table:
    """A table in segments.

    before  the parent's segments, by their length, of which the first `kept` stay as they are
    take    (n,) the rows of all old segments and the new rows end to end that the new segment holds
    spooled whether those are the new rows as they were written
    """

    before: Sequence[int]
    kept: int
    take: Slots
    spooled: bool

    @property
    def count(self) -> int:
        """Rows of all segments."""
        return sum(self.before[: self.kept]) + len(self.take)


@dataclass(frozen=True)
class Plan:
    """A generation's content (`records` and `vectors`: the parent's, and the new at the end) and its layout.

    places and slots (N,) are those of the rows once the segments are written; `slot_of` (S,) gives the new number of
    each old slot where slots were numbered anew.
    """

    content: Content
    records: Records
    vectors: list[Floats]
    record_table: Table
    vector_table: Table
    places: Slots
    slots: Slots
    slot_of: Slots | None


def lay_out(content: Content) -> Plan:
    """Give equal vectors one slot, keep the parent's segments, and write all anew where too much of it is garbage.

    Slots and records written anew are in the order of the rows.
    """
    parent, new = content.parent, content.new
    old_vectors = [] if parent is None else parts_of(parent.embeddings)
    old_records = [] if parent is None else parent.records.segments
    vectors = [*old_vectors, *_distinct(content, old_vectors)]
    records = Records([*old_records, *([] if new is None else [new])])
    places, slots = content.places, records.column("slot", content.places)
    before = [len(part) for part in old_vectors]
    vector_table = _grown(before, sum(map(len, vectors)), bool(vectors) and vectors[-1] is content.vectors)
    slot_of: Slots | None = None
    if _garbage(int(np.count_nonzero(np.bincount(slots))), vector_table.count):
        used, first = np.unique(slots, return_index=True)
        order = used[np.argsort(first)]
        slot_of = np.full(vector_table.count, -1)
        slot_of[order] = np.arange(len(order))
        vector_table, slots = Table(before, 0, order, False), slot_of[slots]
    before = [len(segment.table) for segment in old_records]
    record_table = _grown(before, len(records), True)
    if slot_of is not None or _garbage(len(places), len(records)):
        record_table, places = Table(before, 0, places, False), np.arange(len(places))
    return Plan(content, records, vectors, record_table, vector_table, places, slots, slot_of)


def first_of_equals(vectors: Floats, seed: int = 0) -> Slots:
    """For each vector (M,) the first slot that holds the same bytes.

    Equal hashes are taken for a hint and the bytes compared; where they differ, another hash sorts them out.
    """
    _, first, group = np.unique(_hashes(vectors, seed), return_index=True, return_inverse=True)
    result: Slots = first[group]
    copies = np.flatnonzero(result != np.arange(len(vectors)))
    odd = np.concatenate(
        [copies[:0], *(part[_differ(vectors, part, result)] for part in blocks_of(copies, HASHED_ROWS))]
    )
    if len(odd):
        result[odd] = odd[first_of_equals(vectors[odd], seed + 1)]
    return result


def _grown(before: Sequence[int], count: int, spooled: bool) -> Table:
    kept = segments_kept(before, count - sum(before))
    return Table(before, kept, np.arange(sum(before[:kept]), count), spooled and kept == len(before))


def _garbage(used: int, count: int) -> bool:
    return count - used > MOST_GARBAGE * count


def _distinct(content: Content, old: list[Floats]) -> list[Floats]:
    """The new vectors that no slot holds yet; the slots of the new records are set to where theirs stand."""
    if content.vectors is None or content.new is None:
        return []
    vectors, before = content.vectors, sum(map(len, old))
    seen = _copies(old, vectors)
    first = first_of_equals(np.concatenate([stacked(old)[seen], vectors]) if len(seen) else vectors) - len(seen)
    own = first[len(seen) :]
    novel = own == np.arange(len(vectors))
    slot_of = np.where(novel, before - 1 + np.cumsum(novel), 0)
    slot_of = np.where(own < 0, seen[np.minimum(own, -1)] if len(seen) else 0, slot_of[own])
    slots = content.new.table["slot"]
    slots[slots >= before] = slot_of[slots[slots >= before] - before]
    return [vectors] if novel.all() else [vectors[novel]] if novel.any() else []


def _copies(old: list[Floats], vectors: Floats) -> Slots:
    """The slots of `old` that may hold the same bytes as one of `vectors`."""
    if not old:
        return np.empty(0, np.int64)
    return np.flatnonzero(np.isin(_hashes(stacked(old)), _hashes(vectors)))


def _differ(vectors: Floats, copies: Slots, first: Slots) -> Mask:
    left, right = (vectors[rows].view(np.uint32) for rows in (copies, first[copies]))
    differ: Mask = (left != right).any(axis=1)
    return differ


def _hashes(vectors: Vectors, seed: int = 0) -> NDArray[np.uint64]:
    """A hash (M,) of the bytes of each vector: its 32-bit words by random odd numbers, summed modulo 2^64."""
    factors = np.random.default_rng(seed).integers(2**63, size=vectors.shape[1], dtype=np.uint64) * np.uint64(
        2
    ) + np.uint64(1)
    blocks = (np.ascontiguousarray(block).view(np.uint32) * factors for block in blocks_of(vectors, HASHED_ROWS))
    return np.concatenate([block.sum(axis=1, dtype=np.uint64) for block in blocks])
