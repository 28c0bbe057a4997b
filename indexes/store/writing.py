"""How a generation's folder is filled, the manifest last."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from indexes import load_kind
from indexes.errors import RowError
from indexes.kinds.base import Parameters, VectorIndex
from indexes.kinds.measure import recall_against_exact, sample_queries
from indexes.kinds.scores import Floats, Slots
from indexes.kinds.stack import Vectors, stacked
from indexes.store import files
from indexes.store.generation import STRUCTURE, Generation, mapped, segment_name
from indexes.store.manifest import Counts, Manifest, sealed, write_manifest
from indexes.store.plan import Plan, lay_out
from indexes.store.segments import Heirlooms, write_segments, write_structure
from indexes.store.spool import Block, Kept, Spool

RECALL_AT = 10
RECALL_QUERIES = 100


@dataclass(frozen=True)
class Laid:
    """What a generation will hold, on the disk already: vectors (S, d), not all of which need have a row; each row's
    slot (N,); name -> per-row array (N, ...)."""

    vectors: Vectors
    slots: Slots
    arrays: Mapping[str, Any]


@dataclass(frozen=True)
class Chosen:
    """A kind, its parameters, and what the manifest shall say of the choice."""

    kind: str
    parameters: Parameters
    about: Mapping[str, Any]


Settle = Callable[[Laid], Chosen]
"""Chooses the kind of an index by what it will hold."""


@dataclass(frozen=True)
class Job:
    """What a generation is to be, but for its rows; see `indexes.store.folder.IndexStore.write_blocks`."""

    documents: dict[str, Any]
    fingerprint: dict[str, str]
    about: dict[str, Any]
    kind: type[VectorIndex]
    asked: Parameters
    parent: Generation | None
    software: str
    seed: int
    threads: int | None
    settle: Settle | None = None
    queries: Floats | None = None


def write_generation(folder: Path, name: str, number: int, blocks: Iterable[Block | Kept], job: Job) -> None:
    """Fill the empty `folder` with the generation of that name and number."""
    plan = _spooled(folder, blocks, job)
    parent, arrays = plan.content.parent, sorted(plan.records.segments[0].arrays)
    clash = sorted(set(job.documents) & set(arrays))
    if clash:
        raise RowError(f"an array and a document cannot share a name; got {', '.join(clash)}")
    heirlooms = None if parent is None else Heirlooms(parent, folder)
    segments = write_segments(folder, plan, number, heirlooms)
    for document, content in job.documents.items():
        with files.durable(folder / f"{document}.json") as handle:
            handle.write(files.encoded(content, indent=2) + b"\n")
    vectors = stacked([mapped(folder / segment_name("embeddings", segment)) for segment in segments["vectors"]])
    if job.settle is not None:
        job = _settled(job, job.settle(Laid(vectors, plan.slots, _arrays(folder, arrays, segments["records"], plan))))
    index, built_slots = _index(plan, vectors, job)
    shared = heirlooms is not None and index.shares_structure(heirlooms.parent.index)
    if heirlooms is not None and shared:
        heirlooms.take(STRUCTURE)
    else:
        write_structure(index, folder)
    tombstones = len(vectors) - int(np.count_nonzero(np.bincount(plan.slots)))
    counts = (len(plan.places), plan.record_table.count, len(vectors), tombstones, built_slots, index.covered)
    manifest = Manifest(
        generation=name,
        parent=None if parent is None else parent.name,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        software=job.software,
        fingerprint=job.fingerprint,
        about=job.about,
        dim=index.dim,
        metric="inner_product",
        kind=index.kind,
        parameters=index.settings(),
        asked=asdict(job.asked),
        seed=job.seed,
        recall=parent.manifest.recall if parent is not None and shared else _recall(index, job),
        counts=Counts(*counts),
        segments=segments,
        arrays=arrays,
        documents=sorted(job.documents),
        files=sealed(folder, {} if heirlooms is None else heirlooms.sealed),
    )
    write_manifest(folder, manifest)
    files.sync(folder)


def _spooled(folder: Path, blocks: Iterable[Block | Kept], job: Job) -> Plan:
    with Spool(folder, job.parent, job.fingerprint) as spool:
        for block in blocks:
            spool.add(block)
        return lay_out(spool.close())


def _index(plan: Plan, vectors: Vectors, job: Job) -> tuple[VectorIndex, int]:
    """The index over the vectors, and how many there were when its structure was trained."""
    parent = plan.content.parent
    if parent is None or plan.slot_of is not None or not _serves(parent, len(vectors), job):
        return job.kind.over(vectors, job.asked, seed=job.seed, threads=job.threads), len(vectors)
    index = parent.index.copy()
    index.threads = job.threads
    index.grow(vectors)
    return index, parent.manifest.counts.built_slots


def _serves(parent: Generation, slots: int, job: Job) -> bool:
    """Whether the parent's structure can be kept for that many slots."""
    manifest, kind = parent.manifest, job.kind
    if manifest.kind != kind.kind or kind.parameters_from(manifest.asked) != job.asked or manifest.seed != job.seed:
        return False
    return kind.retrain_growth is None or slots <= kind.retrain_growth * manifest.counts.built_slots


def _arrays(folder: Path, names: Sequence[str], segments: Sequence[int], plan: Plan) -> dict[str, Any]:
    return {
        name: stacked([mapped(folder / segment_name(name, number)) for number in segments], plan.places)
        for name in names
    }


def _settled(job: Job, chosen: Chosen) -> Job:
    kind = load_kind(chosen.kind)
    files.check_json(dict(chosen.about), "about")
    return replace(job, kind=kind, asked=kind.asked(chosen.parameters), about={**job.about, **chosen.about})


def _recall(index: VectorIndex, job: Job) -> dict[str, Any]:
    if index.exact:
        return {"value": 1.0, "at": RECALL_AT, "queries": 0, "how": "exact by construction"}
    queries = sample_queries(index.vectors, RECALL_QUERIES, seed=job.seed) if job.queries is None else job.queries
    value = recall_against_exact(index, queries, RECALL_AT)
    how = "measured on moved own vectors" if job.queries is None else "measured on the queries that were given"
    return {"value": value, "at": RECALL_AT, "queries": len(queries), "how": how}
