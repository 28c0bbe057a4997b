"""Build a sharded index: several index folders over one catalogue, which are switched together.

All photos of an object go to one shard, and each shard is built as an ordinary index, with a cache of codes of its own.
The manifest is written when every shard is on the disk, so a killed build does not change the index.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from _touch_retrieval.files import file_digest, remove_folder
from indexes.errors import CorruptIndex, NoIndex, UnsupportedFormat
from indexes.kinds.vector_index import VectorIndex
from indexes.store.folder import IndexStore
from indexes.store.locking import writer_lock
from indexes.store.manifest import NAME as MANIFEST
from indexes.store.sharded import (
    MAX_SHARDS,
    SHARD_FOLDER,
    ShardedManifest,
    ShardEntry,
    read_sharded_manifest,
    shard_number,
    write_sharded_manifest,
)
from retrieval.data.catalogue import Catalogue, list_catalogue
from retrieval.errors import BadInput, NoReadablePhoto
from retrieval.indexing.build import (
    ASSUMED_CAMERA,
    BuildOptions,
    build_listed,
    build_options,
    catalogue_camera,
    catalogue_warnings,
)
from retrieval.indexing.codes import encode_enrolled
from retrieval.indexing.contents import no_photo, require_reference_calibration
from retrieval.indexing.report import BuildReport
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.checkpoint_info import fingerprint
from retrieval.model.fusion_scorer import CELLS
from retrieval.model.references import REFERENCE_ROWS
from retrieval.version import __version__


@dataclass(frozen=True)
class ShardJob:
    """One shard to build: its folder, its photos and touches, and the options."""

    folder: Path
    catalogue: Catalogue
    options: BuildOptions


ShardBuild = BuildReport | NoReadablePhoto
"""Result of a `ShardJob`: an error if none of its photos can be read."""
ShardRunner = Callable[[Sequence[ShardJob], Checkpoint], Iterable[ShardBuild]]
"""Builds shards, in any order."""


def build_sharded(
    folder: str | Path,
    checkpoint: Checkpoint,
    out: str | Path,
    shards: int,
    *,
    objects_from: str | None = None,
    kind: str | type[VectorIndex] = "flat",
    cells: bool | None = None,
    run: ShardRunner | None = None,
) -> BuildReport:
    """Write the next generation of a sharded index of a catalogue.

    Args:
        folder: The catalogue, as for `build_index`.
        checkpoint: The model.
        out: Folder of the sharded index.
        shards: Number of shards.
        objects_from: As for `build_index`.
        kind: As for `build_index`.
        cells: As for `build_index`.
        run: Builds the shards; None to build them in this process, one after another.

    Returns:
        One report of all shards together.

    Raises:
        BadInput: The number of shards is out of range, or `out` is an index folder.
    """
    root = Path(out)
    if not 1 <= shards <= MAX_SHARDS:
        raise BadInput(f"shards must be from 1 to {MAX_SHARDS}; got {shards}")
    if (root / "CURRENT").is_file():
        raise BadInput(f"{out} is an index folder; give another folder for a sharded index of {shards} shards")
    with writer_lock(root / "LOCK"):
        before, unusable = None, ""
        try:
            before = read_sharded_manifest(root)
        except NoIndex:
            pass
        except (CorruptIndex, UnsupportedFormat) as error:
            unusable = f"The existing sharded index is not usable ({error})."
        known = before.about if before else {}
        options, note = build_options(checkpoint, known, objects_from=objects_from, kind=kind, cells=cells)
        catalogue = list_catalogue(folder, options.naming)
        options = replace(options, camera=catalogue_camera(catalogue, checkpoint, known))
        if catalogue.touches:  # before any shard is built
            require_reference_calibration(checkpoint.without_cells() if options.cells is False else checkpoint)
        _delete_old_shards(root, before, shards)
        jobs = [ShardJob(root / name, part, options) for name, part in _split_catalogue(catalogue, shards)]
        enrolled = encode_enrolled(root, checkpoint, options.cells)
        built = list(run(jobs, checkpoint)) if run else [build_shard(job, checkpoint) for job in jobs]
        reports = sorted((result for result in built if isinstance(result, BuildReport)), key=lambda part: part.index)
        unreadable = [result for result in built if isinstance(result, NoReadablePhoto)]
        report = _report(root, catalogue, reports, unreadable)
        manifest = _manifest(before, shards, checkpoint, catalogue, options, report, reports)
        if written := before is None or manifest.generation != before.generation:
            write_sharded_manifest(root, manifest)
        encode_enrolled(root, checkpoint, options.cells, before.fingerprint if before else None)
        for entry in manifest.shards:
            IndexStore(root / entry.folder).discard_before(entry.generation)
    return replace(
        report,
        generation=manifest.generation,
        written=written,
        warnings=[
            *catalogue_warnings(known, catalogue, options, root),
            *report.warnings,
        ],
        reason=" ".join(filter(None, (note, unusable, report.reason))),
        shards=[asdict(entry) for entry in manifest.shards],
        enrolled=enrolled and enrolled.counts,
        skipped=[*report.skipped, *(enrolled.skipped if enrolled else ())],
    )


def build_shard(job: ShardJob, checkpoint: Checkpoint) -> ShardBuild:
    """Build one shard. Raises the errors of `build_index`, except for a shard without a readable photo."""
    try:
        return build_listed(job.catalogue, checkpoint, IndexStore(job.folder), job.options)
    except NoReadablePhoto as error:
        return error


def _delete_old_shards(out: Path, before: ShardedManifest | None, shards: int) -> None:
    """Delete the shards of earlier builds with another number of shards, except those of the current index."""
    known = set() if before is None else {entry.folder for entry in before.shards}
    for path in out.iterdir():
        division = SHARD_FOLDER.fullmatch(path.name)
        if division and path.is_dir() and path.name not in known and int(division[2]) != shards:
            remove_folder(path)


def _split_catalogue(catalogue: Catalogue, shards: int) -> Iterable[tuple[str, Catalogue]]:
    """Yield folder and catalogue of each shard with photos or touches; other files belong to no shard."""
    photos, touches = defaultdict[int, list[Any]](list), defaultdict[int, list[Any]](list)
    for parts, items in ((photos, catalogue.photos), (touches, catalogue.touches)):
        for item in items:
            parts[shard_number(item.object_id, shards)].append(item)
    none = replace(catalogue, ignored=(), skipped=(), notes=())
    for number in sorted(photos.keys() | touches.keys()):
        part = replace(none, photos=tuple(photos[number]), touches=tuple(touches[number]))
        yield f"shard-{number:02d}-of-{shards:02d}", part


def _report(
    out: Path, catalogue: Catalogue, reports: Sequence[BuildReport], unreadable: Sequence[NoReadablePhoto]
) -> BuildReport:
    """Merge the reports of all shards. Raises NoReadablePhoto if no shard has a photo."""
    bad = [item for error in unreadable for item in error.skipped]
    skipped = [*catalogue.skipped, *(item for report in reports for item in report.skipped), *bad]
    if not reports:
        raise no_photo(catalogue, skipped)
    paths = {item.path for item in bad}
    lost = {photo.object_id for photo in catalogue.photos if photo.path in paths}
    reason, same = Counter(report.reason for report in reports).most_common(1)[0]
    references = [report.references for report in reports if report.references]
    sums = {key: sum(counts[key] for counts in references) for key in ("touches", "objects", "touch_only", "encoded")}
    return replace(
        reports[0],
        **{name: sum(getattr(report, name) for report in reports) for name in ("photos", "objects", "embedded")},
        index=str(out),
        warnings=[warning for report in reports for warning in report.warnings],
        skipped=skipped,
        ignored=list(catalogue.ignored),
        without_photo=sorted(lost.union(*(report.without_photo for report in reports))),
        notes=list(catalogue.notes),
        reason=f"{len(reports)} shards; for {same} of them: {reason}",
        recall=min((report.recall for report in reports), key=lambda recall: recall["value"]),
        candidates=None,
        references=sums if references else None,
    )


def _manifest(
    before: ShardedManifest | None,
    shards: int,
    checkpoint: Checkpoint,
    catalogue: Catalogue,
    options: BuildOptions,
    report: BuildReport,
    reports: Sequence[BuildReport],
) -> ShardedManifest:
    """Return the new manifest, or the current one if they would be equal."""
    about: dict[str, Any] = {
        "checkpoint": str(checkpoint.path.resolve()),
        "catalogue": catalogue.where,
        "objects_from": report.objects_from,
        ASSUMED_CAMERA: list(options.camera),
        CELLS: report.cells,
    }
    if report.references is not None:
        about[REFERENCE_ROWS] = {key: report.references[key] for key in ("touches", "objects")}
    manifest = ShardedManifest(
        generation=f"sharded-{1 + int(before.generation.rpartition('-')[2]) if before else 1:06d}",
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        software=__version__,
        kind=report.kind,
        fingerprint=fingerprint(checkpoint),
        about=about,
        of=shards,
        shards=[
            ShardEntry(
                folder=Path(part.index).name,
                generation=part.generation,
                sha256=file_digest(Path(part.index, part.generation, MANIFEST)),
                photos=part.photos,
                objects=part.objects,
            )
            for part in reports
        ],
    )
    if before is None:
        return manifest
    same = replace(manifest, generation=before.generation, created=before.created, software=before.software)
    return before if before == same else manifest
