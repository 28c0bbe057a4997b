"""One generation of an index, opened for reading: rows, vectors, per-row arrays and the search over them."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.files import MAX_JSON_BYTES, read_json
from indexes import load_kind
from indexes.errors import (
    AGAIN,
    CorruptIndex,
    IndexesError,
    MismatchedIndex,
    ParameterError,
    SelfRetrievalFailed,
    UnsupportedFormat,
)
from indexes.kinds.checks import NORM_TOLERANCE, check_k, row_norms
from indexes.kinds.scores import Floats, Mask, Slots, grid_scores, to_grid
from indexes.kinds.vector_index import VectorIndex
from indexes.store.arrays import open_array
from indexes.store.manifest import Manifest, check_files, read_manifest
from indexes.store.rows import RECORD, Rows, are_distinct, keys_of

ROWS, TABLE, EMBEDDINGS, STRUCTURE = "rows.jsonl", "table.npy", "embeddings.npy", "vectors.faiss"
DOCUMENT_BYTES, DOCUMENT_BYTES_PER_ROW = 2**18, 2**12
"""Of the JSON of a document: of any, and for each row or touch that it may speak of."""
SHOWN_IDS = 5
MAX_CHECKED_RESULTS = 1000
OLD_SAMPLE_DIVISOR = 16
"""How many times fewer rows are checked where a parent's rows were."""


class Generation:
    """What a reader holds. It stays usable, arrays and all, when writers replace and delete it on the disk.

    rows        the N rows as they were written, in their order, each parsed when it is asked for
    slots       (N,) int64, the slot of each row; rows with equal vectors share one
    embeddings  (S, d) float32 unit vectors, one for each slot, memory-mapped
    arrays      name -> (N, ...) per-row array, memory-mapped
    documents   name -> JSON document, or array that is of no row, memory-mapped
    manifest    what `manifest.json` says
    index       the vector index over the slots

    >>> import numpy as np
    >>> rows = [{"id": "mug/1.jpg", "object_id": "mug"}, {"id": "tin/1.jpg", "object_id": "tin"}]
    >>> generation = indexes.IndexStore("searched").write(rows, np.eye(2, dtype=np.float32), fingerprint={})
    >>> numbers, scores = generation.search(np.float32([[0.6, 0.8]]), 1)[0]
    >>> generation.rows[int(numbers[0])]["object_id"], round(float(scores[0]), 3)
    ('tin', 0.8)
    """

    def __init__(
        self,
        folder: Path,
        manifest: Manifest,
        rows: Rows,
        arrays: Mapping[str, NDArray[Any]],
        documents: Mapping[str, Any],
        index: VectorIndex,
    ) -> None:
        self.folder, self.manifest, self.rows, self.documents, self.index = folder, manifest, rows, documents, index
        self.arrays, self.embeddings = dict(arrays), index.vectors
        self.slots: Slots = np.ascontiguousarray(rows.table["slot"])
        self._by_slot = np.argsort(self.slots, kind="stable")
        self._per_slot = np.bincount(self.slots, minlength=len(self.embeddings))
        self._starts = np.cumsum(self._per_slot) - self._per_slot
        self._live: Mask | None = None if self._per_slot.all() else self._per_slot > 0

    @property
    def name(self) -> str:
        """The generation's name, such as gen-000007."""
        return self.manifest.generation

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.rows)

    @property
    def dim(self) -> int:
        """Number of components of a vector."""
        return self.manifest.dim

    @property
    def fingerprint(self) -> dict[str, str]:
        """What made the vectors."""
        return self.manifest.fingerprint

    def require(self, expect: Mapping[str, str]) -> None:
        """Check that the fingerprint has these values. Raises `MismatchedIndex` naming what differs."""
        check_fingerprint(self.folder.parent, self.fingerprint, expect)

    def row_number(self, row_id: str) -> int:
        """The number of the row with that id; KeyError where there is none."""
        number = int(self.rows.find([row_id])[0])
        if number < 0:
            raise KeyError(row_id)
        return number

    def codes(self, field: str) -> Slots:
        """For each row (N,) a number that rows share when their `field` is the same text; no row is parsed.

        field is one of `indexes.store.rows.KEYS`; numbers count up from 0 in the order of the rows that have them
        first.
        """
        _, first, code = np.unique(self.rows.keys(field), return_index=True, return_inverse=True)
        rank = np.empty(len(first), np.int64)
        rank[np.argsort(first)] = np.arange(len(first))
        return rank[code]

    def search(self, queries: Floats, k: int) -> list[tuple[Slots, Floats]]:
        """For each unit query (Q, d) the rows of the best k slots: row numbers (n,) and scores (n,) float32.

        A slot stands for all its rows, so n may exceed k. Order: (-score, id).
        """
        k = check_k(k)
        scores, slots = self.index.search(queries, k + 1, self._live)
        return [self._best_rows(*found, k) for found in zip(queries, scores, slots, strict=True)]

    def candidates(self, queries: Floats, k: int) -> list[Slots]:
        """For each unit query (Q, d) the rows (n,) of the best k slots, in no order: those of `search`, but for slots
        that tie for the last place, and of an approximate kind perhaps more.
        """
        return [self._rows_of(slots)[1] for slots in self.index.candidates(queries, k, self._live)]

    def match_rows(self, ids: NDArray[np.bytes_], digests: NDArray[np.bytes_]) -> Slots:
        """For the keys of each id and digest (`indexes.store.rows.keys_of`) the row (n,) that has both; -1 where there
        is none, or no digest.
        """
        numbers = self.rows.by_id.find(ids)
        same = (digests != b"") & (digests == self.rows.by_digest.keys[numbers])
        return np.where((numbers >= 0) & same, numbers, -1)

    def reusable(self, wanted: Mapping[str, str | None]) -> dict[str, int]:
        """Of the wanted {id: digest}, those that this generation holds with that digest: {id: row number}."""
        numbers = self.match_rows(keys_of(wanted), keys_of(wanted.values())).tolist()
        return {row_id: number for row_id, number in zip(wanted, numbers, strict=True) if number >= 0}

    def self_check(self, sample: int = 256, seed: int = 0, *, since: int = 0) -> None:
        """Search for the vectors of `sample` rows; `SelfRetrievalFailed` names those that do not come first.

        since: the first of the slots that an earlier generation has not had in the same structure, and checked so; of
        rows in others only a few are searched for.
        A row passes when its slot, or one that scores as high (a near-copy), is at rank 1. Where a search for one
        misses it, one for a hundredth of all rows may find it: candidates are asked for by the hundred, and codes
        cannot tell near-copies apart.
        """
        mixed = np.random.default_rng(seed).permutation(self.count)
        new = self.slots[mixed] >= since
        drawn = np.concatenate([mixed[new][:sample], mixed[~new][: sample // OLD_SAMPLE_DIVISOR]])
        searched = len(drawn)
        for k in sorted({1, max(1, min(MAX_CHECKED_RESULTS, self.count // 100))}):
            drawn = self._rows_not_found(drawn, k)
        lost = sorted(self.rows.ids(drawn))
        if lost:
            shown = ", ".join(lost[:SHOWN_IDS]) + (", ..." if len(lost) > SHOWN_IDS else "")
            raise SelfRetrievalFailed(
                f"{len(lost)} of {searched} rows do not find themselves in the {self.manifest.kind} "
                f"index ({shown}); choose the kind flat, or a broader search",
                lost,
            )

    def _rows_not_found(self, numbers: Slots, k: int) -> Slots:
        """Those of the rows for whose vectors a search for k slots puts a worse one first."""
        if not len(numbers):
            return numbers
        own = np.ascontiguousarray(self.embeddings[self.slots[numbers]])
        top = self.index.search(own, k, self._live)[0][:, 0]
        must = np.array([grid_scores(vector, vector[None])[0] for vector in to_grid(own)])
        return numbers[top < must]

    def _best_rows(self, query: Floats, scores: Floats, slots: Slots, k: int) -> tuple[Slots, Floats]:
        """The rows of the best k of k + 1 slots; where slots tie for the last place, their ids say which stays."""
        wanted = k
        while len(scores) > wanted and scores[wanted] == scores[k - 1]:
            wanted *= 2
            found_scores, found = self.index.search(query[None], wanted + 1, self._live)
            scores, slots = found_scores[0], found[0]
        if wanted == k:
            return self._rows_and_scores(scores[:k], slots[:k])
        rows, spread = self._rows_and_scores(scores, slots)
        _, first = np.unique(self.slots[rows], return_index=True)
        stay = np.isin(self.slots[rows], self.slots[rows[np.sort(first)[:k]]])
        return rows[stay], spread[stay]

    def _rows_of(self, slots: Slots) -> tuple[Slots, Slots]:
        """How many rows each slot has, and all of them, slot by slot."""
        counts = self._per_slot[slots]
        inside = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        return counts, self._by_slot[np.repeat(self._starts[slots], counts) + inside]

    def _rows_and_scores(self, scores: Floats, slots: Slots) -> tuple[Slots, Floats]:
        """All rows of slots in the order of their scores, and their scores; equal scores in the order of ids."""
        counts, rows = self._rows_of(slots)
        spread = np.repeat(scores, counts)
        edges = np.flatnonzero(np.diff(spread)) + 1
        starts, ends = np.concatenate([[0], edges]), np.append(edges, len(spread))
        tied = ends - starts > 1
        for start, end in zip(starts[tied], ends[tied], strict=True):
            ids = self.rows.ids(rows[start:end])
            rows[start:end] = rows[start:end][sorted(range(len(ids)), key=ids.__getitem__)]
        return rows, spread


def check_fingerprint(where: str | Path, fingerprint: Mapping[str, str], expect: Mapping[str, str]) -> None:
    """Check that a fingerprint has these values. Raises `MismatchedIndex` naming what differs."""
    for key, value in expect.items():
        got = fingerprint.get(key)
        if got != value:
            raise MismatchedIndex(
                f"{where}: the index was made with {key} {got and got[:12]!r}, "
                f"asked for is {value[:12]!r}; "
                f"use what made it, or {AGAIN}"
            )


def read_generation(folder: Path, *, verify: bool, threads: int | None = None) -> Generation:
    """Open a generation's folder, checked as `IndexStore.open` says."""
    manifest = read_manifest(folder)
    check_files(folder, manifest, verify=verify)
    try:
        rows, arrays, embeddings = _tables(folder, manifest)
        files, names = manifest.files, manifest.documents
        documents: dict[str, Any] = {
            name: open_array(folder / f"{name}.npy") for name in names if f"{name}.npy" in files
        }
        max_bytes = max_document_bytes(manifest.counts.rows, documents.values())
        documents |= {name: read_json(folder / f"{name}.json", max_bytes) for name in names if name not in documents}
        counts, slots = manifest.counts, rows.table["slot"]
        if slots.min() < 0 or slots.max() >= counts.slots:
            raise CorruptIndex(f"{folder}: slots must be below {counts.slots}, are not; {AGAIN}")
        tombstones = counts.slots - int(np.count_nonzero(np.bincount(slots)))
        got = {"rows": len(slots), "slots": len(embeddings), "tombstones": tombstones, "dim": embeddings.shape[1]}
        must = {**asdict(counts), "dim": manifest.dim}
        if any(must[name] != number for name, number in got.items()):
            raise CorruptIndex(f"{folder}: the manifest says {must}, the files hold {got}; {AGAIN}")
        if verify:
            if not (np.abs(row_norms(embeddings) - 1.0) <= NORM_TOLERANCE).all():
                raise CorruptIndex(f"{folder}: every vector must be finite and of norm 1, one is not; {AGAIN}")
            if not are_distinct(rows.keys("id")):
                raise CorruptIndex(f"{folder}: the ids of the rows must be distinct, one comes twice; {AGAIN}")
        kind = load_kind(manifest.kind)
        index = kind.load(
            folder / STRUCTURE if kind.structure_file else None,
            embeddings,
            kind.parameters_from(manifest.parameters),
            seed=manifest.seed,
            threads=threads,
        )
        return Generation(folder, manifest, rows, arrays, documents, index)
    except ParameterError as error:
        raise UnsupportedFormat(f"{folder}: {error}. Update the software, or {AGAIN}") from error
    except IndexesError:
        raise
    except Exception as error:  # damaged files raise anything: OSError, ValueError, KeyError, SyntaxError
        raise CorruptIndex(f"{folder}: cannot be read ({type(error).__name__}: {error}); {AGAIN}") from error


def max_document_bytes(rows: int, arrays: Iterable[NDArray[Any]]) -> int:
    """How many bytes of JSON a document may have, in an index of so many rows with these documents that are arrays."""
    return min(MAX_JSON_BYTES, DOCUMENT_BYTES + DOCUMENT_BYTES_PER_ROW * (rows + sum(map(len, arrays))))


def _tables(folder: Path, manifest: Manifest) -> tuple[Rows, dict[str, NDArray[Any]], Floats]:
    """The rows, per-row arrays and embeddings, memory-mapped."""
    files = {ROWS, TABLE, EMBEDDINGS, *(f"{name}.npy" for name in manifest.arrays)}
    if lacking := sorted(files - set(manifest.files)):
        raise CorruptIndex(f"{folder}: the manifest must list {lacking[0]}, and does not; {AGAIN}")
    # Plain arrays over the mapped files: taking one record out of a `np.memmap` costs several times more.
    text, table = np.asarray(np.memmap(folder / ROWS, np.uint8, "r")), np.asarray(open_array(folder / TABLE))
    arrays = {name: open_array(folder / f"{name}.npy") for name in manifest.arrays}
    must = {"fields": RECORD} | dict.fromkeys(arrays, len(table))
    got = {"fields": table.dtype} | {name: len(array) for name, array in arrays.items()}
    if got != must:
        raise CorruptIndex(f"{folder}: the tables must hold {must}, hold {got}; {AGAIN}")
    stops = table["stop"]
    if not (np.diff(stops, prepend=0) > 0).all() or stops[-1] != len(text):
        raise CorruptIndex(f"{folder}: the lines of {ROWS} must make up its text, and do not; {AGAIN}")
    return Rows(text, table), arrays, open_array(folder / EMBEDDINGS)
