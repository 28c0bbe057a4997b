"""From a folder of photos to a searchable index; only photos whose content changed are embedded again."""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch  # before faiss, which the index imports: both bring OpenMP

from indexes import load_kind
from indexes.choice import choose_kind, require_buildable
from indexes.errors import CorruptIndex, MismatchedIndex, NoIndex, UnsupportedFormat
from indexes.generation import Generation
from indexes.spool import Block
from indexes.store import IndexStore
from indexes.writing import RECALL_QUERIES, Chosen, Laid
from retrieval.catalogue import SkippedPhoto, list_catalogue
from retrieval.checkpoint import Checkpoint
from retrieval.embed import Embedder, Part
from retrieval.operating import (
    Asked,
    Bench,
    Settled,
    all_judged,
    can_measure,
    kept,
    needs_measuring,
    query_codes,
    sentence,
    settle,
)
from retrieval.stored import fingerprint
from retrieval.version import __version__

SHOWN = 20


@dataclass(frozen=True)
class BuildReport:
    """What a build did.

    written: False where nothing had changed, so that the generation stayed as it was. skipped: photos that could not
    be read; ignored: files that are no photos by name; notes: remarks on metadata. candidates: the operating point as
    the manifest has it (`retrieval.operating`), None where the checkpoint has nothing to measure one with.
    half_error: largest rounding of a stored half, which the manifest keeps too. seconds: decoding and encoding alone.
    """

    index: str
    generation: str
    written: bool
    model: str
    photos: int
    objects: int
    embedded: int
    reused: int
    removed: int
    skipped: list[SkippedPhoto]
    ignored: list[str]
    notes: list[str]
    kind: str
    reason: str
    recall: Any
    candidates: dict[str, Any] | None
    half_error: float
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return asdict(self)

    def _measured(self) -> str:
        if not self.recall["queries"]:
            return ""  # exact by construction
        return f" Recall@{self.recall['at']} against exact search: {self.recall['value']:.3f}, measured on this index."

    def lines(self) -> Iterator[str]:
        """The report for people."""
        rate = f", {self.embedded / self.seconds:.1f} photos per second" if self.embedded else ""
        yield (
            f"{self.index} ({self.generation}): {self.photos} photos of {self.objects} objects; "
            f"{self.embedded} embedded, {self.reused} unchanged, {self.removed} removed{rate}"
        )
        if not self.written:
            yield "nothing changed, by the content of every file: the index stays as it is"
        yield f"candidate search: {self.kind}. {self.reason}{self._measured()}"
        yield f"halves are stored as float16, each within {self.half_error:.2g} of the float32 one"
        if self.ignored:
            yield f"{len(self.ignored)} file(s) ignored, not images by name: {', '.join(self.ignored[:5])}"
        yield from _some("remark(s)", self.notes)
        yield from _some("photo(s) skipped", [f"{item.path}: {item.reason}" for item in self.skipped])


def _some(what: str, items: Sequence[str]) -> Iterator[str]:
    if items:
        yield f"{len(items)} {what}:"
        yield from (f"  {item}" for item in items[:SHOWN])
    if len(items) > SHOWN:
        yield f"  and {len(items) - SHOWN} more (--json lists them all)"


def build_index(
    folder: Path,
    checkpoint: Checkpoint,
    out: Path,
    *,
    kind: str | None = None,
    min_recall: float | None = None,
    max_ms: float | None = None,
    quiet: bool = False,
) -> BuildReport:
    """Write the next generation of the index `out` over the catalogue `folder`, or the first one.

    kind, min_recall, max_ms: what is asked of the search (`retrieval.operating`); where all are None, exact search.
    Where neither the photos' content nor what is asked for changed, nothing is written. Photos that cannot be read are
    skipped and reported. Raises DatasetError where none can be, and the errors of `indexes.store.IndexStore.write`,
    which leave the index as it was.
    """
    asked = Asked(kind, min_recall, max_ms)
    catalogue = list_catalogue(folder)
    if kind is not None:
        require_buildable(kind, len(catalogue.photos), checkpoint.config.matcher.embedding_dim)
    store = IndexStore(out)
    with store.lock():
        parent, why = _parent(store, checkpoint)
        about = {
            "checkpoint": str(checkpoint.path.resolve()),
            "catalogue": str(folder.resolve()),
            "asked": asdict(asked),
        }
        made = Embedder(checkpoint, parent)
        start = time.perf_counter()
        with closing(made.parts(catalogue, quiet)) as parts:
            changed = _unless_same(parent, parts, about)
            job = _Job(store, made, about, asked, quiet)
            generation = parent if parent is not None and changed is None else job.write(changed or ())
        seconds = time.perf_counter() - start - job.settling_s
    inside = out.resolve()
    return BuildReport(
        index=str(out),
        generation=generation.name,
        written=changed is not None,
        model=str(checkpoint.path),
        photos=generation.count,
        objects=len(made.object_ids),
        embedded=made.embedded,
        reused=made.photos - made.embedded,
        removed=made.removed,
        skipped=made.skipped,
        ignored=[name for name in catalogue.ignored if not (folder / name).resolve().is_relative_to(inside)],
        notes=list(catalogue.notes),
        kind=generation.manifest.kind,
        reason=" ".join(filter(None, (why, generation.manifest.about["reason"]))),
        recall=generation.manifest.recall,
        candidates=generation.manifest.about["candidates"],
        half_error=made.half_error,
        seconds=seconds,
    )


def _unless_same(parent: Generation | None, parts: Iterator[Part], about: Mapping[str, Any]) -> Iterator[Part] | None:
    """The parts, or None where a new generation would hold what the parent holds, row by row, and its manifest say the
    same. Parts are held back until one differs; these have rows alone."""
    if parent is None or any(parent.manifest.about.get(key) != value for key, value in about.items()):
        return parts
    same: list[Part] = []
    place = 0
    for part in parts:
        same.append(part)
        if part.halves is not None or parent.rows[place : place + len(part.rows)] != part.rows:
            return chain(same, parts)
        place += len(part.rows)
    return None if place == parent.count else iter(same)


@dataclass
class _Job:
    """Writes a generation from parts, and settles how it is to be searched when all of them are on the disk."""

    store: IndexStore
    made: Embedder
    about: Mapping[str, Any]
    asked: Asked
    quiet: bool
    settling_s: float = 0.0

    def write(self, parts: Iterable[Part]) -> Generation:
        """Write the parts as they come."""
        checkpoint = self.made.checkpoint
        return self.store.write_blocks(
            (_block(part) for part in parts),
            {"calibration": checkpoint.calibration.to_dict()} if checkpoint.calibration else {},
            fingerprint=fingerprint(checkpoint),
            about=self.about,
            parent=self.made.parent,
            software=__version__,
            settle=self._settle,
            queries=query_codes(checkpoint, RECALL_QUERIES)[1] if can_measure(checkpoint) else None,
        )

    def _settle(self, laid: Laid) -> Chosen:
        start = time.perf_counter()
        settled = _settled(self.made, laid, self.asked, self.quiet)
        self.settling_s = time.perf_counter() - start
        about = {"half_error": self.made.half_error, "reason": settled.reason, "candidates": settled.candidates}
        return Chosen(settled.kind, settled.parameters, about)


def _block(part: Part) -> Block:
    return Block(part.rows, part.embeddings, {} if part.halves is None else {"halves": part.halves})


def _parent(store: IndexStore, checkpoint: Checkpoint) -> tuple[Generation | None, str]:
    """The generation to take unchanged photos over from, and why not where there is one that cannot serve."""
    try:
        return store.open(expect=fingerprint(checkpoint)), ""
    except NoIndex:
        return None, ""
    except MismatchedIndex:
        return None, "The model or its preprocessing changed, so every photo was embedded again."
    except (CorruptIndex, UnsupportedFormat) as error:
        return None, f"The index there was not usable, so every photo was embedded again ({error})."


def _settled(made: Embedder, laid: Laid, asked: Asked, quiet: bool) -> Settled:
    """The kind to build and the candidates to judge, measured where there is something to measure with."""
    photos, checkpoint = len(laid.slots), made.checkpoint
    previous = None if made.parent is None else made.parent.manifest
    before = None if previous is None else previous.about.get("candidates")
    again = kept(before, asked, photos, made.embedded + made.removed)
    if previous is not None and again is not None:
        parameters = load_kind(previous.kind).parameters_from(previous.asked)
        return Settled(previous.kind, parameters, sentence(again), again)
    if not checkpoint.config.has_embeddings or not needs_measuring(photos, asked):
        chosen, judged = asked.kind or "flat", all_judged(photos, asked)
        return Settled(chosen, load_kind(chosen).parameters_type(), sentence(judged), judged)
    if not can_measure(checkpoint):
        return _by_neighbours(laid, asked)
    return settle(Bench(checkpoint, laid.vectors, laid.slots, laid.arrays["halves"], quiet=quiet), asked)


def _by_neighbours(laid: Laid, asked: Asked) -> Settled:
    """The kind by its recall of nearest neighbours, where the checkpoint keeps no touches to find winners of."""
    why = "The checkpoint keeps no touches to measure candidates with, so recall is that of nearest neighbours."
    if asked.kind is not None:
        return Settled(asked.kind, load_kind(asked.kind).parameters_type(), f"It was asked for. {why}", None)
    # Without a budget nothing is measured, so no vector need be read.
    vectors = laid.vectors[:0] if asked.max_ms is None else laid.vectors[np.unique(laid.slots)]
    choice = choose_kind(vectors, asked.max_ms, min_recall=asked.target, threads=torch.get_num_threads())
    return Settled(choice.kind, choice.parameters, f"{choice.reason} {why}", None)
