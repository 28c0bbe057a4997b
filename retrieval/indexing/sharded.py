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

from _touch_retrieval.files import remove_folder
from indexes import kind_name
from indexes.errors import CorruptIndex, NoIndex, UnsupportedFormat
from indexes.kinds.vector_index import VectorIndex
from indexes.store.folder import IndexStore
from indexes.store.locking import writer_lock
from indexes.store.sharded import (
    MAX_SHARDS,
    SHARD_FOLDER,
    ShardedManifest,
    ShardEntry,
    read_sharded_manifest,
    shard_entry,
    shard_folder,
    shard_number,
    write_sharded_manifest,
)
from retrieval.data.catalogue import Catalogue, CataloguePhoto, CatalogueTouch, list_catalogue
from retrieval.data.folder_walk import SkippedPhoto
from retrieval.data.naming import Naming, naming_warnings
from retrieval.errors import BadInput, NoReadablePhoto
from retrieval.indexing.build import BuildOptions, build_listed, naming_by, no_photo, stores_cells
from retrieval.indexing.report import BuildReport
from retrieval.indexing.touches import require_reference_calibration
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.checkpoint_info import fingerprint
from retrieval.model.fusion_scorer import CELLS
from retrieval.model.references import REFERENCE_CALIBRATION, REFERENCE_ROWS
from retrieval.version import __version__


@dataclass(frozen=True)
class ShardJob:
    """One shard to build, as sent to the process that builds it.

    Attributes:
        index: Folder of the sharded index.
        folder: Folder of the shard in it.
        catalogue: The shard's photos and touches.
        model: Path of the checkpoint.
        options: As for an index folder.
    """

    index: Path
    folder: str
    catalogue: Catalogue
    model: Path
    options: BuildOptions


@dataclass(frozen=True)
class ShardBuild:
    """Result of a `ShardJob`.

    Attributes:
        folder: Folder of the shard.
        entry: Its entry in the manifest; None if none of its photos can be read.
        report: Its report; None in the same case.
        skipped: Photos that could not be read.
    """

    folder: str
    entry: ShardEntry | None
    report: BuildReport | None
    skipped: list[SkippedPhoto]


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
    quiet: bool = False,
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
        quiet: Show no progress.
        run: Builds the shards; None to build them in this process, one after another.

    Returns:
        One report of all shards together.

    Raises:
        BadInput: The number of shards is out of range, or `out` is an index folder.
    """
    if not 1 <= shards <= MAX_SHARDS:
        raise BadInput(f"shards must be from 1 to {MAX_SHARDS}; got {shards}")
    own = Path(out)
    if (own / "CURRENT").is_file():
        raise BadInput(f"{out} is an index folder; give another folder for a sharded index of {shards} shards")
    name = kind_name(kind)
    with writer_lock(own / "LOCK"):
        before: ShardedManifest | None = None
        note = ""
        try:
            before = read_sharded_manifest(own)
        except NoIndex:
            pass
        except (CorruptIndex, UnsupportedFormat) as error:
            note = f"The existing sharded index is not usable ({error})."
        about = {} if before is None else before.about
        naming, renamed = naming_by(objects_from, about)
        cells = stores_cells(cells, about, checkpoint)
        if cells is False:
            checkpoint = checkpoint.without_cells()
        catalogue = list_catalogue(folder, naming)
        if catalogue.touches:
            require_reference_calibration(checkpoint)
        _delete_old_shards(own, before, shards)
        options = BuildOptions(naming, name, quiet, cells=cells)
        jobs = [
            ShardJob(own, folder, part, checkpoint.path, replace(options, about={"shard": folder}))
            for folder, part in _split_catalogue(catalogue, shards)
        ]
        built = sorted((run or build_in_process)(jobs, checkpoint), key=lambda one: one.folder)
        report = _report(out, catalogue, naming, built)
        manifest = _manifest(before, built, shards, checkpoint, catalogue, report)
        written = before is None or manifest.generation != before.generation
        if written:
            write_sharded_manifest(own, manifest)
        for entry in manifest.shards:
            IndexStore(own / entry.folder).discard_before(entry.generation)
    reason = " ".join(filter(None, (renamed, note, report.reason)))
    return replace(report, generation=manifest.generation, written=written, reason=reason)


def build_in_process(jobs: Sequence[ShardJob], checkpoint: Checkpoint) -> Iterable[ShardBuild]:
    """Build shards in this process, one after another."""
    return [build_shard(job, checkpoint) for job in jobs]


def build_shard(job: ShardJob, checkpoint: Checkpoint | None = None) -> ShardBuild:
    """Build one shard.

    Args:
        job: The shard.
        checkpoint: The model; None to load it from `job.model`.

    Raises:
        IndexesError: The shard could not be written.
        RetrievalError: As for `build_index`, except if none of the shard's photos can be read.
    """
    model = checkpoint or load_checkpoint(job.model)
    store = IndexStore(job.index / job.folder)
    try:
        report = build_listed(job.catalogue, model, store.path, job.options)
    except NoReadablePhoto as error:
        return ShardBuild(job.folder, None, None, error.skipped)
    generation = store.open(name=report.generation, verify=False)
    return ShardBuild(job.folder, shard_entry(job.index, job.folder, generation), report, report.skipped)


def _delete_old_shards(out: Path, before: ShardedManifest | None, shards: int) -> None:
    """Delete the shards of earlier builds with another number of shards, except those of the current index."""
    known = set() if before is None else {entry.folder for entry in before.shards}
    for path in out.iterdir():
        division = SHARD_FOLDER.fullmatch(path.name)
        if division and path.is_dir() and path.name not in known and int(division[2]) != shards:
            remove_folder(path)


def _split_catalogue(catalogue: Catalogue, shards: int) -> list[tuple[str, Catalogue]]:
    """Return folder and catalogue of each shard with photos or touches; other files belong to no shard."""
    photos, touches = defaultdict[int, list[CataloguePhoto]](list), defaultdict[int, list[CatalogueTouch]](list)
    for photo in catalogue.photos:
        photos[shard_number(photo.object_id, shards)].append(photo)
    for touch in catalogue.touches:
        touches[shard_number(touch.object_id, shards)].append(touch)
    none = replace(catalogue, ignored=(), skipped=(), notes=())
    return [
        (
            shard_folder(number, shards),
            replace(none, photos=tuple(photos[number]), touches=tuple(touches[number])),
        )
        for number in sorted(photos.keys() | touches.keys())
    ]


def _report(out: str | Path, catalogue: Catalogue, naming: Naming, built: Sequence[ShardBuild]) -> BuildReport:
    """Merge the reports of all shards. Raises NoReadablePhoto if no shard has a photo."""
    reports = [one.report for one in built if one.report is not None]
    skipped = [*catalogue.skipped, *(item for one in built for item in one.skipped)]
    if not reports:
        raise no_photo(catalogue, skipped)
    lost = {name for report in reports for name in report.without_photo}
    bad = {item.path for one in built if one.report is None for item in one.skipped}
    lost |= {photo.object_id for photo in catalogue.photos if photo.path in bad}
    reason, same = Counter(report.reason for report in reports).most_common(1)[0]
    references = [report.references for report in reports if report.references]
    sums = {key: sum(one[key] for one in references) for key in ("touches", "objects", "touch_only", "encoded")}
    return replace(
        reports[0],
        **{
            name: sum(getattr(report, name) for report in reports)
            for name in ("photos", "objects", "embedded", "reused", "seconds")
        },
        index=str(out),
        warnings=naming_warnings(Counter(photo.object_id for photo in catalogue.photos), naming),
        skipped=skipped,
        ignored=list(catalogue.ignored),
        without_photo=sorted(lost),
        notes=list(catalogue.notes),
        reason=f"{len(reports)} shards; for {same} of them: {reason}",
        recall=min((report.recall for report in reports), key=lambda recall: recall["value"]),
        candidates=None,
        partial_error=max(report.partial_error for report in reports),
        shards=[asdict(one.entry) for one in built if one.entry is not None],
        references=sums if references else None,
    )


def _manifest(
    before: ShardedManifest | None,
    built: Sequence[ShardBuild],
    shards: int,
    checkpoint: Checkpoint,
    catalogue: Catalogue,
    report: BuildReport,
) -> ShardedManifest:
    """Return the new manifest, or the current one if they would be equal."""
    about: dict[str, Any] = {
        "checkpoint": str(checkpoint.path.resolve()),
        "catalogue": catalogue.where,
        "objects_from": report.objects_from,
        "partial_error": report.partial_error,
        **({} if report.cells is None else {CELLS: report.cells}),
    }
    if report.references is not None and checkpoint.references is not None:
        about[REFERENCE_ROWS] = {key: report.references[key] for key in ("touches", "objects")}
        about[REFERENCE_CALIBRATION] = {"calibration": checkpoint.references.to_dict()}
    number = 1 if before is None else 1 + int(before.generation.rpartition("-")[2])
    made = ShardedManifest(
        generation=f"sharded-{number:06d}",
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        software=__version__,
        kind=report.kind,
        fingerprint=fingerprint(checkpoint),
        about=about,
        calibration=checkpoint.posterior.to_dict() if checkpoint.posterior else None,
        of=shards,
        shards=[one.entry for one in built if one.entry is not None],
    )
    same = before is not None and before == replace(
        made, generation=before.generation, created=before.created, software=before.software
    )
    return before if before is not None and same else made
