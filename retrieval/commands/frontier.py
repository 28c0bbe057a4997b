"""`retrieve frontier`: measure the error and the run time of each approximation, for one model and recording."""

import os
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from retrieval.commands.options import Json, Model, OptionValues, resolve_model
from retrieval.console.interruption import resumable
from retrieval.console.output import print_json, say
from retrieval.frontier import APPROXIMATIONS

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
    from retrieval.frontier.measure import measure_frontier

    path = resolve_model(model)
    with resumable(out):
        document = measure_frontier(out, path, partial(recording_of, recording, out), only=only or ())
    say(f"page: {out / 'frontier.html'}")
    if json:
        print_json(document)


def recording_of(recording: Path | None, out: Path, quick: bool = False) -> Path:
    """Return the folder of the recording, after a small one is collected under `out` if it is None."""
    if recording is not None:
        return recording
    from retrieval.commands.collect import collect

    objects, grasps, jobs = (6, 2, 1) if quick else (30, 4, os.cpu_count() or 1)
    say(f"collecting {grasps} grasps of each of {objects} simulated objects in {out / 'recording'}")
    collect(objects=objects, grasps=grasps, out=out / "recording", seed=SEED, jobs=jobs)
    return out / "recording"
