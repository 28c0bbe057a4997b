"""What a writer is given, checked and put on the disk block by block, so that a build needs little memory."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from indexes.errors import MismatchedIndex, RowError, VectorError
from indexes.kinds.checks import BLOCK_ROWS, check_unit
from indexes.kinds.scores import Floats, Mask, Slots
from indexes.store.files import ArrayFile, check_json, encoded, finish
from indexes.store.generation import Generation, mapped
from indexes.store.rows import KEYS, RECORD, Records, Segment, keys_of

RESERVED = {"rows", "table", "order", "embeddings", "vectors", "manifest"}

SPOOLED = ".new"
SPOOLED_TEXT = f"rows{SPOOLED}"

Layouts: TypeAlias = dict[str, tuple[np.dtype[Any], tuple[int, ...]]]
"""Name of a per-row array -> its dtype, and the shape of one row of it."""


@dataclass(frozen=True)
class Block:
    """Rows one after another, and embeddings (F, d) and arrays (F, ...) of those that the parent lacks, in order."""

    rows: Sequence[Mapping[str, Any]]
    embeddings: Floats | None = None
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Kept:
    """Rows of the parent, by number (n,), taken over as they are without being looked at."""

    numbers: Slots


@dataclass(frozen=True)
class Content:
    """Everything that was given.

    parent   the generation that rows were taken from; None where there were none
    new      the new records, None where there are none
    places   (N,) of the rows, in their order: below the parent's record count one of its records, above a new one
    vectors  (F, d) of the new records, None for F = 0. A new record's slot is that of the parent whose vector it
             keeps, or the parent's slot count + the number of its vector here
    """

    parent: Generation | None
    new: Segment | None
    places: Slots
    vectors: Floats | None


class Spool:
    """Takes blocks with `add`, writes what is new to files in `folder`, and gives everything back with `close`."""

    def __init__(self, folder: Path, parent: Generation | None, fingerprint: Mapping[str, str]) -> None:
        self.folder, self.parent, self._fingerprint = folder, parent, dict(fingerprint)
        self._old_records = 0 if parent is None else len(parent.records)
        self._old_slots = 0 if parent is None else len(parent.embeddings)
        self._text = (folder / SPOOLED_TEXT).open("wb")
        self._tables: list[NDArray[Any]] = []
        self._places: list[Slots] = []
        self._vectors: ArrayFile | None = None
        self._arrays: dict[str, ArrayFile] | None = None
        self._records = 0
        self._used = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._text.close()
        for file in self._files():
            file.abandon()

    def add(self, block: Block | Kept) -> None:
        """Take the next rows. Raises `RowError`, `VectorError` or `MismatchedIndex`, naming the row."""
        if isinstance(block, Kept):
            self._use_parent()
            self._places.append(self._kept(block.numbers))
            return
        if not block.rows:
            raise RowError("a block must hold at least one row; got none")
        ids = check_ids(block.rows)
        numbers = self._known(block.rows, ids)
        fresh = numbers < 0
        fresh_ids = [ids[number] for number in np.flatnonzero(fresh)]
        vectors = self._fresh_vectors(block.embeddings, fresh_ids)
        layouts = self._fresh_layouts(block.arrays, fresh_ids)
        places, lines = self._lines(block.rows, ids, numbers)
        new = places < 0
        self._places.append(np.where(new, self._old_records + self._records - 1 + np.cumsum(new), places))
        if new.any():
            self._store(
                lines, [block.rows[number] for number in np.flatnonzero(new).tolist()], numbers[new], len(vectors)
            )
            self._store_arrays(layouts, block.arrays, numbers[new])
        if len(vectors):
            self._store_vectors(vectors)

    def close(self) -> Content:
        """Finish the files, check that everything fits together, and map what was written."""
        if not any(map(len, self._places)):
            raise RowError("an index needs at least one row; got none")
        finish(self._text)
        for file in self._files():
            file.close()
        parent, places = self.parent, np.concatenate(self._places)
        new = self._segment() if self._records else None
        if not self._used:
            parent, places = None, places - self._old_records
            if new is not None:
                new.table["slot"] -= self._old_slots
        _check_distinct(Records([*(parent.records.segments if parent else ()), *([new] if new else ())]), places)
        return Content(parent, new, places, None if self._vectors is None else mapped(self._vectors.path))

    def _files(self) -> list[ArrayFile]:
        return [*([self._vectors] if self._vectors else ()), *(self._arrays or {}).values()]

    def _segment(self) -> Segment:
        arrays = {name: mapped(file.path) for name, file in (self._arrays or {}).items()}
        return Segment(np.memmap(self.folder / SPOOLED_TEXT, np.uint8, "r"), np.concatenate(self._tables), arrays)

    def _kept(self, numbers: Slots) -> Slots:
        places = np.empty(0, np.int64) if self.parent is None else self.parent.rows.places
        if len(numbers) and not (numbers.min() >= 0 and numbers.max() < len(places)):
            raise RowError(f"the parent has rows 0 to {len(places) - 1}; got {numbers.min()} to {numbers.max()}")
        return places[numbers]

    def _use_parent(self) -> None:
        if self.parent is None:
            raise RowError("rows can be kept only from a parent; got none")
        if self.parent.fingerprint != self._fingerprint:
            raise MismatchedIndex(
                f"vectors can be taken over only from an index with the same fingerprint {self._fingerprint}; "
                f"{self.parent.name} has {self.parent.fingerprint}. Build the index without a parent"
            )
        self._used = True
        if self._vectors is not None and self._vectors.row_shape != (self.parent.dim,):
            raise VectorError(f"row vectors must have {self.parent.dim} components; got {self._vectors.row_shape}")
        if self._arrays is not None:
            _check_layouts(_layouts_of_files(self._arrays), self.parent)

    def _known(self, rows: Sequence[Mapping[str, Any]], ids: Sequence[str]) -> Slots:
        """The parent's row (n,) to take each row's vector and arrays from, or -1."""
        if self.parent is None:
            return np.full(len(rows), -1)
        numbers = self.parent.matching(ids, [row.get("digest") for row in rows])
        if not self._used and (numbers >= 0).any():
            self._use_parent()
        return numbers

    def _fresh_vectors(self, embeddings: Floats | None, ids: Sequence[str]) -> Floats:
        count = 0 if embeddings is None else len(embeddings)
        if count != len(ids):
            raise VectorError(f"one embedding is needed for each of the {len(ids)} new rows; got {count}")
        if embeddings is None:
            return np.empty((0, 0), np.float32)
        known = self._vectors.row_shape[0] if self._vectors else self.parent.dim if self.parent and self._used else None
        return check_unit(embeddings, dim=known, names=ids)

    def _fresh_layouts(self, arrays: Mapping[str, NDArray[Any]], ids: Sequence[str]) -> Layouts:
        for name, array in arrays.items():
            check_name(name)
            _check_array(name, array, ids)
        given: Layouts = {name: (array.dtype, array.shape[1:]) for name, array in arrays.items()}
        if not ids and not arrays:
            given = {} if self.parent is None else _layouts_of(self.parent)
        elif self.parent is not None and self._used:
            _check_layouts(given, self.parent)
        if self._arrays is not None and given != _layouts_of_files(self._arrays):
            raise RowError(
                f"every block must have the same arrays; got {given} after {_layouts_of_files(self._arrays)}"
            )
        return given

    def _lines(
        self, rows: Sequence[Mapping[str, Any]], ids: Sequence[str], numbers: Slots
    ) -> tuple[Slots, list[bytes]]:
        """The parent's place of each row (n,), -1 for one whose text it does not have, and the lines of those."""
        places, lines = np.full(len(rows), -1), []
        for number, (row, known) in enumerate(zip(rows, numbers, strict=True)):
            line = _line(row, ids[number])
            place = -1 if self.parent is None or known < 0 else int(self.parent.rows.places[known])
            if self.parent is not None and place >= 0 and self.parent.records.line(place) == line:
                places[number] = place
                continue
            check_json(dict(row), f"row {ids[number]!r}", ids[number])
            lines.append(line)
        return places, lines

    def _store(self, lines: list[bytes], rows: Sequence[Mapping[str, Any]], numbers: Slots, vectors: int) -> None:
        table = np.zeros(len(lines), RECORD)
        for name in KEYS:
            table[name] = keys_of(row.get(name) for row in rows)
        fresh = numbers < 0
        first = self._old_slots + (self._vectors.rows if self._vectors else 0)
        table["slot"][fresh] = np.arange(first, first + vectors)
        if self.parent is not None and not fresh.all():
            table["slot"][~fresh] = self.parent.slots[numbers[~fresh]]
        table["stop"] = self._text.tell() + np.cumsum([len(line) + 1 for line in lines])
        table["start"] = np.concatenate([[self._text.tell()], table["stop"][:-1]])
        self._text.writelines(line + b"\n" for line in lines)
        self._tables.append(table)
        self._records += len(lines)

    def _store_arrays(self, layouts: Layouts, given: Mapping[str, NDArray[Any]], numbers: Slots) -> None:
        if self._arrays is None:
            self._arrays = {name: ArrayFile(self.folder / f"{name}{SPOOLED}", *how) for name, how in layouts.items()}
        fresh = numbers < 0
        for name, file in self._arrays.items():
            block = np.empty((len(numbers), *file.row_shape), file.dtype)
            if fresh.any():
                block[fresh] = given[name]
            if self.parent is not None and not fresh.all():
                block[~fresh] = self.parent.arrays[name][numbers[~fresh]]
            file.append(block)

    def _store_vectors(self, vectors: Floats) -> None:
        if self._vectors is None:
            self._vectors = ArrayFile(self.folder / f"embeddings{SPOOLED}", np.float32, vectors.shape[1:])
        self._vectors.append(vectors)


def check_ids(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The ids of the rows, each a text, or `RowError`."""
    for number, row in enumerate(rows):
        if not isinstance(row.get("id"), str) or not row["id"]:
            raise RowError(f"every row needs a text id; row {number} has {row.get('id')!r}")
    return [row["id"] for row in rows]


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


def _line(row: Mapping[str, Any], name: str) -> bytes:
    try:
        return encoded(dict(row))
    except (ValueError, TypeError, RecursionError) as error:
        raise RowError(f"row {name!r} must be JSON of finite numbers; {error}", name) from error


def _check_distinct(records: Records, places: Slots) -> None:
    keys = records.column("id", places)
    order = np.argsort(keys, kind="stable")
    twice: Mask = keys[order][1:] == keys[order][:-1]
    if twice.any():
        name = json.loads(records.line(int(places[order[int(np.argmax(twice))]])))["id"]
        raise RowError(f"row ids must be distinct; {name!r} comes twice", name)


def _layouts_of(parent: Generation) -> Layouts:
    return {name: (array.dtype, array.shape[1:]) for name, array in parent.arrays.items()}


def _layouts_of_files(files: Mapping[str, ArrayFile]) -> Layouts:
    return {name: (file.dtype, file.row_shape) for name, file in files.items()}


def _check_layouts(given: Layouts, parent: Generation) -> None:
    must = _layouts_of(parent)
    if set(given) != set(must):
        raise RowError(f"the parent has the arrays {sorted(must)}, the new rows have {sorted(given)}")
    for name, (dtype, shape) in given.items():
        if (dtype, shape) != must[name]:
            raise RowError(
                f"array {name!r}: must be {must[name][0]} {must[name][1]} for each row as in the parent; "
                f"got {dtype} {shape}"
            )


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
