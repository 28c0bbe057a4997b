"""`retrieve build-index`: make a folder of photos searchable."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from retrieval.commands.options import COUNT, Json, Model, resolve_model
from retrieval.console.interruption import resumable
from retrieval.console.output import print_json, say
from retrieval.errors import BadInput, RetrievalError

if TYPE_CHECKING:
    from retrieval.indexing.report import BuildReport
    from retrieval.model.checkpoint import Checkpoint

PREVIEW_PHOTOS = 16
"""Photos in a preview, at even distances in the catalogue."""


def build_index(
    catalogue: Annotated[
        Path,
        typer.Argument(help="folder with <object>/<photo> or <object>.<ext>, or a recording"),
    ],
    *,
    objects_from: Annotated[
        str | None,
        typer.Option(
            metavar="RULE",
            help="rule that finds the object's name in a photo's path. folder: the first folder, or the file name if "
            "there is none; stem: the file name without its number; or a pattern such as {split}/{object}/{photo} or "
            "{object}_{view}.jpg (default: the rule of the existing index, else folder)",
        ),
    ] = None,
    model: Model = None,
    out: Annotated[Path, typer.Option(help="index folder")] = Path("index"),
    kind: Annotated[
        str,
        typer.Option(
            help="kind of the candidate index: flat, exact search; a factory string of FAISS with search settings "
            "after a semicolon, such as 'IVF1024,SQ8;nprobe=32' or 'HNSW32;efSearch=64'; or module:Class"
        ),
    ] = "flat",
    cells: Annotated[
        bool | None,
        typer.Option(
            "--cells/--no-cells",
            help="store the cells of photos, for late interaction; without them the index is smaller and reranking "
            "faster (default: as in OUT, else store them if the model has them)",
        ),
    ] = None,
    preview: Annotated[
        bool, typer.Option("--preview", help="write OUT/views.png: some photos as the model receives them")
    ] = False,
    shards: Annotated[
        int | None,
        typer.Option(
            parser=COUNT,
            help="number of shards (index folders) of the catalogue (default: as in OUT, else none)",
        ),
    ] = None,
    cluster: Annotated[
        bool,
        typer.Option(
            "--cluster", help="build shards in parallel on the Ray cluster at RAY_ADDRESS, else on Ray on this machine"
        ),
    ] = False,
    json: Json = False,
) -> None:
    """Make a folder of photos searchable."""
    from indexes.store.sharded import is_sharded, read_sharded_manifest
    from retrieval.data.catalogue import require_separate_folders
    from retrieval.indexing import build, sharded
    from retrieval.model.checkpoint import load_checkpoint
    from retrieval.model.export import export_to_cache
    from retrieval.model.shipped import is_shipped

    require_separate_folders(catalogue, out)
    if shards is None and is_sharded(out):
        shards = read_sharded_manifest(out).of
    if shards is None and cluster:
        raise BadInput("--cluster needs shards; give --shards too")
    path = resolve_model(model, out)
    checkpoint = load_checkpoint(path)
    options: dict[str, Any] = {"objects_from": objects_from, "kind": kind, "cells": cells}
    run = None
    if cluster:
        from retrieval.cluster.building import build_on_ray

        run = build_on_ray
    with resumable(out):
        if shards is None:
            report = build.build_index(catalogue, checkpoint, out, **options)
        else:
            report = sharded.build_sharded(catalogue, checkpoint, out, shards, run=run, **options)
    if is_shipped(path) and (exported := export_to_cache(checkpoint)):
        say(f"exported once, for queries without PyTorch: {exported}")
    for line in report.lines():
        say(line)
    if preview:
        _write_views(catalogue, out, report, checkpoint)
    if json:
        print_json(asdict(report))
    if lost := len(report.without_photo):
        raise RetrievalError(f"the index is written, but {lost} object(s) have no readable photo; see above")


def _write_views(catalogue: Path, index: Path, report: "BuildReport", checkpoint: "Checkpoint") -> None:
    """Write some photos of the index, or of its first shard, as the model receives them."""
    from indexes.store.folder import IndexStore
    from retrieval.data.camera import PhotoCamera, stated_camera
    from retrieval.indexing.build import ASSUMED_CAMERA
    from retrieval.report.pages import write_views

    generation = IndexStore(index / report.shards[0]["folder"] if report.shards else index).open(verify=False)
    rows, assumed = generation.rows, PhotoCamera(*generation.manifest.about[ASSUMED_CAMERA])
    chosen = sorted({number * len(rows) // PREVIEW_PHOTOS for number in range(PREVIEW_PHOTOS)})
    shown = {catalogue / row.path: stated_camera(row.metadata, assumed) for row in map(rows.__getitem__, chosen)}
    write_views(shown, checkpoint.config.preprocessing, index / "views.png")
    say(f"views: {len(chosen)} photos in {index / 'views.png'}")
