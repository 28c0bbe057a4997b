"""From photos to a cluster: several index folders over one catalogue, switched together.

Each shard is built as an ordinary index is, over the photos of the objects that are its own: what was embedded before,
in it, in the shards of another division, or by a build that was cut off, is not embedded again. The cluster's manifest
is written when every shard is on the disk. Killed at any moment, a build leaves the cluster as it was.

A cluster in an object store is made in a folder of this machine, each shard put into the store as soon as it is made
(`retrieval.search.sharding.object_store`).
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
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
from retrieval.model.stored import fingerprint
from retrieval.search.build.build_index import Wanted, build_listed, naming_by
from retrieval.search.build.build_report import BuildReport
from retrieval.search.build.operating import Asked
from retrieval.search.query.references import ROWS, WORTH
from retrieval.search.sharding.object_store import StoredCluster, folder_with, names
from retrieval.version import __version__

BAD_SHARE = 0.05
"""Of a catalogue's photos, how many may be unreadable where nothing else is said."""
_KEEP_ALL = 10**6


@dataclass(frozen=True)
class ShardJob:
    """One shard to build, as it is sent to wherever it is built. cluster: its folder, or its URL. donors: shards of
    another division."""

    cluster: str | Path
    folder: str
    catalogue: Catalogue
    model: Path
    naming: Naming
    asked: Asked
    donors: Sequence[ShardEntry]
    verify: bool
    quiet: bool


@dataclass(frozen=True)
class ShardBuilt:
    """What became of the shard in `folder`; `entry` and `report` are None where none of its photos can be read. counts:
    how many photos each of its objects has."""

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
    """Write the next generation of the cluster `out`, a folder or a URL, over the catalogue `folder`.

    shards: into how many it is divided. run: builds them; None: here, one after another. What else is asked for is as
    `build_index` takes it, and holds for each shard. Raises its errors; BadInput for a number of shards that is none,
    or where `out` is an index folder; TooManyBad where more than a share of `bad_share` of the photos cannot be read;
    and StorageError where what lies behind the URL goes on refusing.
    """
    if not 1 <= shards <= MOST_SHARDS:
        raise BadInput(f"shards must be from 1 to {MOST_SHARDS}; got {shards}")
    if not 0 <= bad_share <= 1:
        raise BadInput(f"the share of bad photos must be from 0 to 1; got {bad_share}")
    stored = StoredCluster(str(out)) if is_url(out) else None
    own = Path(out) if stored is None else stored.work
    if (own / "CURRENT").is_file():
        raise BadInput(f"{out} is an index folder; give another one for a cluster of {shards} shards")
    asked = Asked.of(kind, min_recall, max_ms)
    with WriterLock(own / "LOCK"):
        seen = None if stored is None else stored.manifest()
        before, note = _before(lambda: read_cluster(own) if stored is None else stored.parsed(seen))
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
        jobs = [
            ShardJob(out, shard_folder(number, shards), part, checkpoint.path, naming, asked, donors, verify, quiet)
            for number, part in _divided(catalogue, shards)
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
    """Build one shard. Raises the errors of `build_index`, but none where no photo of this one can be read."""
    model = checkpoint or load_checkpoint(job.model)
    stored = StoredCluster(str(job.cluster)) if is_url(job.cluster) else None
    cluster = Path(job.cluster) if stored is None else stored.work
    if stored is not None:
        stored.restore(job.folder)
    store = IndexStore(cluster / job.folder)
    usable = [one for donor in job.donors if (one := _donor(job.cluster, donor, fingerprint(model))) is not None]
    about = {"shard": job.folder}
    wanted = Wanted(job.naming, job.asked, job.quiet, job.verify, "", about, usable, _KEEP_ALL)
    try:
        report = build_listed(job.catalogue, model, store.path, wanted)
    except NoPhoto as error:
        return ShardBuilt(job.folder, None, None, [], error.skipped)
    generation = store.open(name=report.generation, verify=False)
    counts = np.bincount(generation.codes("object_id")).tolist()
    entry = entry_of(cluster, job.folder, generation, len(counts))
    if stored is not None:
        stored.put(entry, job.verify)
    return ShardBuilt(job.folder, entry, report, counts, report.skipped)


def _before(read: Callable[[], ClusterManifest]) -> tuple[ClusterManifest | None, str]:
    """The cluster there, and why it is of no use where it is not."""
    try:
        before = read()
    except NoIndex:
        return None, ""
    except (CorruptIndex, UnsupportedFormat) as error:
        return None, f"The cluster there was not usable ({error})."
    return before, ""


def _sweep(out: Path, before: ClusterManifest | None, shards: int) -> None:
    """Delete shards of divisions that neither the cluster there nor the wanted one has."""
    known = set() if before is None else {entry.folder for entry in before.shards}
    for path in out.iterdir():
        division = FOLDER.fullmatch(path.name)
        if division and path.is_dir() and path.name not in known and int(division[2]) != shards:
            remove_folder(path)


def _divided(catalogue: Catalogue, shards: int) -> list[tuple[int, Catalogue]]:
    """The catalogue's photos and touches by shard; a shard without any is left out. What concerns neither is said of
    none."""
    photos: dict[int, list[CataloguePhoto]] = {}
    touches: dict[int, list[CatalogueTouch]] = {}
    for photo in catalogue.photos:
        photos.setdefault(shard_of(photo.object_id, shards), []).append(photo)
    for touch in catalogue.touches:
        touches.setdefault(shard_of(touch.object_id, shards), []).append(touch)
    none = replace(catalogue, ignored=(), skipped=(), notes=(), unread=())
    return [
        (number, replace(none, photos=Photos.of(photos.get(number, [])), touches=tuple(touches.get(number, ()))))
        for number in sorted(photos.keys() | touches.keys())
    ]


def _donor(cluster: str | Path, entry: ShardEntry, wanted: Mapping[str, str]) -> Generation | None:
    """A shard whose codes may be taken over; None where it cannot serve."""
    try:
        return IndexStore(folder_with(cluster, entry) / entry.folder).open(name=entry.generation, expect=wanted)
    except IndexesError:
        return None


def _report(
    out: str | Path, catalogue: Catalogue, naming: Naming, checkpoint: Checkpoint, built: Sequence[ShardBuilt]
) -> BuildReport:
    """What all builds did together. Raises NoPhoto where none of them had a photo to write."""
    reports = [one.report for one in built if one.report is not None]
    skipped = [*catalogue.skipped, *(item for one in built for item in one.skipped)]
    if not reports:
        raise NoPhoto(f"no photo in {catalogue.where} can be read; the first: {skipped[0]}", skipped)
    counts = [count for one in built for count in one.counts]
    lost = {name for report in reports for name in report.without_photo}
    bad = {item.path for one in built if one.report is None for item in one.skipped}
    lost |= {photo.object_id for photo in catalogue.photos if photo.path in bad} | set(catalogue.unread)
    reasons = Counter(report.reason for report in reports).most_common()
    return BuildReport(
        index=str(out),
        generation="",
        written=True,
        model=str(checkpoint.path),
        photos=sum(report.photos for report in reports),
        objects=len(counts),
        objects_from=naming.text,
        per_object=per_object(counts),
        examples=reports[0].examples,
        doubts=doubts(Counter(catalogue.photos.objects), naming),
        embedded=sum(report.embedded for report in reports),
        reused=sum(report.reused for report in reports),
        renamed=sum(report.renamed for report in reports),
        resumed=sum(report.resumed for report in reports),
        remade=sum(report.remade for report in reports),
        removed=sum(report.removed for report in reports),
        unread=sum(report.unread for report in reports),
        skipped=skipped,
        ignored=list(catalogue.ignored),
        without_photo=sorted(lost),
        notes=list(catalogue.notes),
        kind=", ".join(sorted({report.kind for report in reports})),
        reason=f"{len(reports)} shards; of {reasons[0][1]} of them: {reasons[0][0]}",
        recall=min((report.recall for report in reports), key=lambda recall: recall["value"]),
        candidates=None,
        half_error=max(report.half_error for report in reports),
        seconds=sum(report.seconds for report in reports),
        shards=[asdict(one.entry) for one in built if one.entry is not None],
        references=_references([report.references for report in reports if report.references]),
    )


def _references(told: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Of reference touches in all shards."""
    if not told:
        return None
    counts = {key: sum(one[key] for one in told) for key in ("touches", "objects", "alone", "encoded")}
    return {**counts, "by": told[0]["by"]}


def _manifest(
    before: ClusterManifest | None,
    built: Sequence[ShardBuilt],
    shards: int,
    checkpoint: Checkpoint,
    catalogue: Catalogue,
    report: BuildReport,
    asked: Asked,
) -> ClusterManifest:
    """The manifest to write, or the one that is there where it would say the same."""
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
