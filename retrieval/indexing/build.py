"""Build an index from a folder of photos: list, read or find codes, and write a generation unless nothing changed."""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from _touch_retrieval.cache import Cache
from indexes import kind_name, load_kind
from indexes.errors import CorruptIndex, IndexesError, NoIndex, UnsupportedFormat
from indexes.kinds.measure import RECALL_QUERIES
from indexes.kinds.vector_index import VectorIndex
from indexes.store.folder import IndexStore
from indexes.store.generation import Arrays
from indexes.store.manifest import Manifest, read_manifest
from indexes.store.rows import TEXT, Row, encode_rows
from retrieval.console.output import abbreviate_list
from retrieval.data.camera import USUAL_CAMERA, PhotoCamera, assumed_camera, stated_keys, unusual
from retrieval.data.catalogue import METADATA_FILE, Catalogue, list_catalogue
from retrieval.data.naming import FOLDER, MAX_EXAMPLES, Naming, naming_warnings, same_name_warnings
from retrieval.errors import BadInput
from retrieval.indexing.candidates import candidates_sentence, kept_measurement, measure_candidates, query_codes
from retrieval.indexing.codes import encode_enrolled
from retrieval.indexing.contents import IndexContents, read_contents
from retrieval.indexing.enrolled import EnrolledTable
from retrieval.indexing.report import BuildReport
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.checkpoint_info import fingerprint
from retrieval.model.fusion_scorer import CELLS, StoredPartials
from retrieval.model.references import REFERENCE_ROWS
from retrieval.model.towers import NO_TOWER
from retrieval.version import __version__

PARTS = {"checkpoint": "model", "preprocessing": "preprocessing of photos"}
"""Parts of a fingerprint, by their keys."""
ASSUMED_CAMERA = "assumed_camera"
"""Key in the manifest of the camera that was assumed for photos where it is not stated: field_mm and roll_deg."""
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

    Returns:
        A report of the build.

    Raises:
        BadInput: The rule is invalid, or `cells` is given for a model without cells.
        DatasetError: No photo can be read.
        IndexesError: The kind is unknown or needs more photos, or the index could not be written and did not change.

    >>> checkpoint = retrieval.load_checkpoint("model.safetensors")
    >>> report = retrieval.build_index("catalog", checkpoint, "index")
    >>> report.photos, report.embedded  # the index exists, and no photo changed
    (4, 0)
    """
    store = IndexStore(out)
    try:
        current = read_manifest(store.path / store.current())
        before, previous = current.about, current.fingerprint
    except IndexesError:
        before, previous = {}, None
    options, note = build_options(checkpoint, before, objects_from=objects_from, kind=kind, cells=cells)
    catalogue = list_catalogue(folder, options.naming)
    options = replace(options, camera=catalogue_camera(catalogue, checkpoint, before))
    with store.lock():
        enrolled = encode_enrolled(store.path, checkpoint, options.cells)
        report = build_listed(catalogue, checkpoint, store, options)
        encode_enrolled(store.path, checkpoint, options.cells, previous)
    store.discard_before(report.generation)
    warnings = [*catalogue_warnings(before, catalogue, options, store.path), *report.warnings]
    return replace(
        report,
        warnings=warnings,
        reason=" ".join(filter(None, (note, report.reason))),
        enrolled=enrolled and enrolled.counts,
        skipped=[*report.skipped, *(enrolled.skipped if enrolled else ())],
    )


def catalogue_camera(catalogue: Catalogue, checkpoint: Checkpoint, before: Mapping[str, Any]) -> PhotoCamera:
    """Return the camera to assume for photos that do not state it; of too few objects, that of the existing index."""
    if checkpoint.config.matcher.photo_tower == NO_TOWER or not checkpoint.config.preprocessing.finds_object:
        return USUAL_CAMERA
    is_same = before.get("catalogue") == catalogue.where
    known = PhotoCamera(*before[ASSUMED_CAMERA]) if is_same and ASSUMED_CAMERA in before else USUAL_CAMERA
    photos = catalogue.photos
    looked_at = ((each.object_id, catalogue.folder / each.path, stated_keys(each.metadata)) for each in photos)
    return assumed_camera(looked_at, known)


def catalogue_warnings(
    before: Mapping[str, Any], catalogue: Catalogue, options: "BuildOptions", index: Path
) -> list[str]:
    """Return warnings on the names of objects, on an unusual camera, and if the existing index is of another catalogue.

    The other catalogue must still exist. `index`: folder with the table of enrolled touches.
    """
    enrolled = (touch.object_id for touch in EnrolledTable(index).read())
    advice = f"If that is wrong, state it in {METADATA_FILE}: see docs/catalogue.md, a good photo"
    warnings = [
        *naming_warnings(((photo.object_id, photo.path) for photo in catalogue.photos), options.naming),
        *same_name_warnings([*catalogue.object_ids, *enrolled]),
        *(f"{sentence}. {advice}" for sentence in unusual(options.camera)),
    ]
    old = str(before.get("catalogue", catalogue.where))
    if old == catalogue.where or not Path(old).is_dir():
        return warnings
    return [
        *warnings,
        f"the index was of the catalogue {old} and is now of {catalogue.where}: objects of the first are no longer "
        "found; to search both, put both below one folder, or give each its own --out",
    ]


@dataclass(frozen=True)
class BuildOptions:
    """Options of one build.

    Attributes:
        naming: Rule that names the object of a photo.
        kind: Name of the kind of index.
        cells: Store the cells of photos; None for a model without cells.
        camera: The camera that is assumed for photos that do not state it.
    """

    naming: Naming
    kind: str
    cells: bool | None
    camera: PhotoCamera = USUAL_CAMERA


def build_options(
    checkpoint: Checkpoint,
    before: Mapping[str, Any],
    *,
    objects_from: str | None,
    kind: str | type[VectorIndex],
    cells: bool | None,
) -> tuple[BuildOptions, str]:
    """Return the options of a build, and a note if the rule that names objects changed.

    Entries of the existing index's manifest, `before`, determine what the user leaves open.

    Raises:
        BadInput: As for `build_index`.
    """
    try:
        known = Naming(before["objects_from"])
    except (BadInput, KeyError, TypeError):  # no index, or a rule of another version
        known = None
    naming = Naming(objects_from) if objects_from is not None else known or Naming(FOLDER)
    if not checkpoint.config.matcher.cell_dim and cells is not None:
        raise BadInput(
            f"--cells and --no-cells need a model with late interaction, but {checkpoint.path} has none; leave the "
            "option out"
        )
    if checkpoint.config.matcher.cell_dim and cells is None:
        cells = before.get(CELLS) is not False
    note = f"The rule for object names changed from {known.text} to {naming.text}." if known and known != naming else ""
    return BuildOptions(naming, kind_name(kind), cells), note


def build_listed(catalogue: Catalogue, checkpoint: Checkpoint, store: IndexStore, options: BuildOptions) -> BuildReport:
    """Write the next generation of an index of listed photos; as `build_index`, but old generations stay.

    Raises:
        NoReadablePhoto: No photo can be read.
    """
    if options.cells is False:
        checkpoint = checkpoint.without_cells()
    load_kind(options.kind).require(options.kind, len(catalogue.photos), checkpoint.config.matcher.embedding_dim)
    with store.lock(), Cache(store.path / CACHE) as cache:
        contents = read_contents(catalogue, checkpoint, options.camera, cache)
        about = {
            "checkpoint": str(checkpoint.path.resolve()),
            "catalogue": catalogue.where,
            "objects_from": options.naming.text,
            CELLS: options.cells,
            ASSUMED_CAMERA: list(options.camera),
            **contents.references.about,
        }
        current, why = _current(store, checkpoint)
        is_written = (
            current is None
            or (current.fingerprint, current.kind) != (fingerprint(checkpoint), options.kind)
            # Compare `REFERENCE_ROWS` even if it is not in `about`: all references may have been removed.
            or any(current.about.get(key) != about.get(key) for key in (REFERENCE_ROWS, *about))
            or current.files[TEXT].sha256 != hashlib.sha256(encode_rows(contents.rows)).hexdigest()
        )
        if current is not None and not is_written:
            try:
                store.open(name=current.generation)
            except CorruptIndex as error:
                is_written, why = True, f"The existing index is not usable ({error})."
        if current is None or is_written:
            current = _write(store, cache, checkpoint, options, contents, about, current)
    return _report(store.path, catalogue, checkpoint, options, contents, current, why, is_written)


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


def _write(
    store: IndexStore,
    cache: Cache,
    checkpoint: Checkpoint,
    options: BuildOptions,
    contents: IndexContents,
    about: dict[str, Any],
    before: Manifest | None,
) -> Manifest:
    """Write a generation, and delete the codes that neither it nor the previous one uses."""
    kept, now = None, (fingerprint(checkpoint), options.kind, options.cells)
    if before is not None and (before.fingerprint, before.kind, before.about.get(CELLS)) == now:
        kept = kept_measurement(before.about.get("candidates"), len(contents.rows), contents.encoded)

    def measure(index: VectorIndex, arrays: Arrays) -> dict[str, Any]:
        candidates = kept or measure_candidates(checkpoint, index, StoredPartials(arrays))
        return {"candidates": candidates}

    touches = query_codes(checkpoint, RECALL_QUERIES)
    manifest = store.write(
        contents.rows,
        contents.blocks(cache),
        kind=options.kind,
        documents=contents.references.documents,
        queries=touches and touches[1],
        measure=measure,
        fingerprint=fingerprint(checkpoint),
        about=about,
        software=__version__,
    )
    used, keys = cache.get(_USED), [*contents.keys, *contents.references.keys]
    previous = [] if used is None else msgspec.json.decode(used, type=list[str])
    cache.keep([*keys, *previous, *cache.keys("files")])
    cache.add({_USED: msgspec.json.encode(keys)})
    return manifest


def _shared_photos(rows: Sequence[Row]) -> list[str]:
    """Return a warning if objects share a photo, which cannot tell them apart."""
    owners = defaultdict[str, dict[str, str]](dict)  # digest -> object -> path
    for row in rows:
        owners[row.digest].setdefault(row.object_id, row.path)
    return [
        f"one picture is the photo of {len(paths)} objects: {abbreviate_list(list(paths.values()), MAX_EXAMPLES)}; "
        "remove it if it is a placeholder, or merge the objects"
        for paths in owners.values()
        if len(paths) > 1
    ]


def _hard_photos(contents: IndexContents) -> list[str]:
    """Return a warning if objects are hard to recognise in photos that were encoded now."""
    if not contents.faults:
        return []
    counts = Counter(fault for faults in contents.faults.values() for fault in faults)
    return [
        f"objects are hard to recognise in {len(contents.faults)} of {contents.encoded} new photos: "
        f"{', '.join(f'{count} {fault}' for fault, count in counts.most_common())}; for example "
        f"{abbreviate_list(sorted(contents.faults), MAX_EXAMPLES)}. See docs/catalogue.md, a good photo"
    ]


def _report(
    out: Path,
    catalogue: Catalogue,
    checkpoint: Checkpoint,
    options: BuildOptions,
    contents: IndexContents,
    manifest: Manifest,
    why: str,
    is_written: bool,
) -> BuildReport:
    rows, inside = contents.rows, out.resolve()
    objects, candidates = Counter(row.object_id for row in rows), manifest.about["candidates"]
    names, first_photo = sorted(objects), {row.object_id: row.path for row in reversed(rows)}
    shown = dict.fromkeys((names[0], names[len(names) // 2], names[-1]))
    return BuildReport(
        index=str(out),
        generation=manifest.generation,
        written=is_written,
        photos=len(rows),
        objects=len(names),
        objects_from=options.naming.text,
        examples=[(name, first_photo[name]) for name in shown],
        warnings=[*_shared_photos(rows), *_hard_photos(contents)],
        embedded=contents.encoded,
        skipped=contents.skipped,
        ignored=[name for name in catalogue.ignored if not (catalogue.folder / name).resolve().is_relative_to(inside)],
        without_photo=sorted(set(catalogue.object_ids) - objects.keys()),
        notes=list(catalogue.notes),
        kind=manifest.kind,
        reason=" ".join(filter(None, (why, candidates_sentence(candidates, len(rows))))),
        recall=manifest.recall,
        candidates=candidates,
        cells=options.cells,
        references=contents.references.report,
    )
