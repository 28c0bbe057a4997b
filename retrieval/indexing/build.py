"""Build an index from a folder of photos: list, find codes, then write rows, arrays, index and manifest."""

import hashlib
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from _touch_retrieval.cache import Cache
from indexes import kind_name, load_kind
from indexes.errors import CorruptIndex, IndexesError, NoIndex, UnsupportedFormat
from indexes.kinds.measure import RECALL_QUERIES
from indexes.kinds.vector_index import VectorIndex
from indexes.store.folder import IndexStore
from indexes.store.generation import EMBEDDINGS
from indexes.store.manifest import Manifest, read_manifest
from indexes.store.rows import TEXT, Row, encode_rows
from retrieval.data.catalogue import Catalogue, list_catalogue
from retrieval.data.folder_walk import SkippedPhoto
from retrieval.data.naming import FOLDER, Naming, naming_warnings
from retrieval.errors import BadInput, NoReadablePhoto
from retrieval.indexing.candidates import (
    candidates_sentence,
    kept_measurement,
    measure_candidates,
    query_codes,
)
from retrieval.indexing.codes import FileDigests, code_blocks, find_codes, photo_encoder
from retrieval.indexing.report import BuildReport
from retrieval.indexing.touches import ReferenceTouches, find_references
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.checkpoint_info import fingerprint
from retrieval.model.fusion_scorer import CELLS, PARTIALS, StoredPartials, largest_rounding
from retrieval.model.references import REFERENCE_ROWS
from retrieval.version import __version__

PARTS = {"checkpoint": "model", "preprocessing": "preprocessing of photos"}
"""Parts of a fingerprint, by their keys."""
CACHE = Path("codes", "cache.sqlite")
"""Cache of codes in the folder of an index, for all generations."""
_USED = "files/used"
"""Entry of the cache: the keys of the codes of the last generation."""


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
    report = build_listed(list_catalogue(folder, naming), checkpoint, out, options)
    IndexStore(out).discard_before(report.generation)
    return report


@dataclass(frozen=True)
class BuildOptions:
    """Options of one build.

    Attributes:
        naming: Rule that names the object of a photo.
        kind: Name of the kind of index.
        quiet: Show no progress.
        note: First sentence of the report's reason.
        about: Further entries of the manifest.
        cells: Store the cells of photos; None for a model without cells.
    """

    naming: Naming
    kind: str = "flat"
    quiet: bool = False
    note: str = ""
    about: Mapping[str, Any] = field(default_factory=dict)
    cells: bool | None = None


def build_listed(catalogue: Catalogue, checkpoint: Checkpoint, out: Path, options: BuildOptions) -> BuildReport:
    """Write the next generation of an index of listed photos; as `build_index`, but old generations stay.

    Args:
        catalogue: The listed photos and touches.
        checkpoint: The model.
        out: The index folder.
        options: The options of the build.
    """
    if options.cells is False:
        checkpoint = checkpoint.without_cells()
    load_kind(options.kind).require(options.kind, len(catalogue.photos), checkpoint.config.matcher.embedding_dim)
    store = IndexStore(out)
    with store.lock(), Cache(out / CACHE) as cache:
        files = FileDigests(catalogue, cache)
        references, catalogue = find_references(catalogue, checkpoint, cache, files.known, options.quiet)
        start, encoder = time.perf_counter(), photo_encoder(checkpoint)
        paths = [(photo.path,) for photo in catalogue.photos]
        photos = find_codes(catalogue, paths, encoder, cache, files.known, options.quiet)
        seconds = time.perf_counter() - start
        files.store(references.codes.digests | photos.digests)
        if not photos.keys:
            raise no_photo(catalogue, [*catalogue.skipped, *photos.skipped])
        rows = [
            Row(photo.path, photo.object_id, photos.digests[photo.path], photo.metadata)
            for photo in catalogue.photos
            if (photo.path,) in photos.keys
        ]
        about: dict[str, Any] = {
            "checkpoint": str(checkpoint.path.resolve()),
            "catalogue": catalogue.where,
            "objects_from": options.naming.text,
            **({} if options.cells is None else {CELLS: options.cells}),
            **references.about(checkpoint),
            **options.about,
        }
        current, why = _current(store, checkpoint)
        manifest = None if current is None or _differs(current, checkpoint, options, rows, about) else current
        if manifest is not None:
            try:
                store.open(name=manifest.generation)
            except CorruptIndex as error:
                manifest, why = None, f"The existing index is not usable ({error})."
        is_written = manifest is None
        if manifest is None:
            keys = [photos.keys[row.path,] for row in rows]
            candidates = _measured_before(current, checkpoint, options, len(rows), photos.encoded)
            with store.draft() as draft:
                draft.write_rows(rows)
                arrays = draft.write_arrays(code_blocks(cache, encoder, keys))
                calibration = {"calibration": checkpoint.posterior.to_dict()} if checkpoint.posterior else {}
                draft.write_documents(calibration | references.documents)
                touches = query_codes(checkpoint, RECALL_QUERIES)
                index = draft.build_index(arrays[EMBEDDINGS], options.kind, queries=touches and touches[1])
                if candidates is None:
                    candidates = measure_candidates(checkpoint, index, StoredPartials(arrays), quiet=options.quiet)
                about |= {"candidates": candidates, "partial_error": largest_rounding(arrays[PARTIALS])}
                manifest = draft.finish(fingerprint=fingerprint(checkpoint), about=about, software=__version__)
            _forget_unused(cache, [*keys, *references.codes.keys.values()])
    return _report(
        out,
        catalogue,
        checkpoint,
        options,
        manifest,
        rows,
        references,
        why,
        is_written=is_written,
        embedded=photos.encoded,
        seconds=seconds,
        skipped=photos.skipped,
    )


def no_photo(catalogue: Catalogue, skipped: list[SkippedPhoto]) -> NoReadablePhoto:
    """Return the error for a catalogue without a readable photo.

    Args:
        catalogue: The catalogue.
        skipped: Its photos that could not be read, at least one.
    """
    first = skipped[0]
    return NoReadablePhoto(
        f"no photo in {catalogue.where} can be read; the first: {first.path}: {first.reason}", skipped
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


def _current(store: IndexStore, checkpoint: Checkpoint) -> tuple[Manifest | None, str]:
    """Return the manifest of the current generation, and what changed since."""
    try:
        current = read_manifest(store.path / store.current())
    except NoIndex:
        return None, ""
    except (CorruptIndex, UnsupportedFormat) as error:
        return None, f"The existing index is not usable ({error})."
    before, now = current.fingerprint, fingerprint(checkpoint)
    changed = " and the ".join(name for key, name in PARTS.items() if before.get(key) != now[key])
    return current, f"The {changed} changed since version {current.software}." if changed else ""


def _differs(
    manifest: Manifest, checkpoint: Checkpoint, options: BuildOptions, rows: Sequence[Row], about: Mapping[str, Any]
) -> bool:
    """Whether a new generation would differ from the current one."""
    return (
        manifest.fingerprint != fingerprint(checkpoint)
        or manifest.kind != options.kind
        # Compare `REFERENCE_ROWS` even if it is not in `about`: all references may have been removed.
        or any(manifest.about.get(key) != about.get(key) for key in (REFERENCE_ROWS, *about))
        or manifest.files[TEXT].sha256 != hashlib.sha256(encode_rows(rows)).hexdigest()
    )


def _measured_before(
    manifest: Manifest | None, checkpoint: Checkpoint, options: BuildOptions, photos: int, encoded: int
) -> dict[str, Any] | None:
    """Return the measured number of candidates of the current generation if it still holds; else None."""
    if manifest is None or manifest.kind != options.kind or manifest.about.get(CELLS) != options.cells:
        return None
    if manifest.fingerprint != fingerprint(checkpoint):
        return None
    return kept_measurement(manifest.about.get("candidates"), photos, encoded)


def _forget_unused(cache: Cache, keys: list[str]) -> None:
    """Delete the codes that neither the new nor the previous generation uses."""
    before = cache.get(_USED)
    used = [] if before is None else msgspec.json.decode(before, type=list[str])
    cache.keep([*keys, *used, *cache.keys("files")])
    cache.add({_USED: msgspec.json.encode(keys)})


def _report(
    out: Path,
    catalogue: Catalogue,
    checkpoint: Checkpoint,
    options: BuildOptions,
    manifest: Manifest,
    rows: Sequence[Row],
    references: ReferenceTouches,
    why: str,
    *,
    is_written: bool,
    embedded: int,
    seconds: float,
    skipped: list[SkippedPhoto],
) -> BuildReport:
    objects, inside, candidates = Counter(row.object_id for row in rows), out.resolve(), manifest.about["candidates"]
    names, first_photo = sorted(objects), {row.object_id: row.path for row in reversed(rows)}
    shown = dict.fromkeys((names[0], names[len(names) // 2], names[-1]))
    sentences = (options.note, why, candidates_sentence(candidates, len(rows)))
    encoded = {"touch_only": len(references.touch_only), "encoded": references.codes.encoded}
    return BuildReport(
        index=str(out),
        generation=manifest.generation,
        written=is_written,
        model=str(checkpoint.path),
        photos=len(rows),
        objects=len(names),
        objects_from=options.naming.text,
        examples=[(name, first_photo[name]) for name in shown],
        warnings=naming_warnings(objects, options.naming),
        embedded=embedded,
        reused=len(rows) - embedded,
        skipped=[*catalogue.skipped, *skipped, *references.skipped],
        ignored=[name for name in catalogue.ignored if not (catalogue.folder / name).resolve().is_relative_to(inside)],
        without_photo=sorted(set(catalogue.object_ids) - objects.keys()),
        notes=list(catalogue.notes),
        kind=manifest.kind,
        reason=" ".join(filter(None, sentences)),
        recall=manifest.recall,
        candidates=candidates,
        partial_error=manifest.about["partial_error"],
        cells=options.cells,
        seconds=seconds,
        references={**references.counts, **encoded} if references.rows else None,
    )
