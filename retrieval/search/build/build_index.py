"""Build an index from a folder of photos; only photos with changed content are embedded again."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

from indexes import load_kind
from indexes.errors import CorruptIndex, IndexesError, NoIndex, UnsupportedFormat
from indexes.kinds.vector_index import VectorIndex
from indexes.store.folder import IndexStore
from indexes.store.generation import Generation
from indexes.store.manifest import read_manifest
from indexes.store.stat_cache import FolderCache
from indexes.store.tables import Tables
from indexes.store.writing import RECALL_QUERIES, KindChoice
from retrieval.data.catalogue import Catalogue, list_catalogue
from retrieval.data.naming import FOLDER, Naming, count_summary, naming_warnings
from retrieval.errors import BadInput
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.checkpoint_info import can_reuse_partials, fingerprint
from retrieval.model.reference_calibration import REFERENCE_CALIBRATION, REFERENCE_ROWS
from retrieval.model.stored_partials import CELLS, stored_layout
from retrieval.search.build.build_report import BuildReport
from retrieval.search.build.embed import EMBEDDED, RE_EMBEDDED, RENAMED, RESUMED, BuildPart, Embedder
from retrieval.search.build.embed_touches import ReferenceBuild, embed_references
from retrieval.search.build.measuring import can_measure, query_codes
from retrieval.search.build.operating import SearchRequirements, choose_operating_point
from retrieval.search.build.stat_cache import StatCache, unchanged_runs
from retrieval.version import __version__

NO_STAT_CACHE = (
    "The index has no stat records of the photos' files (older versions write none), so every file was read and "
    "compared."
)
CANDIDATE_ENCODER_CHANGED = (
    "Only the candidate encoder changed: partial activations of unchanged photos were reused and their embeddings "
    "recomputed, without decoding or encoding a photo."
)
CELLS_DROPPED = "The index no longer stores cells; all else that it stored of unchanged photos was reused."
CELLS_ADDED = "Every photo was embedded again: the index stores cells now."
CHANGE_REASONS = {
    "checkpoint": "the model changed",
    "preprocessing": "the preprocessing of photos changed",
}
"""Reasons to embed photos again, by the part of the fingerprint that changed."""


def build_index(
    folder: str | Path,
    checkpoint: Checkpoint,
    out: str | Path,
    *,
    objects_from: str | None = None,
    kind: str | type[VectorIndex] | None = None,
    min_recall: float | None = None,
    max_ms: float | None = None,
    cells: bool | None = None,
    verify: bool = False,
    quiet: bool = False,
) -> BuildReport:
    """Write the next generation of an index of a catalogue, or the first one.

    No generation is written if model, catalogue, metadata and settings are unchanged. Photos that cannot
    be read are skipped and reported. An interrupted build stores its embeddings and partial activations for the next.

    Args:
        folder: The catalogue folder (`retrieval.data.catalogue`).
        checkpoint: The model.
        out: The index folder.
        objects_from: Rule that names the object of a photo (`retrieval.data.naming`); None for the rule of the existing
            index, else by folder.
        kind: Kind of index, a name or a class; None for exact search, unless a bound requires another kind.
        min_recall: Smallest agreement with exhaustive search at rank 1 (`retrieval.search.build.operating`).
        max_ms: Longest time of candidate search and reranking for one touch, in milliseconds.
        cells: Store the cells of photos, for late interaction; None for the setting of the existing index, else True.
            Requires a model with cells.
        verify: List every folder and read every file, even if size, times and inode did not change
            (`retrieval.search.build.stat_cache`).
        quiet: Show no progress.

    Returns:
        A report of the build.

    Raises:
        BadInput: The rule or a requirement is invalid, or `cells` is given for a model without cells.
        DatasetError: No photo can be read.
        IndexesError: The index could not be written (`indexes.store.folder.IndexStore.write`) and did not change.

    >>> checkpoint = retrieval.load_checkpoint("model.safetensors")
    >>> report = retrieval.build_index("catalog", checkpoint, "index", quiet=True)
    >>> report.photos, report.embedded  # the index exists, and no photo changed
    (4, 0)
    """
    requirements, out = SearchRequirements.of(kind, min_recall, max_ms), Path(out)
    try:
        before = read_manifest(out / IndexStore(out).current()).about
    except IndexesError:
        before = {}
    naming, note = naming_by(objects_from, before)
    options = BuildOptions(naming, requirements, quiet, verify, note, cells=stores_cells(cells, before, checkpoint))
    folders = FolderCache(out, known=not verify)
    catalogue = list_catalogue(folder, naming, folders)
    report = build_listed(catalogue, checkpoint, out, options)
    folders.write()
    return report


@dataclass(frozen=True)
class BuildOptions:
    """Options of one build.

    Attributes:
        naming: Rule that names the object of a photo.
        requirements: Requirements of candidate search.
        quiet: Show no progress.
        verify: Read every file.
        note: First sentence of the report's reason.
        about: Further entries of the manifest.
        donors: Generations whose embeddings and partial activations may be reused.
        keep: Number of earlier generations that stay on the disk.
        cells: Store the cells of photos; None for a model without cells.
    """

    naming: Naming
    requirements: SearchRequirements
    quiet: bool = False
    verify: bool = False
    note: str = ""
    about: Mapping[str, Any] = field(default_factory=dict)
    donors: Sequence[Generation] = ()
    keep: int = 2
    cells: bool | None = None


def build_listed(catalogue: Catalogue, checkpoint: Checkpoint, out: Path, options: BuildOptions) -> BuildReport:
    """Write the next generation of an index of listed photos; as `build_index`.

    Args:
        catalogue: The listed photos and touches.
        checkpoint: The model.
        out: The index folder.
        options: The options of the build.
    """
    requirements, store = options.requirements, IndexStore(out)
    if options.cells is False:
        checkpoint = checkpoint.without_cells()
    if requirements.kind is not None:
        chosen = load_kind(requirements.kind)
        chosen.resolve_parameters(
            chosen.parameters_type(), len(catalogue.photos), checkpoint.config.matcher.embedding_dim
        )
    with store.lock():
        parent, partials, why = _reusable(store, checkpoint)
        references = embed_references(catalogue, checkpoint, parent, options.quiet)
        catalogue = references.with_gel_images(catalogue)
        start = time.perf_counter()
        stat_cache = StatCache(catalogue, out, options.verify)
        known = stat_cache.known(parent)
        unchanged = list(unchanged_runs(catalogue.photos, known, parent))
        with closing(Embedder(checkpoint, out, parent, options.donors, partials)) as embedder:
            job = _BuildJob(store, embedder, references, catalogue.where, options)
            with closing(embedder.parts(catalogue, known, unchanged, options.quiet)) as parts:
                generation, is_written = job.write(parts)
            embedder.clear()
        stat_cache.note(generation)
        seconds = time.perf_counter() - start - job.choosing_s
    notes = (options.note, NO_STAT_CACHE if parent is not None and stat_cache.lacks_records else why)
    manifest, objects, made = generation.manifest, embedder.objects, embedder.made
    names, inside = sorted(objects), out.resolve()
    shown = dict.fromkeys((names[0], names[len(names) // 2], names[-1]))
    return BuildReport(
        index=str(out),
        generation=generation.name,
        written=is_written,
        model=str(checkpoint.path),
        photos=generation.count,
        objects=len(names),
        objects_from=options.naming.text,
        per_object=count_summary(list(objects.values())),
        examples=[(name, catalogue.photos.paths[catalogue.photos.objects.index(name)]) for name in shown],
        warnings=naming_warnings(objects, options.naming),
        embedded=made[EMBEDDED],
        reused=objects.total() - made[EMBEDDED],
        renamed=made[RENAMED],
        re_embedded=made[RE_EMBEDDED],
        resumed=made[RESUMED],
        removed=embedder.removed,
        unread=int((known >= 0).sum()),
        skipped=[*embedder.skipped, *references.skipped],
        ignored=[name for name in catalogue.ignored if not (catalogue.folder / name).resolve().is_relative_to(inside)],
        without_photo=sorted(set(catalogue.object_ids) - objects.keys()),
        notes=list(catalogue.notes),
        kind=manifest.kind,
        reason=" ".join(filter(None, (*notes, manifest.about["reason"]))),
        recall=manifest.recall,
        candidates=manifest.about["candidates"],
        partial_error=embedder.partial_error,
        cells=options.cells,
        photo_bytes={name: array.dtype.itemsize * array.shape[1] for name, array in generation.arrays.items()},
        seconds=seconds,
        references=references.summary(manifest.about[REFERENCE_CALIBRATION]["by"]) if references.rows else None,
    )


def naming_by(rule: str | None, about: Mapping[str, Any]) -> tuple[Naming, str]:
    """Return the rule that names objects, and a note if it replaces another one.

    Args:
        rule: The user's rule; None for the rule of the existing index, else by folder.
        about: Entries of that index's manifest.

    Raises:
        BadInput: The user's rule is invalid.
    """
    before = about.get("objects_from")
    try:
        known = None if before is None else Naming(before)
    except (BadInput, TypeError):  # a rule of another version
        known = None
    naming = Naming(rule) if rule is not None else known or Naming(FOLDER)
    if known is None or known == naming:
        return naming, ""
    return naming, f"The rule for object names changed from {known.text} to {naming.text}."


def stores_cells(requested: bool | None, about: Mapping[str, Any], checkpoint: Checkpoint) -> bool | None:
    """Return whether to store the cells of photos; None for a model without cells.

    Args:
        requested: The user's setting; None for that of the existing index, else True.
        about: Entries of that index's manifest.
        checkpoint: The model.

    Raises:
        BadInput: The user gave a setting, and the model has no cells.
    """
    if checkpoint.config.matcher.cell_dim:
        return about.get(CELLS) is not False if requested is None else requested
    if requested is None:
        return None
    raise BadInput(
        f"--cells and --no-cells need a model with late interaction, and {checkpoint.path} has none (cell_dim = 0); "
        "leave the option out"
    )


def _reusable(store: IndexStore, checkpoint: Checkpoint) -> tuple[Generation | None, Generation | None, str]:
    """Return the generation with reusable photos, the one with reusable partial activations only, and a reason."""
    try:
        current = store.open()
    except NoIndex:
        return None, None, ""
    except (CorruptIndex, UnsupportedFormat) as error:
        return None, None, f"The existing index is not usable, so every photo was embedded again ({error})."
    before, now = current.manifest.fingerprint, fingerprint(checkpoint)
    matcher = checkpoint.config.matcher
    layout = stored_layout(matcher.pooled_width, matcher.partial_width)
    stored = {name: (array.dtype, array.shape[1:]) for name, array in current.arrays.items()}
    if {name: before.get(name) for name in now} == now:
        if not layout.keys() <= stored.keys():
            return None, None, CELLS_ADDED
        current.arrays = {name: current.arrays[name] for name in layout}  # a generation has the arrays of its parent
        return current, None, "" if layout.keys() == stored.keys() else CELLS_DROPPED
    if can_reuse_partials(checkpoint, before) and layout.items() <= stored.items():
        return None, current, CANDIDATE_ENCODER_CHANGED
    changed = [reason for name, reason in CHANGE_REASONS.items() if before.get(name) != now[name]]
    written = f"; the index was written by version {current.manifest.software}" if current.manifest.software else ""
    return None, None, f"Every photo was embedded again: {' and '.join(changed)}{written}."


@dataclass
class _BuildJob:
    """Write a generation from parts, and choose its operating point when all parts are on the disk."""

    store: IndexStore
    embedder: Embedder
    references: ReferenceBuild
    where: str
    options: BuildOptions
    choosing_s: float = 0.0

    def write(self, parts: Iterator[BuildPart]) -> tuple[Generation, bool]:
        """Return the new generation and True; or the parent and False if the new one would be equal."""
        checkpoint, parent, options = self.embedder.checkpoint, self.embedder.parent, self.options
        about = {
            "checkpoint": str(checkpoint.path.resolve()),
            "catalogue": self.where,
            "objects_from": options.naming.text,
            "requirements": asdict(options.requirements),
            **({} if options.cells is None else {CELLS: options.cells}),
            **self.references.about,
            **options.about,
        }
        # Compare `REFERENCE_ROWS` even if it is not in `about`: all references may have been removed.
        if parent is not None and all(
            parent.manifest.about.get(key) == about.get(key) for key in (REFERENCE_ROWS, *about)
        ):
            if (changed := _changed(parent, parts)) is None:
                return parent, False
            parts = changed
        calibration = {"calibration": checkpoint.posterior.to_dict()} if checkpoint.posterior else {}
        generation = self.store.write_blocks(
            (part.block for part in parts),
            calibration | self.references.documents,
            fingerprint=fingerprint(checkpoint),
            about=about,
            parent=parent,
            software=__version__,
            choose_kind=self._choose,
            keep=options.keep,
            queries=query_codes(checkpoint, RECALL_QUERIES)[1] if can_measure(checkpoint) else None,
        )
        return generation, True

    def _choose(self, tables: Tables) -> KindChoice:
        start, embedder = time.perf_counter(), self.embedder
        changed = embedder.made[EMBEDDED] + embedder.made[RESUMED] + embedder.removed
        previous = None if embedder.parent is None else embedder.parent.manifest
        if previous is not None and previous.about.get(CELLS) != self.options.cells:
            previous = None  # it was measured with other logits
        point = choose_operating_point(
            embedder.checkpoint, tables, self.options.requirements, previous, changed, quiet=self.options.quiet
        )
        self.choosing_s = time.perf_counter() - start
        about = {"partial_error": embedder.partial_error, "reason": point.reason, "candidates": point.candidates}
        if self.references.rows:
            about[REFERENCE_CALIBRATION] = self.references.calibrate(embedder.checkpoint, tables)
        return KindChoice(point.kind, point.parameters, about)


def _changed(parent: Generation, parts: Iterator[BuildPart]) -> Iterator[BuildPart] | None:
    """Return all parts, or None if they equal the parent's rows. Parts without codes are buffered until one differs."""
    same: list[BuildPart] = []
    place = 0
    for part in parts:
        same.append(part)
        count = len(part.unchanged) or len(part.rows)
        is_next = part.unchanged.start == place if part.unchanged else parent.rows[place : place + count] == part.rows
        if part.codes or not is_next:
            return chain(same, parts)
        place += count
    return None if place == parent.count else iter(same)
