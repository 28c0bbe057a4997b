"""`retrieve frontier`: measure the error and the run time of each approximation, for one model and recording."""

import os
from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from retrieval.commands.options import Json, Model, OptionValues
from retrieval.console.interruption import resumable
from retrieval.console.output import print_json, say
from retrieval.frontier import APPROXIMATIONS

if TYPE_CHECKING:
    from retrieval.frontier import Approximations

SEED = 40_000
"""Seed of the collected objects; the shipped checkpoint was trained on other seeds."""


def frontier(
    *,
    out: Annotated[Path, typer.Option(help="folder for frontier.json, frontier.html and plots")],
    recording: Annotated[
        Path | None,
        typer.Option(help="recording of unseen objects (default: collect a small one on the simulated rig)"),
    ] = None,
    model: Model = None,
    only: Annotated[
        OptionValues | None,
        typer.Option(
            parser=OptionValues.parse, metavar="NAME...", help=f"measure only these: {', '.join(APPROXIMATIONS)}"
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Plot the error of each approximation against its run time, on a page. Resumes a stopped run."""
    document = run_frontier(out, model=model, recording=recording, only=only or ())
    if json:
        print_json(document)


def run_frontier(
    out: Path,
    *,
    model: str | None,
    recording: Path | None,
    only: Sequence[str] = (),
    quick: bool = False,
    table: "Approximations" = APPROXIMATIONS,
    model_free: Collection[str] = (),
) -> dict[str, Any]:
    """Measure, and write frontier.json, frontier.html and figures/.

    Args:
        out: Folder of the results. A second run continues from them.
        model: The value of `--model`.
        recording: Grasps of objects that the model was not trained on. None to collect a few on the simulated rig, if
            a row needs them.
        only: Names of rows; empty for all.
        quick: Measure the smallest sizes only.
        table: Rows that can be measured, see `retrieval.measure_frontier`.
        model_free: Names of rows that need no model, see `retrieval.measure_frontier`.

    Returns:
        The content of frontier.json.
    """
    from retrieval.frontier.measure import measure_frontier
    from retrieval.search import defaults

    path, reason = defaults.find_model(model)
    say(f"model: {path} ({reason})")
    grasps = partial(_recording, recording, out, quick)
    with resumable(out):
        document = measure_frontier(out, path, grasps, only=only, quick=quick, table=table, model_free=model_free)
    say(f"page: {out / 'frontier.html'}")
    return document


def _recording(recording: Path | None, out: Path, quick: bool) -> Path:
    if recording is not None:
        return recording
    from retrieval.console.progress import CountedBar
    from robot.collection import CollectSettings, collect
    from robot.rig import load_rig

    objects, grasps = (6, 2) if quick else (30, 4)
    folder = out / "recording"
    say(f"collecting {grasps} grasps of each of {objects} simulated objects in {folder}")
    with CountedBar("collect", "grasps") as bar:
        collect(
            partial(load_rig, "sim", seed=SEED),
            folder,
            objects=objects,
            seed=SEED,
            settings=CollectSettings(grasps=grasps),
            jobs=os.cpu_count() or 1,
            progress=lambda now: bar(now.grasps_done, now.grasps_target, str(now)),
        )
    return folder
