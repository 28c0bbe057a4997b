"""One generation of an index, opened for reading: rows, vectors, per-row arrays and the search over them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexes import load_kind
from indexes.base import VectorIndex
from indexes.errors import (
    CorruptIndex,
    IndexesError,
    MismatchedIndex,
    ParameterError,
    SelfRetrievalFailed,
    UnsupportedFormat,
)
from indexes.manifest import AGAIN, Manifest, check_files, read_manifest
from indexes.scores import Floats, Mask, Slots, grid_scores, on_grid

ROWS, EMBEDDINGS, STRUCTURE = "rows.jsonl", "embeddings.npy", "vectors.faiss"
SHOWN_IDS = 5


class Generation:
    """What a reader holds. It stays usable, arrays and all, when writers replace and delete it on the disk.

    rows        the N rows as they were written, in their order
    slots       (N,) int64, the slot of each row; rows with equal vectors share one
    embeddings  (S, d) float32 unit vectors, one for each slot, memory-mapped
    arrays      name -> (N, ...) per-row array, memory-mapped
    documents   name -> JSON document
    manifest    what `manifest.json` says
    index       the vector index over the slots
    """

    def __init__(
        self,
        folder: Path,
        manifest: Manifest,
        rows: list[dict[str, Any]],
        slots: Slots,
        embeddings: Floats,
        arrays: Mapping[str, NDArray[Any]],
        documents: Mapping[str, Any],
        index: VectorIndex,
    ) -> None:
        self.folder, self.manifest = folder, manifest
        self.rows, self.slots, self.embeddings = rows, slots, embeddings
        self.arrays, self.documents, self.index = arrays, documents, index
        self._number = {row["id"]: number for number, row in enumerate(rows)}
        self._id_rank = np.empty(len(rows), dtype=np.int64)
        self._id_rank[sorted(range(len(rows)), key=lambda number: str(rows[number]["id"]))] = np.arange(len(rows))
        self._by_slot = np.argsort(slots, kind="stable")
        self._per_slot = np.bincount(slots, minlength=len(embeddings))
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
        for key, value in expect.items():
            got = self.fingerprint.get(key)
            if got != value:
                raise MismatchedIndex(
                    f"{self.folder.parent}: the index was made with {key} {got and got[:12]!r}, "
                    f"asked for is {value[:12]!r}; "
                    f"use what made it, or {AGAIN}"
                )

    def row_number(self, row_id: str) -> int:
        """The number of the row with that id; KeyError where there is none."""
        return self._number[row_id]

    def search(self, queries: Floats, k: int) -> list[tuple[Slots, Floats]]:
        """For each unit query (Q, d) the rows of the best k slots: row numbers (n,) and scores (n,) float32.

        A slot stands for all its rows, so n may exceed k. Order: (-score, id).
        """
        scores, slots = self.index.search(queries, k, self._live)
        return [self._expanded(*pair) for pair in zip(scores, slots, strict=True)]

    def reusable(self, wanted: Mapping[str, str | None]) -> dict[str, int]:
        """Of the wanted {id: digest}, those that this generation holds with that digest: {id: row number}."""
        return {
            row_id: self._number[row_id]
            for row_id, digest in wanted.items()
            if digest is not None and row_id in self._number and self.rows[self._number[row_id]].get("digest") == digest
        }

    def self_check(self, sample: int = 256, seed: int = 0) -> None:
        """Search for the vectors of `sample` rows; `SelfRetrievalFailed` names those that do not come first.

        A row passes when its slot, or one that scores as high (a near-copy), is at rank 1.
        """
        drawn = np.random.default_rng(seed).permutation(self.count)[:sample]
        if not len(drawn):
            return
        own = np.ascontiguousarray(self.embeddings[self.slots[drawn]])
        top = self.index.search(own, 1, self._live)[0][:, 0]
        gridded = on_grid(own)
        must = np.array([grid_scores(vector, vector[None])[0] for vector in gridded])
        lost = sorted(self.rows[number]["id"] for number in drawn[top < must])
        if lost:
            shown = ", ".join(lost[:SHOWN_IDS]) + (", ..." if len(lost) > SHOWN_IDS else "")
            raise SelfRetrievalFailed(
                f"{len(lost)} of {len(drawn)} rows do not find themselves in the {self.manifest.kind} index "
                f"({shown}); choose the kind flat, or a broader search",
                lost,
            )

    def _expanded(self, scores: Floats, slots: Slots) -> tuple[Slots, Floats]:
        counts = self._per_slot[slots]
        spread = np.repeat(scores, counts)
        inside = np.arange(len(spread)) - np.repeat(np.cumsum(counts) - counts, counts)
        rows = self._by_slot[np.repeat(self._starts[slots], counts) + inside]
        order = np.lexsort((self._id_rank[rows], -spread))
        return rows[order], spread[order]


def read_generation(folder: Path, *, verify: bool, threads: int | None = None) -> Generation:
    """Open a generation's folder, checked as `IndexStore.open` says."""
    manifest = read_manifest(folder)
    check_files(folder, manifest, verify=verify)
    try:
        rows, slots = _read_rows(folder / ROWS)
        embeddings = _mapped(folder / EMBEDDINGS)
        arrays = {name: _mapped(folder / f"{name}.npy") for name in manifest.arrays}
        documents = {name: json.loads((folder / f"{name}.json").read_bytes()) for name in manifest.documents}
        _check_counts(manifest, slots, embeddings, arrays)
        index = _read_index(folder, manifest, embeddings, threads)
        return Generation(folder, manifest, rows, slots, embeddings, arrays, documents, index)
    except ParameterError as error:
        raise UnsupportedFormat(f"{folder}: {error}. Update the software, or {AGAIN}") from error
    except IndexesError:
        raise
    except Exception as error:  # damaged files raise anything: OSError, ValueError, KeyError, SyntaxError
        raise CorruptIndex(f"{folder}: cannot be read ({type(error).__name__}: {error}); {AGAIN}") from error


def _read_rows(path: Path) -> tuple[list[dict[str, Any]], Slots]:
    rows = [json.loads(line) for line in path.read_bytes().split(b"\n")[:-1]]
    return rows, np.array([row.pop("slot") for row in rows], dtype=np.int64)


def _mapped(path: Path) -> NDArray[Any]:
    array: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    return array


def _check_counts(manifest: Manifest, slots: Slots, embeddings: Floats, arrays: Mapping[str, NDArray[Any]]) -> None:
    counts = manifest.counts
    empty = counts.slots - len(np.unique(slots))
    got = {
        "rows": len(slots),
        "slots": len(embeddings),
        "tombstones": empty,
        "components": embeddings.shape[1],
    }
    must = {
        "rows": counts.rows,
        "slots": counts.slots,
        "tombstones": counts.tombstones,
        "components": manifest.dim,
    }
    for name, array in arrays.items():
        got[name], must[name] = len(array), counts.rows
    if got != must or slots.min() < 0 or slots.max() >= counts.slots:
        raise CorruptIndex(f"{manifest.generation}: the manifest says {must}, the files hold {got}; {AGAIN}")


def _read_index(folder: Path, manifest: Manifest, embeddings: Floats, threads: int | None) -> VectorIndex:
    kind = load_kind(manifest.kind)
    parameters = kind.parameters_from(manifest.parameters)
    path = folder / STRUCTURE if kind.structure_file else None
    return kind.load(path, embeddings, parameters, seed=manifest.seed, threads=threads)
