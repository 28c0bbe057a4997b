"""Writing of a generation's folder, the manifest last."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from _touch_retrieval import files
from indexes import load_kind
from indexes.errors import RowError
from indexes.kinds.measure import recall_against_exact, sample_queries
from indexes.kinds.scores import Floats
from indexes.kinds.vector_index import Parameters, VectorIndex
from indexes.store.arrays import write_array
from indexes.store.generation import STRUCTURE, Generation, max_document_bytes
from indexes.store.manifest import Counts, Manifest, file_checksums, write_manifest
from indexes.store.rows import json_of
from indexes.store.tables import Block, Tables, TableWriter

RECALL_AT = 10
RECALL_QUERIES = 100


@dataclass(frozen=True)
class KindChoice:
    """A chosen kind, its parameters, and manifest entries about the choice."""

    kind: str
    parameters: Parameters
    about: Mapping[str, Any]


KindChooser = Callable[[Tables], KindChoice]
"""Chooses the kind of an index from its tables."""


@dataclass(frozen=True)
class WriteJob:
    """Settings of a new generation, without its rows (`indexes.store.folder.IndexStore.write_blocks`)."""

    documents: dict[str, Any]
    fingerprint: dict[str, str]
    about: dict[str, Any]
    kind: type[VectorIndex]
    requested: Parameters
    parent: Generation | None
    software: str
    seed: int
    threads: int | None
    choose_kind: KindChooser | None = None
    queries: Floats | None = None


def write_generation(folder: Path, name: str, blocks: Iterable[Block | range], job: WriteJob) -> int:
    """Write a generation into an empty folder.

    Args:
        folder: The folder.
        name: Name of the generation.
        blocks: Blocks of rows, and ranges of the parent's rows.
        job: The settings.

    Returns:
        Number of leading slots in the structure reused from the parent; 0 if it was built anew.
    """
    with TableWriter(folder, job.parent, job.fingerprint) as writer:
        for block in blocks:
            if isinstance(block, range):
                writer.add_parent_rows(block)
            else:
                writer.add(block)
        tables = writer.close()
    clash = sorted(set(job.documents) & set(tables.arrays))
    if clash:
        raise RowError(f"an array and a document must have different names; got {', '.join(clash)}")
    arrays = {document: content for document, content in job.documents.items() if isinstance(content, np.ndarray)}
    max_bytes = max_document_bytes(len(tables.slots), arrays.values())
    for document, content in job.documents.items():
        if document in arrays:
            write_array(folder / f"{document}.npy", content.dtype, content.shape[1:], [content])
            continue
        text = files.encoded(content, indent=2) + b"\n"
        if len(text) > max_bytes:
            raise RowError(f"document {document!r} must have at most {max_bytes} bytes of JSON, got {len(text)}")
        with files.durable_file(folder / f"{document}.json") as handle:
            handle.write(text)
    if job.choose_kind is not None:
        chosen = job.choose_kind(tables)
        kind = load_kind(chosen.kind)
        json_of(dict(chosen.about), "about")
        job = replace(
            job, kind=kind, requested=kind.check_parameters(chosen.parameters), about={**job.about, **chosen.about}
        )
    index, built_slots, inherited = _build_or_grow(tables, job)
    if index.save(folder / STRUCTURE):
        files.sync(folder / STRUCTURE)
    slots = len(tables.vectors)
    tombstones = slots - int(np.count_nonzero(np.bincount(tables.slots)))
    manifest = Manifest(
        generation=name,
        parent=None if tables.parent is None else tables.parent.name,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        software=job.software,
        fingerprint=job.fingerprint,
        about=job.about,
        dim=index.dim,
        metric="inner_product",
        kind=index.kind,
        parameters=index.settings(),
        requested=asdict(job.requested),
        seed=job.seed,
        recall=_recall(index, job),
        counts=Counts(len(tables.slots), slots, tombstones, built_slots),
        arrays=sorted(tables.arrays),
        documents=sorted(job.documents),
        files=file_checksums(folder),
    )
    write_manifest(folder, manifest)
    files.sync(folder)
    return inherited


def _build_or_grow(tables: Tables, job: WriteJob) -> tuple[VectorIndex, int, int]:
    """Return the index, its number of vectors at the last build, and the number in the reused structure."""
    vectors, parent = tables.vectors, tables.parent
    if parent is None or tables.renumbered or not _can_reuse_structure(parent, len(vectors), job):
        return job.kind.build_checked(vectors, job.requested, seed=job.seed, threads=job.threads), len(vectors), 0
    index = parent.index.copy()
    index.threads = job.threads
    index.grow(vectors)
    return index, parent.manifest.counts.built_slots, len(parent.embeddings)


def _can_reuse_structure(parent: Generation, slots: int, job: WriteJob) -> bool:
    """Whether the parent's structure is reusable for that many slots."""
    manifest, kind = parent.manifest, job.kind
    if (
        manifest.kind != kind.kind
        or kind.parameters_from(manifest.requested) != job.requested
        or manifest.seed != job.seed
    ):
        return False
    return kind.retrain_growth is None or slots <= kind.retrain_growth * manifest.counts.built_slots


def _recall(index: VectorIndex, job: WriteJob) -> dict[str, Any]:
    if index.exact:
        return {"value": 1.0, "at": RECALL_AT, "queries": 0, "how": "exact by construction"}
    queries = sample_queries(index.vectors, RECALL_QUERIES, seed=job.seed) if job.queries is None else job.queries
    value = recall_against_exact(index, queries, RECALL_AT)
    how = "measured on displaced vectors of the index" if job.queries is None else "measured on the given queries"
    return {"value": value, "at": RECALL_AT, "queries": len(queries), "how": how}
