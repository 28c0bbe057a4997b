"""Build a sharded index: several index folders over one catalogue, which are switched together.

The photos of an object go to one shard, and each shard is built as an ordinary index. Codes are reused from the shard,
from the shards of another division, and from an interrupted build. The cluster's manifest is written when every shard
is on the disk: a build that is killed leaves the cluster as it was.

A sharded index in an object store is built in a local folder, and each shard is uploaded as soon as it is complete
(`retrieval.search.sharding.object_store`).
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from _touch_retrieval.files import remove_folder
from indexes.errors import CorruptIndex, IndexesError, NoIndex, UnsupportedFormat
from indexes.kinds.base import VectorIndex
from indexes.store.cluster import (
    FOLDER,
    MOST_SHARDS,
    ClusterManifest,
    ShardEntry,
    cluster_name,
    entry_of,
    number_of,
    read_cluster,
    shard_folder,
    shard_of,
    write_cluster,
)
from indexes.store.folder import IndexStore
from indexes.store.generation import Generation
from indexes.store.locking import WriterLock
from retrieval.data.catalogue import Catalogue, CataloguePhoto, Photos
from retrieval.data.naming import Naming, doubts, per_object
from retrieval.data.sources import list_photos
from retrieval.data.storage import is_url
from retrieval.data.touched import CatalogueTouch
from retrieval.data.walking import SkippedPhoto
from retrieval.errors import BadInput, NoPhoto, TooManyBad
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.references import ROWS, WORTH
from retrieval.model.stored import fingerprint
from retrieval.search.build.build_index import BuildOptions, build_listed, naming_by
from retrieval.search.build.build_report import BuildReport
from retrieval.search.build.embed import no_photo
from retrieval.search.build.operating import SearchRequirements
from retrieval.search.sharding.object_store import StoredCluster, folder_with, names
from retrieval.version import __version__

BAD_SHARE = 0.05
"""Fraction of a catalogue's photos that may be unreadable, by default."""
_KEEP_ALL = 10**6
SUMMED = ("photos", "embedded", "reused", "renamed", "resumed", "remade", "removed", "unread", "seconds")
"""Fields of a report that add up over the shards."""


@dataclass(frozen=True)
class ShardJob:
    """One shard to build, as it is sent to the process that builds it.

    Args:
        cluster: Folder or URL of the sharded index.
        folder: Folder of the shard in it.
        catalogue: The shard's photos and touches.
        model: Path of the checkpoint.
        options: As for an index folder.
        donors: Shards of another division, whose codes may be reused.
    """

    cluster: str | Path
    folder: str
    catalogue: Catalogue
    model: Path
    options: BuildOptions
    donors: Sequence[ShardEntry]


@dataclass(frozen=True)
class ShardBuilt:
    """Result of a `ShardJob`.

    Args:
        folder: Folder of the shard.
        entry: Its entry in the manifest; None if none of its photos can be read.
        report: Its report; None likewise.
        counts: Number of photos of each object.
        skipped: Photos that could not be read.
    """

    folder: str
    entry: ShardEntry | None
    report: BuildReport | None
    counts: list[int]
    skipped: list[SkippedPhoto]


Run = Callable[[Sequence[ShardJob], Checkpoint], Iterable[ShardBuilt]]
"""Builds shards, in any order."""


def build_cluster(
    folder: str | Path,
    checkpoint: Checkpoint,
    out: str | Path,
    shards: int,
    *,
    objects_from: str | None = None,
    kind: str | type[VectorIndex] | None = None,
    min_recall: float | None = None,
    max_ms: float | None = None,
    bad_share: float = BAD_SHARE,
    verify: bool = False,
    quiet: bool = False,
    run: Run | None = None,
) -> BuildReport:
    """Write the next generation of a sharded index of a catalogue.

    Args:
        folder: The catalogue, as `build_index` takes it, and so the other arguments that are not listed here.
        checkpoint: The model.
        out: Folder or URL of the sharded index.
        shards: Number of shards.
        bad_share: Largest fraction of photos that may be unreadable.
        run: Builds the shards; None: this process, one after another.

    Returns:
        What was built, in all shards together.

    Raises:
        BadInput: The number of shards is out of range, or `out` is an index folder.
        TooManyBad: More photos than `bad_share` cannot be read.
        StorageError: The storage behind the URL refuses again and again, or another build finished first.
    """
    if not 1 <= shards <= MOST_SHARDS:
        raise BadInput(f"shards must be from 1 to {MOST_SHARDS}; got {shards}")
    if not 0 <= bad_share <= 1:
        raise BadInput(f"the share of bad photos must be from 0 to 1; got {bad_share}")
    stored = StoredCluster(str(out)) if is_url(out) else None
    own = Path(out) if stored is None else stored.work
    if (own / "CURRENT").is_file():
        raise BadInput(f"{out} is an index folder; give another one for a cluster of {shards} shards")
    asked = SearchRequirements.of(kind, min_recall, max_ms)
    with WriterLock(own / "LOCK"):
        seen = None if stored is None else stored.manifest()
        before: ClusterManifest | None = None
        note = ""
        try:
            before = read_cluster(own) if stored is None else stored.parsed(seen)
        except NoIndex:
            pass
        except (CorruptIndex, UnsupportedFormat) as error:
            note = f"The cluster there was not usable ({error})."
        naming, renamed = naming_by(objects_from, {} if before is None else before.about)
        catalogue = list_photos(folder, naming)
        if catalogue.touches and checkpoint.references is None:
            raise BadInput(
                "of a catalogue in shards the model must say what reference touches are worth, for shards would find "
                "it out each for itself, and this one does not; take one that `retrieve adapt` has made"
            )
        _sweep(own, before, shards)
        left = {} if stored is None else stored.generations()
        donors = [] if before is None or before.of == shards else before.shards
        options = BuildOptions(naming, asked, quiet, verify, keep=_KEEP_ALL)
        jobs = [
            ShardJob(out, folder, part, checkpoint.path, replace(options, about={"shard": folder}), donors)
            for folder, part in _divided(catalogue, shards)
        ]
        built = sorted((run or one_after_another)(jobs, checkpoint), key=lambda one: one.folder)
        report = _report(out, catalogue, naming, checkpoint, built)
        every = len(catalogue.photos) + len(catalogue.touches)
        what = "photos and touches" if catalogue.touches else "photos"
        if (bad := len(report.skipped)) > bad_share * every:
            first = report.skipped[0]
            raise TooManyBad(
                f"{bad} of {every} {what} cannot be read, more than the share of {bad_share:g} that is "
                f"allowed (--bad-share); the cluster stays as it was. The first: {first.path}: {first.reason}"
            )
        manifest = _manifest(before, built, shards, checkpoint, catalogue, report, asked)
        written = before is None or manifest.generation != before.generation
        if written and stored is None:
            write_cluster(own, manifest)
        elif written and stored is not None:
            stored.switch(seen, manifest)
            stored.discard(left.keys() - names([*manifest.shards, *([] if before is None else before.shards)]))
        for entry in manifest.shards:
            IndexStore(own / entry.folder).discard_before(entry.generation)
    reason = " ".join(filter(None, (renamed, note, report.reason)))
    return replace(report, generation=manifest.generation, written=written, reason=reason)


def one_after_another(jobs: Sequence[ShardJob], checkpoint: Checkpoint) -> Iterable[ShardBuilt]:
    """Build shards in this process."""
    return [build_shard(job, checkpoint) for job in jobs]


def build_shard(job: ShardJob, checkpoint: Checkpoint | None = None) -> ShardBuilt:
    """Build one shard. Raises the errors of `build_index`, except where none of its photos can be read."""
    model = checkpoint or load_checkpoint(job.model)
    stored = StoredCluster(str(job.cluster)) if is_url(job.cluster) else None
    cluster = Path(job.cluster) if stored is None else stored.work
    if stored is not None:
        stored.restore(job.folder)
    store, donors = IndexStore(cluster / job.folder), list[Generation]()
    for donor in job.donors:
        with suppress(IndexesError):  # it cannot serve then
            place = folder_with(job.cluster, donor) / donor.folder
            donors.append(IndexStore(place).open(name=donor.generation, expect=fingerprint(model)))
    try:
        report = build_listed(job.catalogue, model, store.path, replace(job.options, donors=donors))
    except NoPhoto as error:
        return ShardBuilt(job.folder, None, None, [], error.skipped)
    generation = store.open(name=report.generation, verify=False)
    counts = np.bincount(generation.codes("object_id")).tolist()
    entry = entry_of(cluster, job.folder, generation, len(counts))
    if stored is not None:
        stored.put(entry, job.options.verify)
    return ShardBuilt(job.folder, entry, report, counts, report.skipped)


def _sweep(out: Path, before: ClusterManifest | None, shards: int) -> None:
    """Delete shards of divisions that neither the current cluster nor the new one has."""
    known = set() if before is None else {entry.folder for entry in before.shards}
    for path in out.iterdir():
        division = FOLDER.fullmatch(path.name)
        if division and path.is_dir() and path.name not in known and int(division[2]) != shards:
            remove_folder(path)


def _divided(catalogue: Catalogue, shards: int) -> list[tuple[str, Catalogue]]:
    """Folder and catalogue of each shard that has photos or touches. Files that are neither belong to no shard."""
    photos, touches = defaultdict[int, list[CataloguePhoto]](list), defaultdict[int, list[CatalogueTouch]](list)
    for photo in catalogue.photos:
        photos[shard_of(photo.object_id, shards)].append(photo)
    for touch in catalogue.touches:
        touches[shard_of(touch.object_id, shards)].append(touch)
    none = replace(catalogue, ignored=(), skipped=(), notes=(), unread=())
    return [
        (shard_folder(number, shards), replace(none, photos=Photos.of(photos[number]), touches=tuple(touches[number])))
        for number in sorted(photos.keys() | touches.keys())
    ]


def _report(
    out: str | Path, catalogue: Catalogue, naming: Naming, checkpoint: Checkpoint, built: Sequence[ShardBuilt]
) -> BuildReport:
    """The reports of all shards as one. Raises NoPhoto where no shard has a photo."""
    reports = [one.report for one in built if one.report is not None]
    skipped = [*catalogue.skipped, *(item for one in built for item in one.skipped)]
    if not reports:
        raise no_photo(catalogue, skipped)
    counts = [count for one in built for count in one.counts]
    lost = {name for report in reports for name in report.without_photo}
    bad = {item.path for one in built if one.report is None for item in one.skipped}
    lost |= {photo.object_id for photo in catalogue.photos if photo.path in bad} | set(catalogue.unread)
    reason, same = Counter(report.reason for report in reports).most_common(1)[0]
    told = [report.references for report in reports if report.references]
    of_touches = {key: sum(one[key] for one in told) for key in ("touches", "objects", "alone", "encoded")}
    return replace(
        reports[0],
        **{name: sum(getattr(report, name) for report in reports) for name in SUMMED},
        index=str(out),
        generation="",
        written=True,
        model=str(checkpoint.path),
        objects=len(counts),
        objects_from=naming.text,
        per_object=per_object(counts),
        doubts=doubts(Counter(catalogue.photos.objects), naming),
        skipped=skipped,
        ignored=list(catalogue.ignored),
        without_photo=sorted(lost),
        notes=list(catalogue.notes),
        kind=", ".join(sorted({report.kind for report in reports})),
        reason=f"{len(reports)} shards; of {same} of them: {reason}",
        recall=min((report.recall for report in reports), key=lambda recall: recall["value"]),
        candidates=None,
        half_error=max(report.half_error for report in reports),
        shards=[asdict(one.entry) for one in built if one.entry is not None],
        references={**of_touches, "by": told[0]["by"]} if told else None,
    )


def _manifest(
    before: ClusterManifest | None,
    built: Sequence[ShardBuilt],
    shards: int,
    checkpoint: Checkpoint,
    catalogue: Catalogue,
    report: BuildReport,
    asked: SearchRequirements,
) -> ClusterManifest:
    """The manifest to write, or the current one where they would be equal."""
    about: dict[str, Any] = {
        "checkpoint": str(checkpoint.path.resolve()),
        "catalogue": catalogue.where,
        "objects_from": report.objects_from,
        "asked": asdict(asked),
        "half_error": report.half_error,
    }
    if report.references is not None and checkpoint.references is not None:
        about[ROWS] = {key: report.references[key] for key in ("touches", "objects")}
        about[WORTH] = {"by": report.references["by"], "worth": checkpoint.references.to_dict()}
    made = ClusterManifest(
        generation=cluster_name(1 if before is None else number_of(before.generation) + 1),
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
