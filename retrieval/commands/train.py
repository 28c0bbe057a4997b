"""`retrieve train`: a matcher, or a gate for `retrieve collect`."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from retrieval.commands.options import INIT, SPLIT, Recording, read_split, training_config
from retrieval.console.output import say
from retrieval.errors import BadInput


def train(
    recording: Recording,
    *,
    task: Annotated[
        Literal["match", "grasp-success"],
        typer.Option(help="match: does this touch belong to this photo? grasp-success: did the grasp succeed?"),
    ] = "match",
    out: Annotated[Path, typer.Option(help="checkpoint to write (.safetensors)")],
    config: Annotated[
        str | None, typer.Option(help="preset (small, mobilenet, paper) or TOML file (default: small)")
    ] = None,
    init: Annotated[str | None, typer.Option(help=INIT)] = None,
    iterations: Annotated[int | None, typer.Option(help="optimiser steps, instead of the configuration's")] = None,
    seed: Annotated[
        int | None, typer.Option(help="seed of split, pairs and weights, instead of the configuration's")
    ] = None,
    split: Annotated[Path | None, typer.Option(help=SPLIT)] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on with an unfinished training of --out")] = False,
) -> None:
    """Train a matcher, or a gate for `collect`, on a recording."""
    if task == "grasp-success":
        for option, value in {"--config": config, "--init": init, "--split": split, "--resume": resume}.items():
            if value:
                raise BadInput(f"{option} is of matchers; --task grasp-success takes --iterations and --seed")
        _train_gate(recording, out, iterations, seed)
        return
    from retrieval.search import defaults
    from retrieval.training import distributed
    from retrieval.training.train import train as train_matcher

    try:
        settings = training_config(config, init, iterations, seed)
        checkpoint = train_matcher(recording, out, settings, split=read_split(split), resume=resume)
        if distributed.rank():
            return
    finally:
        distributed.stop()
    defaults.remember("model", out)
    metrics = checkpoint.provenance["metrics"]
    figures = ", ".join(f"{name.replace('_', ' ')} {value:.3f}" for name, value in metrics.items())
    say(f"{out}: kept step {checkpoint.provenance['step']}{', ' if figures else ''}{figures}")


def _train_gate(recording: Path, out: Path, iterations: int | None, seed: int | None) -> None:
    from retrieval.training.grasp_success import train_gate

    given: dict[str, Any] = {"iterations": iterations, "seed": seed}
    given = {name: value for name, value in given.items() if value is not None}
    for line in train_gate(recording, out, **given).lines():
        say(line)
