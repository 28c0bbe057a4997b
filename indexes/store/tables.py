"""The tables of a new generation: rows, vectors and arrays, checked and written block by block."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.files import finish
from indexes.errors import MismatchedIndex, RowError, VectorError
from indexes.kinds.checks import BLOCK_ROWS, check_unit
from indexes.kinds.scores import Floats, Slots
from indexes.store.arrays import ArrayFile, open_array, write_array
from indexes.store.equal import first_equal_rows
from indexes.store.generation import EMBEDDINGS, ROWS, TABLE, Generation
from indexes.store.rows import KEYS, MAX_LINE_BYTES, RECORD, are_distinct, json_of, keys_of

MAX_TOMBSTONE_FRACTION = 0.10
"""If more than this fraction of the slots has no row, slots are renumbered and the structure is rebuilt."""

RESERVED = {"rows", "table", "embeddings", "vectors", "manifest"}

Layouts: TypeAlias = dict[str, tuple[np.dtype[Any], tuple[int, ...]]]
"""Name of a per-row array to its dtype and the shape of one row."""


@dataclass(frozen=True)
class Block:
    """Consecutive rows, with embeddings (F, d) and arrays (F, ...) of those that the parent lacks, in their order."""

    rows: Sequence[Mapping[str, Any]]
    embeddings: Floats | None = None
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Tables:
    """Written tables of a new generation, memory-mapped.

    Attributes:
        vectors: Vectors (S, d), one for each slot; a slot may have no row.
        slots: Slot of each row (N,).
        objects: Keys (N,) of the rows' "object_id" (`indexes.store.rows`).
        arrays: Name to per-row array (N, ...).
        parent: Generation from which rows were reused; None if no row was reused.
        renumbered: Whether the slots have other numbers than in the parent.
    """

    vectors: Floats
    slots: Slots
    objects: NDArray[np.bytes_]
    arrays: Mapping[str, NDArray[Any]]
    parent: Generation | None
    renumbered: bool


class TableWriter:
    """Writes blocks of rows (`add`) and the parent's rows (`add_parent_rows`) to `folder`; `close` maps the files.

    Rows are written once, in order. The file of embeddings starts with those of the parent; new ones follow. The file
    is rewritten at the end if a new vector equals an earlier one, or if slots are renumbered: because too many have no
    row, or because no row of the parent was reused.
    """

    def __init__(self, folder: Path, parent: Generation | None, fingerprint: Mapping[str, str]) -> None:
        self.folder, self.parent, self._fingerprint = folder, parent, dict(fingerprint)
        self._fits = parent is not None and parent.fingerprint == self._fingerprint
        self._used = False
        self._records: list[NDArray[Any]] = []
        self._arrays: dict[str, ArrayFile] | None = None
        self._vectors: ArrayFile | None = None
        self._text = (folder / ROWS).open("wb")
        if parent is not None and self._fits:
            self._add_vectors(parent.embeddings)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._text.close()
        for file in self._array_files():
            file.abandon()

    def add(self, block: Block) -> None:
        """Append rows. Raises `RowError`, `VectorError` or `MismatchedIndex` with the id of the row."""
        if not block.rows:
            raise RowError("a block must have at least one row; got none")
        ids: list[Any] = [row.get("id") for row in block.rows]
        if odd := [name for name in ids if not isinstance(name, str) or not name]:
            raise RowError(f"every row needs a text id; row {ids.index(odd[0])} has {odd[0]!r}")
        numbers = np.full(len(ids), -1)  # rows of the parent whose vectors and arrays are reused
        if self.parent is not None:
            numbers = self.parent.match_rows(keys_of(ids), keys_of(row.get("digest") for row in block.rows))
        known = numbers >= 0
        if self.parent is not None and known.any():
            self._require_fit(self.parent)
        fresh_ids = [ids[number] for number in np.flatnonzero(~known)]
        count = 0 if block.embeddings is None else len(block.embeddings)
        if count != len(fresh_ids):
            raise VectorError(f"one embedding is needed for each of the {len(fresh_ids)} new rows; got {count}")
        records = np.zeros(len(ids), RECORD)
        if self.parent is not None and known.any():
            records["slot"][known] = self.parent.slots[numbers[known]]
        if block.embeddings is not None and count:
            dim = self._vectors.row_shape[0] if self._vectors else None
            vectors = check_unit(block.embeddings, dim=dim, names=fresh_ids)
            first = self._vectors.rows if self._vectors else 0
            records["slot"][~known] = np.arange(first, first + count)
            self._add_vectors(vectors)
        self._add_arrays(block.arrays, numbers, fresh_ids)
        self._add_lines(block.rows, ids, numbers, records)

    def add_parent_rows(self, numbers: range) -> None:
        """Append rows of the parent unchanged.

        Args:
            numbers: Their row numbers, with a step of 1.

        Raises:
            RowError: There is no parent, or the range is empty.
            MismatchedIndex: The parent has another fingerprint.
        """
        parent = self.parent
        if parent is None or not numbers:
            raise RowError("copying rows needs a parent and at least one row number")
        self._require_fit(parent)
        span = slice(numbers.start, numbers.stop)
        self._open_arrays(parent.arrays)
        for name, file in (self._arrays or {}).items():
            file.append(parent.arrays[name][span])
        records, first = parent.rows.table[span].copy(), parent.rows.start(numbers.start)
        text = parent.rows.text[first : int(records["stop"][-1])]
        records["stop"] += self._text.tell() - first
        self._text.write(text.data)
        self._records.append(records)

    def close(self) -> Tables:
        """Finish the files, check their consistency, and return them memory-mapped. Raises `RowError`."""
        if self._vectors is None or not self._records:
            raise RowError("an index needs at least one row; got none")
        finish(self._text)
        for file in self._array_files():
            file.close()
        table = np.concatenate(self._records)
        self._check_distinct(table)
        renumbered = self._number_slots(table)
        write_array(self.folder / TABLE, RECORD, (), [table])
        arrays = {name: open_array(file.path) for name, file in (self._arrays or {}).items()}
        parent = self.parent if self._used else None
        slots, objects = (np.ascontiguousarray(table[name]) for name in ("slot", "object_id"))
        return Tables(open_array(self._vectors.path), slots, objects, arrays, parent, renumbered)

    def _array_files(self) -> list[ArrayFile]:
        return [*([self._vectors] if self._vectors else ()), *(self._arrays or {}).values()]

    def _require_fit(self, parent: Generation) -> None:
        """Check that the parent's rows are reusable: its fingerprint must be equal."""
        if not self._fits:
            raise MismatchedIndex(
                f"vectors can be reused only from an index with the same fingerprint {self._fingerprint}; "
                f"{parent.name} has {parent.fingerprint}. Build the index without a parent"
            )
        self._used = True

    def _add_vectors(self, vectors: Floats) -> None:
        if self._vectors is None:
            self._vectors = ArrayFile(self.folder / EMBEDDINGS, np.float32, vectors.shape[1:])
        self._vectors.append(vectors)

    def _add_arrays(self, fresh: Mapping[str, NDArray[Any]], numbers: Slots, fresh_ids: Sequence[str]) -> None:
        """Write the arrays of a block: `fresh` for its new rows, the parent's arrays for the others."""
        for name, array in fresh.items():
            check_name(name)
            _check_array(name, array, fresh_ids)
        known = numbers >= 0
        if self.parent is not None and known.any():
            self._open_arrays(self.parent.arrays)
        if fresh_ids or fresh:
            self._open_arrays(fresh)
        for name, file in (self._arrays or {}).items():
            block = np.empty((len(numbers), *file.row_shape), file.dtype)
            if fresh_ids:
                block[~known] = fresh[name]
            if self.parent is not None and known.any():
                block[known] = self.parent.arrays[name][numbers[known]]
            file.append(block)

    def _open_arrays(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Open files for these arrays, whose names, dtypes and shapes must match those of earlier rows."""
        got: Layouts = {name: (array.dtype, array.shape[1:]) for name, array in arrays.items()}
        if self._arrays is None:
            self._arrays = {name: ArrayFile(self.folder / f"{name}.npy", *how) for name, how in got.items()}
        must = {name: (file.dtype, file.row_shape) for name, file in self._arrays.items()}
        if got != must:
            got_text, must_text = (
                ", ".join(f"{name} {dtype} {shape}" for name, (dtype, shape) in sorted(each.items())) or "none"
                for each in (got, must)
            )
            raise RowError(f"all rows, including the parent's, must have the same arrays: {must_text}; got {got_text}")

    def _add_lines(
        self, rows: Sequence[Mapping[str, Any]], ids: Sequence[str], numbers: Slots, records: NDArray[Any]
    ) -> None:
        """Write the rows as text, and fill in their records except for the slots."""
        lines, same = [], np.zeros(len(rows), bool)
        for place, (row, name, number) in enumerate(zip(rows, ids, numbers.tolist(), strict=True)):
            before = b"" if self.parent is None or number < 0 else self.parent.rows.line(number)
            line = json_of(dict(row), f"row {name!r}", name, checked=before)
            if len(line) >= MAX_LINE_BYTES:
                raise RowError(f"row {name!r} must have less than {MAX_LINE_BYTES} bytes, got {len(line)}", name)
            lines.append(line + b"\n")
            same[place] = line == before
        for name in KEYS:
            if self.parent is not None and same.any():
                records[name][same] = self.parent.rows.table[name][numbers[same]]
            records[name][~same] = keys_of(rows[place].get(name) for place in np.flatnonzero(~same).tolist())
        records["stop"] = self._text.tell() + np.cumsum([len(line) for line in lines])
        self._text.writelines(lines)
        self._records.append(records)

    def _check_distinct(self, table: NDArray[Any]) -> None:
        keys = np.ascontiguousarray(table["id"])
        if are_distinct(keys):
            return
        order = np.argsort(keys, kind="stable")
        number = int(order[int(np.argmax(keys[order][1:] == keys[order][:-1]))])
        with (self.folder / ROWS).open("rb") as text:
            text.seek(int(table["stop"][number - 1]) if number else 0)
            name = json.loads(text.readline())["id"]
        raise RowError(f"row ids must be distinct; {name!r} occurs twice", name)

    def _number_slots(self, table: NDArray[Any]) -> bool:
        """Merge equal vectors into one slot, in the table and in the file.

        A structure cannot delete vectors, so the parent's slots are kept even if they have no rows. If more than
        `MAX_TOMBSTONE_FRACTION` of all slots have no row, or no row of the parent was reused, slots are renumbered in
        the order of the rows, and the empty ones are dropped.

        Returns:
            Whether the parent's slots have other numbers.
        """
        if self._vectors is None:
            return False
        vectors = open_array(self._vectors.path)
        slots = first_equal_rows(vectors)[table["slot"]]
        stay = np.zeros(len(vectors), bool)
        stay[slots] = True
        used = np.count_nonzero(stay)
        if self.parent is not None and self._fits:
            stay[: len(self.parent.embeddings)] = True
        live_slots = np.flatnonzero(stay)
        renumbered = not self._used or len(live_slots) - int(used) > MAX_TOMBSTONE_FRACTION * len(live_slots)
        if renumbered:
            distinct, first = np.unique(slots, return_index=True)
            live_slots = distinct[np.argsort(first)]
        number_of = np.full(len(vectors), -1)
        number_of[live_slots] = np.arange(len(live_slots))
        table["slot"] = number_of[slots]
        if not np.array_equal(live_slots, np.arange(len(vectors))):
            new_path = self._vectors.path.with_suffix(".new")
            blocks = (
                vectors[live_slots[start : start + BLOCK_ROWS]] for start in range(0, len(live_slots), BLOCK_ROWS)
            )
            write_array(new_path, np.float32, vectors.shape[1:], blocks)
            new_path.replace(self._vectors.path)
        return renumbered


def check_documents(documents: Mapping[str, Any]) -> dict[str, Any]:
    """Return the documents after checking their names, and that they are JSON or arrays of finite numbers.

    Raises:
        RowError: A document is invalid.
    """
    for name, document in documents.items():
        check_name(name)
        if not isinstance(document, np.ndarray):
            json_of(document, f"document {name!r}")
        elif document.dtype.kind not in "biuf" or not np.isfinite(document).all():
            raise RowError(f"document {name!r}: an array must contain finite numbers; got {document.dtype}")
        elif document.ndim < 1 or 0 in document.shape[1:]:
            raise RowError(f"document {name!r}: an array must have rows of numbers; got shape {document.shape}")
    return dict(documents)


def check_name(name: str) -> None:
    """Check that `name` can be a file name in a generation. Raises `RowError`."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or name in RESERVED:
        raise RowError(
            f"names of arrays and documents must be lower-case words, not {', '.join(sorted(RESERVED))}; got {name!r}"
        )


def _check_array(name: str, array: NDArray[Any], ids: Sequence[str]) -> None:
    if not isinstance(array, np.ndarray) or array.ndim < 1 or array.dtype.kind not in "biuf":
        raise RowError(f"array {name!r} must be a numpy array of numbers; got {type(array).__name__}")
    if 0 in array.shape[1:]:
        raise RowError(f"array {name!r} must have at least one number for each row; got shape {array.shape[1:]}")
    if len(array) != len(ids):
        raise RowError(f"array {name!r}: must have one entry for each of {len(ids)} new rows; got {len(array)}")
    finite = np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    if not finite.all():
        row = ids[int(np.argmin(finite))]
        raise RowError(f"array {name!r}: row {row!r} has NaN or infinity (too large for its type?)", row)
