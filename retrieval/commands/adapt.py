"""`retrieve adapt`: fit a checkpoint to a new sensor and your own objects, from a few of them."""

from pathlib import Path
from typing import Annotated

import typer

from retrieval.commands.options import SPLIT, CheckpointOut, Recording, read_split
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
) -> None:
    """Fit a model to a new sensor and your own objects. Takes minutes on two cores."""
    from retrieval.data.check.recording import check_gel_layout
    from retrieval.report.adaptation import print_adaptation
    from retrieval.training.adapt import adapt as fit

    for finding in check_gel_layout(recording):
        say(f"{finding.severity}: {finding.message}")
    print_adaptation(fit(recording, out, model, init=init, split=read_split(split)))
