"""`retrieve adapt`: fit a checkpoint to a new sensor and your own objects, from a few of them."""

from pathlib import Path
from typing import Annotated

import typer

from retrieval.commands.options import SEED, SPLIT, CheckpointOut, Recording, read_split
from retrieval.console.output import say


def adapt(
    recording: Recording,
    *,
    out: CheckpointOut,
    model: Annotated[
        Path | None,
        typer.Option(help="checkpoint to start from (default: the shipped one with the same number of fingers)"),
    ] = None,
    init: Annotated[
        str,
        typer.Option(
            help="weights of a published tower that is combined with the model's towers: imagenet, a file, or none"
        ),
    ] = "imagenet",
    split: Annotated[Path | None, typer.Option(help=f"{SPLIT}; test objects are not used")] = None,
    cache: Annotated[
        Path | None, typer.Option(help="folder that stores image features, to resume a stopped run")
    ] = None,
    seed: Annotated[int, typer.Option(parser=SEED, help="seed of the folds")] = 0,
) -> None:
    """Fit a model to a new sensor and your own objects. Takes minutes on two cores."""
    from retrieval.adaptation.recipe import adapt as fit
    from retrieval.data.check.recording import check_gel_layout

    for finding in check_gel_layout(recording):
        say(f"{finding.severity}: {finding.message}")
    result = fit(recording, out, model, init=init, split=read_split(split), cache=cache, seed=seed)
    for line in result.lines():
        say(line)
