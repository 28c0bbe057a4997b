"""Build an index from a folder of photos: list, find codes, write one whole generation."""

import hashlib
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from indexes import kind_name, load_kind
from indexes.errors import CorruptIndex, IndexesError, NoIndex, UnsupportedFormat
from indexes.kinds.vector_index import VectorIndex
from indexes.store.codes import CodeCache
from indexes.store.folder import IndexStore
from indexes.store.generation import RECALL_QUERIES, Arrays, Generation, GenerationContent
from indexes.store.manifest import read_manifest
from indexes.store.rows import TEXT, Row, encode_rows
from retrieval.data.catalogue import Catalogue, list_catalogue
from retrieval.data.naming import FOLDER, Naming, naming_warnings
from retrieval.errors import BadInput
from retrieval.indexing.candidates import (
    can_measure,
    candidates_sentence,
    kept_measurement,
    measure_candidates,
    query_codes,
)
from retrieval.indexing.codes import FileDigests, PhotoCodes, code_blocks, code_layout, code_model, find_codes
from retrieval.indexing.report import BuildReport
from retrieval.indexing.touches import ReferenceBuild, embed_references, touch_code_digest, touch_layout
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.checkpoint_info import fingerprint
from retrieval.model.fusion_scorer import CELLS, PARTIALS, StoredPartials, largest_rounding
from retrieval.model.references import REFERENCE_CALIBRATION, REFERENCE_ROWS
from retrieval.version import __version__

PARTS = {"checkpoint": "model", "preprocessing": "preprocessing of photos"}
"""Parts of a fingerprint, by their keys."""
CODES = "codes"
"""Entry of the manifest: keys of the codes of photos and of touches in the cache."""


def build_index(
    folder: str | Path,
    checkpoint: Checkpoint,
    out: str | Path,
    *,
    objects_from: str | None = None,
    kind: str | type[VectorIndex] = "flat",
    cells: bool | None = None,
    quiet: bool = False,
) -> BuildReport:
    """Write the next generation of an index of a catalogue, or the first one.

    No generation is written if model, catalogue, metadata and settings are unchanged. Photos that cannot be read are
    skipped and reported. Codes are stored as soon as they are made, so an interrupted build continues with them.

    Args:
        folder: The catalogue folder.
        checkpoint: The model.
        out: The index folder.
        objects_from: Rule that names the object of a photo (`retrieval.data.naming`); None for the rule of the existing
            index, else by folder.
        kind: Kind of index: "flat", a factory string of FAISS with search settings after a semicolon, or your class.
        cells: Store the cells of photos, for late interaction; None for the setting of the existing index, else True.
            Requires a model with cells.
        quiet: Show no progress.

    Returns:
        A report of the build.

    Raises:
        BadInput: The rule is invalid, or `cells` is given for a model without cells.
        DatasetError: No photo can be read.
        IndexesError: The kind is unknown or needs more photos, or the index could not be written and did not change.

    >>> checkpoint = retrieval.load_checkpoint("model.safetensors")
    >>> report = retrieval.build_index("catalog", checkpoint, "index", quiet=True)
    >>> report.photos, report.embedded  # the index exists, and no photo changed
    (4, 0)
    """
    out = Path(out)
    try:
        before = read_manifest(out / IndexStore(out).current()).about
    except IndexesError:
        before = {}
    naming, note = naming_by(objects_from, before)
    options = BuildOptions(naming, kind_name(kind), quiet, note, cells=stores_cells(cells, before, checkpoint))
    return build_listed(list_catalogue(folder, naming), checkpoint, out, options)


@dataclass(frozen=True)
class BuildOptions:
    """Options of one build.

    Attributes:
        naming: Rule that names the object of a photo.
        kind: Name of the kind of index.
        quiet: Show no progress.
        note: First sentence of the report's reason.
        about: Further entries of the manifest.
        keep: Number of earlier generations that stay on the disk.
        cells: Store the cells of photos; None for a model without cells.
    """

    naming: Naming
    kind: str = "flat"
    quiet: bool = False
    note: str = ""
    about: Mapping[str, Any] = field(default_factory=dict)
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
    if options.cells is False:
        checkpoint = checkpoint.without_cells()
    dim = checkpoint.config.matcher.embedding_dim
    load_kind(options.kind).require(options.kind, len(catalogue.photos), dim)
    store = IndexStore(out)
    with store.lock(), CodeCache(out) as cache:
        previous, why = _current(store, checkpoint)
        files = FileDigests(catalogue.folder, catalogue.paths, cache)
        references = embed_references(catalogue, checkpoint, cache, files.known, options.quiet)
        catalogue = references.with_gel_images(catalogue)
        start = time.perf_counter()
        photos = find_codes(catalogue, checkpoint, cache, files.known, options.quiet)
        seconds = time.perf_counter() - start
        files.note(references.digests | photos.digests)
        job = _Build(catalogue, checkpoint, options, references, photos, previous)
        generation, is_written = job.write(store, cache)
        if is_written:
            job.prune(cache, catalogue.paths)
    manifest, objects = generation.manifest, Counter(row.object_id for row in job.rows)
    names, inside = sorted(objects), out.resolve()
    first_photo = {photo.object_id: photo.path for photo in reversed(catalogue.photos)}
    shown = dict.fromkeys((names[0], names[len(names) // 2], names[-1]))
    return BuildReport(
        index=str(out),
        generation=generation.name,
        written=is_written,
        model=str(checkpoint.path),
        photos=generation.count,
        objects=len(names),
        objects_from=options.naming.text,
        examples=[(name, first_photo[name]) for name in shown],
        warnings=naming_warnings(objects, options.naming),
        embedded=photos.encoded,
        reused=generation.count - photos.encoded,
        skipped=[*catalogue.skipped, *photos.skipped, *references.skipped],
        ignored=[name for name in catalogue.ignored if not (catalogue.folder / name).resolve().is_relative_to(inside)],
        without_photo=sorted(set(catalogue.object_ids) - objects.keys()),
        notes=list(catalogue.notes),
        kind=manifest.kind,
        reason=" ".join(
            filter(None, (options.note, why, candidates_sentence(manifest.about["candidates"], generation.count)))
        ),
        recall=manifest.recall,
        candidates=manifest.about["candidates"],
        partial_error=manifest.about["partial_error"],
        cells=options.cells,
        seconds=seconds,
        references=references.summary,
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


def _current(store: IndexStore, checkpoint: Checkpoint) -> tuple[Generation | None, str]:
    """Return the current generation, and what changed since."""
    try:
        current = store.open()
    except NoIndex:
        return None, ""
    except (CorruptIndex, UnsupportedFormat) as error:
        return None, f"The existing index is not usable ({error})."
    before, now = current.fingerprint, fingerprint(checkpoint)
    changed = " and the ".join(name for key, name in PARTS.items() if before.get(key) != now[key])
    return current, f"The {changed} changed since version {current.manifest.software}." if changed else ""


class _Build:
    """A build whose codes are in the cache.

    Attributes:
        rows: Rows of the photos that have a code.
        about: Entries of the manifest that need no measurement.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        checkpoint: Checkpoint,
        options: BuildOptions,
        references: ReferenceBuild,
        photos: PhotoCodes,
        previous: Generation | None,
    ) -> None:
        self.checkpoint, self.options, self.references, self.photos = checkpoint, options, references, photos
        self.previous = previous
        self.rows = [
            Row(photo.path, photo.object_id, photos.digests[photo.path], photo.metadata)
            for photo in catalogue.photos
            if photo.path in photos.digests
        ]
        layouts = code_layout(checkpoint), touch_layout(checkpoint)
        self.about = {
            "checkpoint": str(checkpoint.path.resolve()),
            "catalogue": catalogue.where,
            "objects_from": options.naming.text,
            CODES: [code_model(checkpoint, layout) for layout in layouts],
            **({} if options.cells is None else {CELLS: options.cells}),
            **references.about,
            **options.about,
        }

    def write(self, store: IndexStore, cache: CodeCache) -> tuple[Generation, bool]:
        """Return the new generation and True; or the previous one and False if the new one would be equal."""
        if self.previous is not None and not self._differs(self.previous):
            return self.previous, False
        checkpoint = self.checkpoint
        calibration = {"calibration": checkpoint.posterior.to_dict()} if checkpoint.posterior else {}
        content = GenerationContent(
            self.rows,
            code_blocks(cache, checkpoint, [row.digest for row in self.rows]),
            fingerprint(checkpoint),
            self.options.kind,
            calibration | self.references.documents,
            self.about,
            self._measure,
            query_codes(checkpoint, RECALL_QUERIES)[1] if can_measure(checkpoint) else None,
            __version__,
        )
        return store.write_content(content, keep=self.options.keep), True

    def prune(self, cache: CodeCache, paths: list[str]) -> None:
        """Delete the codes that neither the new nor the previous generation uses, and the files that are gone."""
        models, digests = set(self.about[CODES]), {row.digest for row in self.rows} | set(self.references.codes)
        if self.previous is not None:
            models |= set(self.previous.manifest.about[CODES])
            digests |= {row.digest for row in self.previous.rows}
            touches = self.previous.documents.get(REFERENCE_ROWS, {"touches": []})["touches"]
            digests |= {touch_code_digest(touch["digests"]) for touch in touches}
        cache.keep(models, digests, paths)

    def _differs(self, previous: Generation) -> bool:
        manifest = previous.manifest
        return (
            manifest.fingerprint != fingerprint(self.checkpoint)
            or manifest.kind != self.options.kind
            # Compare `REFERENCE_ROWS` even if it is not in `about`: all references may have been removed.
            or any(manifest.about.get(key) != self.about.get(key) for key in (REFERENCE_ROWS, *self.about))
            or manifest.files[TEXT].sha256 != hashlib.sha256(encode_rows(self.rows)).hexdigest()
        )

    def _measure(self, index: VectorIndex, arrays: Arrays) -> dict[str, Any]:
        """Return the entries of the manifest that are measured when the arrays are on the disk."""
        manifest, candidates = self.previous.manifest if self.previous else None, None
        if manifest and manifest.kind == self.options.kind and manifest.about[CODES] == self.about[CODES]:
            candidates = kept_measurement(manifest.about["candidates"], len(self.rows), self.photos.encoded)
        if candidates is None:
            candidates = measure_candidates(self.checkpoint, index, StoredPartials(arrays), quiet=self.options.quiet)
        measured = {"candidates": candidates, "partial_error": largest_rounding(arrays[PARTIALS])}
        if self.references.rows and self.checkpoint.references is not None:
            measured[REFERENCE_CALIBRATION] = {"calibration": self.checkpoint.references.to_dict()}
        return measured
