"""`retrieve adapt`: a checkpoint for a new sensor and own objects, from a few of them."""

from pathlib import Path
from typing import Annotated

import typer

from retrieval.commands.options import SEED, SPLIT, CheckpointOut, Recording, read_split
from retrieval.console.files import TEXT, require_ours
from retrieval.console.output import say


def adapt(
    recording: Recording,
    *,
    out: CheckpointOut,
    model: Annotated[
        Path | None, typer.Option(help="checkpoint to start from (default: the shipped one of as many fingers)")
    ] = None,
    init: Annotated[
        str,
        typer.Option(help="published weights whose tower stands beside those of the model: imagenet, a file, or none"),
    ] = "imagenet",
    split: Annotated[Path | None, typer.Option(help=f"{SPLIT}; the test objects are left out")] = None,
    report: Annotated[
        Path | None, typer.Option(help="folder for the learning curve: how many touches of how many objects it takes")
    ] = None,
    cache: Annotated[
        Path | None, typer.Option(help="folder where features of images are kept, to go on where it was stopped")
    ] = None,
    seed: Annotated[int, typer.Option(parser=SEED, help="seed of the folds")] = 0,
) -> None:
    """Fit a model to a new sensor and own objects; minutes on two cores."""
    from retrieval.adaptation.recipe import adapt as fit
    from retrieval.search import defaults

    if report:
        require_ours(report / "curve.md", TEXT)
    made = fit(recording, out, model, init=init, split=read_split(split), report=report, cache=cache, seed=seed)
    defaults.remember("model", out)
    for line in made.lines():
        say(line)
    if report and not made.report:
        say(f"{report} is not written: a learning curve, too, is judged on objects that are left out")
