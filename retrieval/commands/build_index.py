"""`retrieve build-index`: make a folder of photos searchable."""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from indexes import KINDS
from retrieval.commands.options import COUNT, SHARE, Json, Model, NumberParser, announce_resume
from retrieval.console.files import PREVIEW, require_ours
from retrieval.console.output import print_json, say
from retrieval.data.storage import is_url
from retrieval.errors import BadInput, RetrievalError

if TYPE_CHECKING:
    from retrieval.model.checkpoint import Checkpoint
    from retrieval.search.build.build_report import BuildReport

PREVIEW_PHOTOS = 16
"""Photos of the catalogue, evenly chosen, that a preview shows."""


def build_index(
    catalogue: Annotated[
        str,
        typer.Argument(help="folder: <object>/<photo> or <object>.<ext>; or a URL of one, of Parquet or of tar files"),
    ],
    *,
    objects_from: Annotated[
        str | None,
        typer.Option(
            metavar="RULE",
            help="what names a photo's object: folder (the first one, else the file), stem (the file's name without "
            "its number), or a pattern such as {split}/{object}/{photo} or {object}_{view}.jpg (default: as the index "
            "has it, else folder)",
        ),
    ] = None,
    model: Model = None,
    out: Annotated[str, typer.Option(help="index folder; or a URL, where shards are put")] = "index",
    kind: Annotated[
        str | None,
        typer.Option(help=f"candidate index: {', '.join(KINDS)} (default: exact, unless a bound asks for more)"),
    ] = None,
    min_recall: Annotated[
        float | None,
        typer.Option(parser=SHARE, help="least share of touches whose best photo must be found (default: 0.99)"),
    ] = None,
    max_ms: Annotated[
        float | None,
        typer.Option(
            parser=NumberParser(float, 0, 86_400_000),
            help="longest search in milliseconds: candidates and judging them",
        ),
    ] = None,
    preview: Annotated[
        bool, typer.Option("--preview", help="write OUT-views.png: what the model sees of some of the photos")
    ] = False,
    shards: Annotated[
        int | None,
        typer.Option(
            parser=COUNT,
            help="index folders to divide the catalogue over (default: as OUT has it, else one, undivided)",
        ),
    ] = None,
    max_unreadable: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE", parser=SHARE, help="of shards: photos that may be unreadable (default: 0.05 of all)"
        ),
    ] = None,
    cluster: Annotated[
        bool,
        typer.Option("--cluster", help="shards are built by Ray, side by side: that of RAY_ADDRESS, else one here"),
    ] = False,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify",
            help="read every photo's file, also those whose size, times and inode did not change; and of a URL what "
            "was put there",
        ),
    ] = False,
    json: Json = False,
) -> None:
    """Make a folder of photos searchable."""
    from retrieval.data.catalogue import require_separate_folders
    from retrieval.model.checkpoint import load_checkpoint
    from retrieval.model.export import export_to_cache
    from retrieval.search import defaults
    from retrieval.search.build import build_index as build
    from retrieval.search.sharding import build_sharded
    from retrieval.search.sharding.object_store import RemoteShardedIndex

    if not is_url(out):
        require_separate_folders(catalogue, out)
    sheet = _preview_path(catalogue, out) if preview else None
    shards = _shard_count(shards, out, has_shard_options=max_unreadable is not None or cluster)
    path, why = defaults.find_model(model, out)
    say(f"model: {path} ({why})")
    checkpoint = load_checkpoint(path)
    asked: dict[str, Any] = {
        "objects_from": objects_from,
        "kind": kind,
        "min_recall": min_recall,
        "max_ms": max_ms,
        "verify": verify,
    }
    run = None
    if cluster:
        from retrieval.cluster.building import ray_runner

        run = ray_runner()
    with announce_resume(f"what was embedded is kept in {RemoteShardedIndex(out).work if is_url(out) else out}"):
        if shards is None:
            report = build.build_index(catalogue, checkpoint, Path(out), **asked)
        else:
            allowed = build_sharded.MAX_UNREADABLE if max_unreadable is None else max_unreadable
            report = build_sharded.build_sharded(
                catalogue, checkpoint, out, shards, max_unreadable=allowed, run=run, **asked
            )
    defaults.remember("index", out)
    if defaults.is_shipped(path) and (made := export_to_cache(checkpoint)):
        say(f"for queries without PyTorch, once: {made}")
    for line in report.lines():
        say(line)
    if sheet is not None:
        _write_views(sheet, Path(catalogue), Path(out), report, checkpoint)
    if json:
        print_json(report.to_dict())
    if report.without_photo:
        count = len(report.without_photo)
        raise RetrievalError(f"the index is written, but {count} object(s) have no photo that can be read; see above")


def _preview_path(catalogue: str, out: str) -> Path:
    """The picture that a preview is written to. Raises BadInput where it cannot be, before anything is built."""
    from retrieval.data.sources import is_url_or_archive

    folder = Path(out).resolve()
    sheet = folder.with_name(f"{folder.name}-views.png")
    require_ours(sheet, PREVIEW)
    if Path(catalogue).resolve() in sheet.parents:
        raise BadInput(f"{sheet} would be a photo of the catalogue {catalogue}; name an --out outside it for --preview")
    for place, is_far in ((catalogue, is_url_or_archive), (out, is_url)):
        if is_far(place):
            raise BadInput(f"--preview shows photos of a folder of this machine beside it; {place} is none")
    return sheet


def _shard_count(asked: int | None, out: str, *, has_shard_options: bool) -> int | None:
    """How many shards to build: as many as asked for, else as many as `out` has; None for one index folder.

    of_shards: whether an option was given that shards alone have. Raises BadInput where there are none then.
    """
    from indexes.errors import NoIndex
    from retrieval.search.sharding.object_store import is_sharded, read_sharded_manifest

    if asked is None and is_sharded(out):
        with suppress(NoIndex):
            return read_sharded_manifest(out).of
        return 1  # the first one behind a URL
    if asked is None and has_shard_options:
        raise BadInput("--max-unreadable and --cluster are for a catalogue in shards; give --shards too")
    return asked


def _write_views(sheet: Path, catalogue: Path, index: Path, report: "BuildReport", checkpoint: "Checkpoint") -> None:
    """Write what the model sees of some photos of the index, or of its first shard."""
    from indexes.store.folder import IndexStore
    from retrieval.report.pages import write_views

    first = IndexStore(index / report.shards[0]["folder"] if report.shards else index)
    rows = first.open(verify=False).rows
    chosen = sorted({place * len(rows) // PREVIEW_PHOTOS for place in range(PREVIEW_PHOTOS)})
    write_views([catalogue / rows[row]["path"] for row in chosen], checkpoint.config.preprocessing, sheet)
    say(f"views: {len(chosen)} photos in {sheet}")
