"""What a new generation holds: which rows take vectors from the parent, and which slot each row points to."""

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexes.base import Parameters, VectorIndex
from indexes.checks import BLOCK_ROWS, check_unit
from indexes.errors import MismatchedIndex, RowError, VectorError
from indexes.files import check_json
from indexes.generation import Generation
from indexes.scores import Floats, Slots

MOST_TOMBSTONES = 0.10
"""Share of slots without a row beyond which the structure is built anew."""

RESERVED = {"rows", "embeddings", "vectors", "manifest"}


@dataclass(frozen=True)
class Plan:
    """The vectors of a generation (S, d), each row's slot (N,), and how many leading slots are the parent's.

    `inherited` is 0 where the structure is to be built anew; then no slot is without a row, and slots are in
    the order of their smallest row id, so that ties between slots fall as the ids say.
    """

    vectors: Floats
    slots: Slots
    inherited: int


@dataclass(frozen=True)
class Content:
    """Checked rows, each with the parent's row it comes from, or -1 - its place among the fresh ones."""

    rows: list[dict[str, Any]]
    origin: Slots
    fresh: Floats
    arrays: dict[str, NDArray[Any]]
    parent: Generation | None

    @property
    def ids(self) -> list[str]:
        """The rows' ids in their order."""
        return [row["id"] for row in self.rows]

    def array_blocks(self, name: str) -> Iterator[NDArray[Any]]:
        """The per-row array `name` in the rows' order, block by block."""
        fresh, old = self.arrays[name], None if self.parent is None else self.parent.arrays.get(name)
        for start in range(0, len(self.rows), BLOCK_ROWS):
            origin = self.origin[start : start + BLOCK_ROWS]
            block = np.empty((len(origin), *fresh.shape[1:]), dtype=fresh.dtype)
            new = origin < 0
            block[new] = fresh[-1 - origin[new]]
            if old is not None and not new.all():
                block[~new] = old[origin[~new]]
            yield block


def gather(
    rows: Sequence[Mapping[str, Any]],
    embeddings: Floats | None,
    arrays: Mapping[str, NDArray[Any]] | None,
    parent: Generation | None,
    fingerprint: Mapping[str, str],
) -> Content:
    """Check what a writer was given; see `IndexStore.write`."""
    checked = check_rows(rows)
    reused = {} if parent is None else parent.reusable({row["id"]: row.get("digest") for row in checked})
    if parent is not None and reused:
        _check_parent(parent, fingerprint)
    fresh_ids = [row["id"] for row in checked if row["id"] not in reused]
    counter = iter(range(len(fresh_ids)))
    origin = [reused[row["id"]] if row["id"] in reused else -1 - next(counter) for row in checked]
    source = parent if reused else None
    fresh = _fresh_vectors(embeddings, fresh_ids, source)
    named = _fresh_arrays(arrays or {}, fresh_ids, source)
    return Content(checked, np.array(origin, dtype=np.int64), fresh, named, source)


def check_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The rows as dicts with distinct text ids and nothing that JSON cannot hold, or `RowError`."""
    checked: list[dict[str, Any]] = []
    seen: set[str] = set()
    for number, row in enumerate(rows):
        name = row.get("id")
        if not isinstance(name, str) or not name:
            raise RowError(f"every row needs a text id; row {number} has {name!r}")
        if name in seen:
            raise RowError(f"row ids must be distinct; {name!r} comes twice", name)
        if "slot" in row:
            raise RowError(f"row {name!r}: the key 'slot' is the index's own; use another", name)
        check_json(dict(row), f"row {name!r}", name)
        seen.add(name)
        checked.append(dict(row))
    if not checked:
        raise RowError("an index needs at least one row; got none")
    return checked


def check_documents(documents: Mapping[str, Any]) -> dict[str, Any]:
    """The documents, named for files and of finite JSON, or `RowError`."""
    for name, document in documents.items():
        check_name(name)
        check_json(document, f"document {name!r}")
    return dict(documents)


def check_name(name: str) -> None:
    """`name` can be a file's name in a generation, or `RowError`."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or name in RESERVED:
        raise RowError(
            f"names of arrays and documents must be lower-case words, not {', '.join(sorted(RESERVED))}; got {name!r}"
        )


def lay_out(content: Content, kind: type[VectorIndex], asked: Parameters, seed: int) -> Plan:
    """Give every row a slot: equal vectors share one; the parent's structure is kept where that is sound."""
    if content.parent is None:
        old, rows_before = np.empty((0, content.fresh.shape[1]), np.float32), np.empty(0, np.int64)
    else:
        old, rows_before = content.parent.embeddings, content.parent.slots
    inherited = len(old)
    pool = np.concatenate([old, content.fresh])
    first = first_of_equals(pool)
    position = np.where(content.origin < 0, inherited - 1 - content.origin, 0)
    reused = content.origin >= 0
    position[reused] = rows_before[content.origin[reused]]
    slots = first[position]
    if content.parent is not None and _sound(content.parent, slots, kind, asked, seed):
        used = np.union1d(np.arange(inherited), slots)
        return Plan(pool[used], np.searchsorted(used, slots), inherited)
    return _compacted(pool, slots, content.ids)


def first_of_equals(vectors: Floats) -> Slots:
    """For each vector (M,) the first slot that holds the same bytes."""
    known: dict[bytes, int] = {}
    first = np.empty(len(vectors), dtype=np.int64)
    for number, vector in enumerate(vectors):
        first[number] = known.setdefault(hashlib.blake2b(vector.tobytes(), digest_size=20).digest(), number)
    return first


def _compacted(pool: Floats, slots: Slots, ids: Sequence[str]) -> Plan:
    by_id = sorted(range(len(ids)), key=ids.__getitem__)
    order = list(dict.fromkeys(slots[by_id].tolist()))
    renumbered = np.full(len(pool), -1, dtype=np.int64)
    renumbered[order] = np.arange(len(order))
    return Plan(pool[order], renumbered[slots], 0)


def _sound(parent: Generation, slots: Slots, kind: type[VectorIndex], asked: Parameters, seed: int) -> bool:
    """Whether the parent's structure can be kept and added to."""
    manifest = parent.manifest
    same = manifest.kind == kind.kind and kind.parameters_from(manifest.asked) == asked
    if kind.rebuild_is_cheap or not same or manifest.seed != seed:
        return False
    used = np.unique(slots)
    total = len(parent.embeddings) + int(np.count_nonzero(used >= len(parent.embeddings)))
    grown = kind.retrain_growth is not None and total > kind.retrain_growth * manifest.counts.built_slots
    return not grown and total - len(used) <= MOST_TOMBSTONES * total


def _check_parent(parent: Generation, fingerprint: Mapping[str, str]) -> None:
    if parent.manifest.fingerprint != dict(fingerprint):
        raise MismatchedIndex(
            f"vectors can be taken over only from an index with the same fingerprint {dict(fingerprint)}; "
            f"{parent.name} has {parent.manifest.fingerprint}. Build the index without a parent"
        )


def _fresh_vectors(embeddings: Floats | None, ids: Sequence[str], parent: Generation | None) -> Floats:
    if embeddings is None and not ids and parent is not None:
        return np.empty((0, parent.dim), np.float32)
    count = 0 if embeddings is None else len(embeddings)
    if embeddings is None or count != len(ids):
        raise VectorError(f"one embedding is needed for each of the {len(ids)} new rows; got {count}")
    return check_unit(embeddings, dim=None if parent is None else parent.dim, names=ids)


def _fresh_arrays(
    arrays: Mapping[str, NDArray[Any]], ids: Sequence[str], parent: Generation | None
) -> dict[str, NDArray[Any]]:
    for name, array in arrays.items():
        check_name(name)
        _check_array(name, array, ids)
    if parent is None:
        return dict(arrays)
    if not ids and not arrays:
        return {name: array[:0] for name, array in parent.arrays.items()}
    if set(arrays) != set(parent.arrays):
        raise RowError(f"the parent has the arrays {sorted(parent.arrays)}, the new rows have {sorted(arrays)}")
    for name, array in arrays.items():
        old = parent.arrays[name]
        if array.dtype != old.dtype or array.shape[1:] != old.shape[1:]:
            raise RowError(
                f"array {name!r}: must be {old.dtype} {old.shape[1:]} for each row as in the parent; "
                f"got {array.dtype} {array.shape[1:]}"
            )
    return dict(arrays)


def _check_array(name: str, array: NDArray[Any], ids: Sequence[str]) -> None:
    if not isinstance(array, np.ndarray) or array.ndim < 1 or array.dtype.kind not in "biuf":
        raise RowError(f"array {name!r} must be a numpy array of numbers; got {type(array).__name__}")
    if 0 in array.shape[1:]:
        raise RowError(f"array {name!r} must hold at least one number for each row; got {array.shape[1:]}")
    if len(array) != len(ids):
        raise RowError(f"array {name!r}: must have one entry for each of {len(ids)} new rows; got {len(array)}")
    for start in range(0, len(array), BLOCK_ROWS):
        block = array[start : start + BLOCK_ROWS]
        good = np.isfinite(block).reshape(len(block), -1).all(axis=1)
        if not good.all():
            row = ids[start + int(np.argmin(good))]
            raise RowError(f"array {name!r}: row {row!r} holds NaN or infinity (too large for its type?)", row)
