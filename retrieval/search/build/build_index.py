"""From a folder of photos to a searchable index; only photos whose content changed are embedded again."""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

from indexes import load_kind
from indexes.errors import CorruptIndex, IndexesError, NoIndex, UnsupportedFormat
from indexes.kinds.base import VectorIndex
from indexes.store.folder import IndexStore
from indexes.store.generation import Generation
from indexes.store.manifest import read_manifest
from indexes.store.stat_cache import FolderCache
from indexes.store.tables import Block, Tables
from indexes.store.unfinished import Unfinished
from indexes.store.writing import RECALL_QUERIES, Chosen
from retrieval.data.catalogue import Catalogue
from retrieval.data.naming import FOLDER, Naming, doubts, per_object
from retrieval.data.sources import Fetched, list_photos
from retrieval.errors import BadInput
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.stored import fingerprint, halves_kept
from retrieval.search.build.build_report import BuildReport
from retrieval.search.build.embed import Embedder, Part, layouts
from retrieval.search.build.embed_touches import MadeReferences, make_references, worth_of
from retrieval.search.build.looks import Looked
from retrieval.search.build.measuring import WinnerBench, can_measure, query_codes
from retrieval.search.build.operating import (
    Asked,
    Settled,
    all_judged,
    carried_over,
    needs_measuring,
    sentence,
    settle,
    settle_by_neighbours,
)
from retrieval.search.query.references import ROWS, WORTH
from retrieval.version import __version__


def build_index(
    folder: str | Path,
    checkpoint: Checkpoint,
    out: str | Path,
    *,
    objects_from: str | None = None,
    kind: str | type[VectorIndex] | None = None,
    min_recall: float | None = None,
    max_ms: float | None = None,
    verify: bool = False,
    quiet: bool = False,
) -> BuildReport:
    """Write the next generation of the index `out` over the catalogue `folder`, or the first one.

    * `folder`: of this machine, or a URL as `retrieval.data.sources` reads it.
    * `objects_from`: the rule that says which object a photo shows (`retrieval.data.naming`); None: the rule of the
      index that is there, else by folder.
    * `kind` (a name or a class), `min_recall`, `max_ms`: what is asked of the search (`retrieval.search.build.operating`);
      where all are None, exact search.
    * `verify`: list every folder and read every file, also those that look as an earlier build found them, by size,
      times and inode (`indexes.store.stat_cache`, `retrieval.search.build.looks`).

    Nothing is written where neither photos, nor their objects, nor what is asked for has changed. Photos that cannot be
    read are skipped and reported. What was embedded until an error, or until the process was killed, is not embedded
    again by the next build (`indexes.store.unfinished`). Raises BadInput for a rule that is none, DatasetError where no
    photo can be read, and the errors of `indexes.store.folder.IndexStore.write`, which leave the index as it was.

    >>> checkpoint = retrieval.load_checkpoint("model.safetensors")
    >>> report = retrieval.build_index("catalog", checkpoint, "index", quiet=True)
    >>> report.photos, report.embedded  # the index was there, and no photo changed
    (4, 0)
    """
    asked, out = Asked.of(kind, min_recall, max_ms), Path(out)
    naming, note = naming_by(objects_from, _about_before(IndexStore(out)))
    wanted, seen = Wanted(naming, asked, quiet, verify, note), FolderCache(out, known=not verify)
    report = build_listed(list_photos(folder, naming, seen), checkpoint, out, wanted)
    seen.write()
    return report


UNNOTED = (
    "No earlier build noted sizes and times of the photos' files, as older versions do not, so each was read and "
    "compared."
)
TAUGHT_AGAIN = (
    "The model finds candidates in another way and judges as before, so unchanged photos kept their halves and were "
    "given new embeddings made of these; none of them was decoded or encoded."
)
CHANGED = {
    "checkpoint": "the model is another one",
    "preprocessing": "the model wants photos prepared in another way",
}
"""By what of the fingerprint is another one: why a photo is embedded again."""


@dataclass(frozen=True)
class Wanted:
    """What is wanted of a build. verify: as `build_index` takes it. note: to be said of it first. about: more for the
    manifest. donors: generations whose codes may be taken. keep: generations before the new one that stay."""

    naming: Naming
    asked: Asked
    quiet: bool = False
    verify: bool = False
    note: str = ""
    about: Mapping[str, Any] = field(default_factory=dict)
    donors: Sequence[Generation] = ()
    keep: int = 2


def build_listed(catalogue: Catalogue, checkpoint: Checkpoint, out: Path, wanted: Wanted) -> BuildReport:
    """As `build_index`, of photos that are listed already."""
    asked, naming, store = wanted.asked, wanted.naming, IndexStore(out)
    if asked.kind is not None:
        chosen = load_kind(asked.kind)
        chosen.resolved(chosen.parameters_type(), len(catalogue.photos), checkpoint.config.matcher.embedding_dim)
    with store.lock():
        parent, halves, why = _before(store, checkpoint)
        references = make_references(catalogue, checkpoint, parent, wanted.quiet)
        catalogue = references.shown(catalogue)
        about = {
            "checkpoint": str(checkpoint.path.resolve()),
            "catalogue": catalogue.where,
            "objects_from": naming.text,
            "asked": asdict(asked),
            **references.about,
            **wanted.about,
        }
        start = time.perf_counter()
        looked = Looked(catalogue, out, wanted.verify)
        with Unfinished(out, fingerprint(checkpoint), layouts(checkpoint)) as unfinished:
            made = Embedder(checkpoint, parent, unfinished, looked, wanted.donors, halves)
            with closing(made.parts(catalogue, wanted.quiet)) as parts:
                changed = _unless_same(parent, parts, about)
                job = _Job(store, made, references, about, asked, wanted.quiet, wanted.keep)
                generation = parent if parent is not None and changed is None else job.write(changed or ())
            unfinished.clear()
        looked.note(generation)
        seconds = time.perf_counter() - start - job.settling_s
        if parent is not None and looked.unnoted:
            why = UNNOTED
    names = sorted(made.objects)
    return BuildReport(
        index=str(out),
        generation=generation.name,
        written=changed is not None,
        model=str(checkpoint.path),
        photos=generation.count,
        objects=len(names),
        objects_from=naming.text,
        per_object=per_object(list(made.objects.values())),
        examples=_examples(catalogue, names),
        doubts=doubts(made.objects, naming),
        embedded=made.embedded,
        reused=made.photos - made.embedded,
        renamed=made.renamed,
        remade=made.remade,
        resumed=made.resumed,
        removed=made.removed,
        unread=made.unread,
        skipped=[*made.skipped, *references.skipped],
        ignored=_outside(catalogue, out),
        without_photo=sorted(set(catalogue.object_ids) - made.objects.keys()),
        notes=list(catalogue.notes),
        kind=generation.manifest.kind,
        reason=" ".join(filter(None, (wanted.note, why, generation.manifest.about["reason"]))),
        recall=generation.manifest.recall,
        candidates=generation.manifest.about["candidates"],
        half_error=made.half_error,
        seconds=seconds,
        references=_said(references, generation),
    )


def naming_by(asked: str | None, about: Mapping[str, Any]) -> tuple[Naming, str]:
    """The rule that names objects, which is the one asked for, else the one of the index there, by what its manifest
    says of it, else by folder; and what is to be said where it is another one now. Raises BadInput for one asked for
    that is none."""
    before = about.get("objects_from")
    try:
        known = None if before is None else Naming(before)
    except (BadInput, TypeError):  # of another version, or forged
        known = None
    naming = Naming(asked) if asked is not None else known or Naming(FOLDER)
    if known is None or known == naming:
        return naming, ""
    return naming, f"Objects are named by {naming.text} now, no longer by {known.text}."


def _outside(catalogue: Catalogue, out: Path) -> list[str]:
    """Files of the catalogue that are no pictures by name, but for those of the index itself."""
    if isinstance(catalogue, Fetched):
        return list(catalogue.ignored)
    inside = out.resolve()
    return [name for name in catalogue.ignored if not (catalogue.folder / name).resolve().is_relative_to(inside)]


def _about_before(store: IndexStore) -> Mapping[str, Any]:
    """What the index there says of itself besides; nothing where there is none."""
    try:
        return read_manifest(store.path / store.current()).about
    except IndexesError:
        return {}


def _examples(catalogue: Catalogue, names: Sequence[str]) -> list[tuple[str, str]]:
    """The first, the middle and the last object, each with its first photo."""
    wanted, photos = dict.fromkeys((names[0], names[len(names) // 2], names[-1])), catalogue.photos
    return [(name, photos.paths[photos.objects.index(name)]) for name in wanted]


def _unless_same(parent: Generation | None, parts: Iterator[Part], about: Mapping[str, Any]) -> Iterator[Part] | None:
    """The parts, or None where a new generation would hold what the parent holds, row by row, and its manifest would
    say the same. Parts are held back until one differs; these have rows alone."""
    told = {ROWS: None, **about}  # there may be no references any more
    if parent is None or any(parent.manifest.about.get(key) != value for key, value in told.items()):
        return parts
    same: list[Part] = []
    place = 0
    for part in parts:
        same.append(part)
        if part.kept:
            if part.kept.start != place:
                return chain(same, parts)
            place = part.kept.stop
            continue
        if part.halves is not None or parent.rows[place : place + len(part.rows)] != part.rows:
            return chain(same, parts)
        place += len(part.rows)
    return None if place == parent.count else iter(same)


@dataclass
class _Job:
    """Writes a generation from parts, and settles how it is to be searched when all of them are on the disk."""

    store: IndexStore
    made: Embedder
    references: MadeReferences
    about: Mapping[str, Any]
    asked: Asked
    quiet: bool
    keep: int
    settling_s: float = 0.0

    def write(self, parts: Iterable[Part]) -> Generation:
        """Write the parts as they come."""
        checkpoint = self.made.checkpoint
        return self.store.write_blocks(
            (
                part.kept or Block(part.rows, part.embeddings, {} if part.halves is None else {"halves": part.halves})
                for part in parts
            ),
            ({"calibration": checkpoint.posterior.to_dict()} if checkpoint.posterior else {})
            | self.references.documents,
            fingerprint=fingerprint(checkpoint),
            about=self.about,
            parent=self.made.parent,
            software=__version__,
            settle=self._settle,
            keep=self.keep,
            queries=query_codes(checkpoint, RECALL_QUERIES)[1] if can_measure(checkpoint) else None,
        )

    def _settle(self, tables: Tables) -> Chosen:
        start = time.perf_counter()
        settled = _settled(self.made, tables, self.asked, self.quiet)
        self.settling_s = time.perf_counter() - start
        about = {"half_error": self.made.half_error, "reason": settled.reason, "candidates": settled.candidates}
        if self.references.rows:
            worth, by = worth_of(self.references, self.made.checkpoint, tables)
            about[WORTH] = {"by": by, "worth": worth.to_dict()}
        return Chosen(settled.kind, settled.parameters, about)


def _said(references: MadeReferences, generation: Generation) -> dict[str, Any] | None:
    """What the report says of reference touches; None where the catalogue has none."""
    if not references.rows:
        return None
    counts = {key: generation.manifest.about[ROWS][key] for key in ("touches", "objects")}
    more = {"alone": len(references.alone), "encoded": references.encoded}
    return {**counts, **more, "by": generation.manifest.about[WORTH]["by"]}


def _before(store: IndexStore, checkpoint: Checkpoint) -> tuple[Generation | None, Generation | None, str]:
    """What the index holds that can be used again: a generation of which unchanged photos are taken over whole, one of
    which their halves alone are, and in words what is made again and why. Where there is no index yet: None, None and
    nothing."""
    try:
        there = store.open()
    except NoIndex:
        return None, None, ""
    except (CorruptIndex, UnsupportedFormat) as error:
        return None, None, f"The index there was not usable, so every photo was embedded again ({error})."
    before, now = there.manifest.fingerprint, fingerprint(checkpoint)
    if {name: before.get(name) for name in now} == now:
        return there, None, ""
    half = (checkpoint.config.matcher.half,)
    if halves_kept(checkpoint, before) and there.arrays["halves"].shape[1:] == half:
        return None, there, TAUGHT_AGAIN
    changed = [said for name, said in CHANGED.items() if before.get(name) != now[name]]
    written = f"; the index was written by version {there.manifest.software}" if there.manifest.software else ""
    return None, None, f"Every photo was embedded again: {' and '.join(changed)}{written}."


def _settled(made: Embedder, tables: Tables, asked: Asked, quiet: bool) -> Settled:
    """The kind to build and the candidates to judge, measured where there is something to measure with."""
    photos, checkpoint = len(tables.slots), made.checkpoint
    previous = None if made.parent is None else made.parent.manifest
    before = None if previous is None else previous.about.get("candidates")
    again = carried_over(before, asked, photos, made.embedded + made.resumed + made.removed)
    if previous is not None and again is not None:
        parameters = load_kind(previous.kind).parameters_from(previous.asked)
        return Settled(previous.kind, parameters, sentence(again), again)
    if not checkpoint.config.has_embeddings or not needs_measuring(photos, asked):
        chosen, judged = asked.kind or "flat", all_judged(photos, asked)
        return Settled(chosen, load_kind(chosen).parameters_type(), sentence(judged), judged)
    if not can_measure(checkpoint):
        return settle_by_neighbours(tables.vectors, tables.slots, asked)
    bench = WinnerBench(checkpoint, tables.vectors, tables.slots, tables.arrays["halves"], quiet=quiet)
    return settle(bench, asked)
