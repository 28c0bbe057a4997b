"""An opened generation of an index: rows, vectors, per-row arrays and the search over them."""

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
"""Largest JSON of a document: a constant, plus bytes for each row of the index and of its array documents."""
SHOWN_IDS = 5
MAX_CHECKED_RESULTS = 1000
OLD_SAMPLE_DIVISOR = 16
"""A self-check samples this many times fewer rows of old slots than of new ones (old: reused from the parent)."""


class Generation:
    """An opened generation. It stays usable, with its arrays, when a writer replaces and deletes it on the disk.

    Attributes:
        rows: The N rows in the order in which they were written, parsed on access.
        slots: Slot of each row (N,) int64; rows with equal vectors share a slot.
        embeddings: Unit vectors (S, d) float32, one for each slot, memory-mapped.
        arrays: Name to per-row array (N, ...), memory-mapped.
        documents: Name to JSON document or memory-mapped array.
        manifest: Content of `manifest.json`.
        index: Vector index over the slots.

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
        """Origin of the vectors: digests of the checkpoint and the preprocessing."""
        return self.manifest.fingerprint

    def require(self, expect: Mapping[str, str]) -> None:
        """Check that the fingerprint has these values. Raises `MismatchedIndex` with the first difference."""
        check_fingerprint(self.folder.parent, self.fingerprint, expect)

    def row_number(self, row_id: str) -> int:
        """Return the number of the row with that id. Raises KeyError if there is none."""
        number = int(self.rows.find([row_id])[0])
        if number < 0:
            raise KeyError(row_id)
        return number

    def codes(self, field: str) -> Slots:
        """Return integer labels (N,) of a field: equal for rows with the same text. No row is parsed.

        Labels are numbered from 0 by first appearance, as in `pandas.factorize`.

        Args:
            field: One of `indexes.store.rows.KEYS`.
        """
        _, first, code = np.unique(self.rows.keys(field), return_index=True, return_inverse=True)
        rank = np.empty(len(first), np.int64)
        rank[np.argsort(first)] = np.arange(len(first))
        return rank[code]

    def search(self, queries: Floats, k: int) -> list[tuple[Slots, Floats]]:
        """Return the rows of the best k slots for each query, ordered by (-score, id).

        Args:
            queries: Unit queries (Q, d) float32.
            k: Number of slots.

        Returns:
            For each query, row numbers (n,) and scores (n,) float32. A slot stands for all its rows, so n may exceed k.
        """
        k = check_k(k)
        scores, slots = self.index.search(queries, k + 1, self._live)  # one more shows whether rank k is tied
        return [self._best_rows(*found, k) for found in zip(queries, scores, slots, strict=True)]

    def candidates(self, queries: Floats, k: int) -> list[Slots]:
        """Return the unordered rows (n,) of the best k slots for each query.

        They are the rows of `search`, except that ties at rank k may differ and an approximate kind may return more.

        Args:
            queries: Unit queries (Q, d) float32.
            k: Number of slots.
        """
        return [self._rows_of(slots)[1] for slots in self.index.candidates(queries, k, self._live)]

    def match_rows(self, ids: NDArray[np.bytes_], digests: NDArray[np.bytes_]) -> Slots:
        """Return the row with each pair of id and digest.

        Args:
            ids: Keys (n,) of the ids (`indexes.store.rows.keys_of`).
            digests: Keys (n,) of the digests; an empty key matches nothing.

        Returns:
            Row numbers (n,); -1 for no match.
        """
        numbers = self.rows.by_id.find(ids)
        same = (digests != b"") & (digests == self.rows.by_digest.keys[numbers])
        return np.where((numbers >= 0) & same, numbers, -1)

    def reusable(self, digests: Mapping[str, str | None]) -> dict[str, int]:
        """Return {id: row number} of those {id: digest} that this generation has with the same digest."""
        numbers = self.match_rows(keys_of(digests), keys_of(digests.values())).tolist()
        return {row_id: number for row_id, number in zip(digests, numbers, strict=True) if number >= 0}

    def self_check(self, sample: int = 256, seed: int = 0, *, since: int = 0) -> None:
        """Search for the vectors of sampled rows, and check that each row is found.

        A row passes if a search for its vector ranks the row's slot, or a near-copy with the same score, first. Rows
        that fail with k = 1 are searched again with k = 1 % of the rows (at most `MAX_CHECKED_RESULTS`):
        compressed kinds then rescore more slots exactly.

        Args:
            sample: Number of rows in new slots. Of rows in older slots, `sample` / `OLD_SAMPLE_DIVISOR` are checked.
            seed: Seed of the sample.
            since: First slot that is new in this generation. Earlier slots were checked in the same structure when the
                parent was written.

        Raises:
            SelfRetrievalFailed: Some rows are not found.
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
                f"{len(lost)} of {searched} rows are not found by their own vectors in the {self.manifest.kind} "
                f"index ({shown}); choose the kind flat, or a broader search",
                lost,
            )

    def _rows_not_found(self, numbers: Slots, k: int) -> Slots:
        """Return the rows that are not found: the best score of a search (k slots) is below the row's own score."""
        if not len(numbers):
            return numbers
        own = np.ascontiguousarray(self.embeddings[self.slots[numbers]])
        top = self.index.search(own, k, self._live)[0][:, 0]
        expected = np.array([grid_scores(vector, vector[None])[0] for vector in to_grid(own)])
        return numbers[top < expected]

    def _best_rows(self, query: Floats, scores: Floats, slots: Slots, k: int) -> tuple[Slots, Floats]:
        """Return the rows of the best k of k + 1 slots; ties at rank k are broken by id."""
        fetched = k
        while len(scores) > fetched and scores[fetched] == scores[k - 1]:
            fetched *= 2
            found_scores, found = self.index.search(query[None], fetched + 1, self._live)
            scores, slots = found_scores[0], found[0]
        if fetched == k:
            return self._rows_and_scores(scores[:k], slots[:k])
        rows, row_scores = self._rows_and_scores(scores, slots)
        _, first = np.unique(self.slots[rows], return_index=True)
        is_best = np.isin(self.slots[rows], self.slots[rows[np.sort(first)[:k]]])
        return rows[is_best], row_scores[is_best]

    def _rows_of(self, slots: Slots) -> tuple[Slots, Slots]:
        """Return the number of rows of each slot, and all these rows, slot by slot."""
        counts = self._per_slot[slots]
        offsets = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        return counts, self._by_slot[np.repeat(self._starts[slots], counts) + offsets]

    def _rows_and_scores(self, scores: Floats, slots: Slots) -> tuple[Slots, Floats]:
        """Return all rows of slots, ordered by (-score, id), and their scores."""
        counts, rows = self._rows_of(slots)
        row_scores = np.repeat(scores, counts)
        edges = np.flatnonzero(np.diff(row_scores)) + 1
        starts, ends = np.concatenate([[0], edges]), np.append(edges, len(row_scores))
        tied = ends - starts > 1
        for start, end in zip(starts[tied], ends[tied], strict=True):
            ids = self.rows.ids(rows[start:end])
            rows[start:end] = rows[start:end][sorted(range(len(ids)), key=ids.__getitem__)]
        return rows, row_scores


def check_fingerprint(where: str | Path, fingerprint: Mapping[str, str], expect: Mapping[str, str]) -> None:
    """Check that a fingerprint has these values.

    Args:
        where: The index, for the message.
        fingerprint: Its fingerprint.
        expect: Required values.

    Raises:
        MismatchedIndex: A value differs.
    """
    for key, value in expect.items():
        got = fingerprint.get(key)
        if got != value:
            raise MismatchedIndex(
                f"{where}: the index was made with {key} {got and got[:12]!r}, "
                f"but {value[:12]!r} is required; "
                f"use the model that made it, or {AGAIN}"
            )


def read_generation(folder: Path, *, verify: bool, threads: int | None = None) -> Generation:
    """Open and check a generation's folder, as `IndexStore.open`.

    Args:
        folder: The folder.
        verify: Compare the SHA-256 of the files.
        threads: Number of threads of a search; None for the library's own setting.
    """
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
            raise CorruptIndex(f"{folder}: slots must be from 0 to {counts.slots - 1}; {AGAIN}")
        tombstones = counts.slots - int(np.count_nonzero(np.bincount(slots)))
        got = {"rows": len(slots), "slots": len(embeddings), "tombstones": tombstones, "dim": embeddings.shape[1]}
        expected = {**asdict(counts), "dim": manifest.dim}
        if any(expected[name] != number for name, number in got.items()):
            raise CorruptIndex(f"{folder}: the manifest states {expected}, but the files have {got}; {AGAIN}")
        if verify:
            if not (np.abs(row_norms(embeddings) - 1.0) <= NORM_TOLERANCE).all():
                raise CorruptIndex(f"{folder}: every vector must be finite and have norm 1, but one is not; {AGAIN}")
            if not are_distinct(rows.keys("id")):
                raise CorruptIndex(f"{folder}: the ids of the rows must be distinct, but one occurs twice; {AGAIN}")
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
    except Exception as error:  # damaged files raise various errors: OSError, ValueError, KeyError, SyntaxError
        raise CorruptIndex(f"{folder}: cannot be read ({type(error).__name__}: {error}); {AGAIN}") from error


def max_document_bytes(rows: int, arrays: Iterable[NDArray[Any]]) -> int:
    """Return the size limit of a JSON document, in bytes.

    Args:
        rows: Number of rows of the index.
        arrays: The index's documents that are arrays.
    """
    return min(MAX_JSON_BYTES, DOCUMENT_BYTES + DOCUMENT_BYTES_PER_ROW * (rows + sum(map(len, arrays))))


def _tables(folder: Path, manifest: Manifest) -> tuple[Rows, dict[str, NDArray[Any]], Floats]:
    """Return the rows, per-row arrays and embeddings, memory-mapped."""
    files = {ROWS, TABLE, EMBEDDINGS, *(f"{name}.npy" for name in manifest.arrays)}
    if lacking := sorted(files - set(manifest.files)):
        raise CorruptIndex(f"{folder}: the manifest must list {lacking[0]}, but does not; {AGAIN}")
    # Plain arrays over the mapped files: reading one record of a `np.memmap` takes several times longer.
    text, table = np.asarray(np.memmap(folder / ROWS, np.uint8, "r")), np.asarray(open_array(folder / TABLE))
    arrays = {name: open_array(folder / f"{name}.npy") for name in manifest.arrays}
    expected = {"fields": RECORD} | dict.fromkeys(arrays, len(table))
    got = {"fields": table.dtype} | {name: len(array) for name, array in arrays.items()}
    if got != expected:
        raise CorruptIndex(f"{folder}: the tables must have {expected}, got {got}; {AGAIN}")
    stops = table["stop"]
    if not (np.diff(stops, prepend=0) > 0).all() or stops[-1] != len(text):
        raise CorruptIndex(f"{folder}: the lines of {ROWS} must cover its text exactly, but do not; {AGAIN}")
    return Rows(text, table), arrays, open_array(folder / EMBEDDINGS)
