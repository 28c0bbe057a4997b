"""`retrieve train`: a matcher, a tower that sees relief, or a gate for `retrieve collect`."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from retrieval.commands.options import (
    SEED,
    WORKERS,
    CheckpointOut,
    Init,
    InitTower,
    Iterations,
    LabelledPhotos,
    LabelledTouches,
    SplitFile,
    read_split,
    refuse_options,
    training_config,
)
from retrieval.console.output import say
from retrieval.errors import BadInput


def train(
    recording: Annotated[
        Path, typer.Argument(help="recording folder; for relief the folder of labelled pictures", show_default=False)
    ],
    *,
    task: Annotated[
        Literal["match", "relief", "grasp-success"],
        typer.Option(
            help="match: does this touch belong to this photo? relief: which relief does one side's picture show, for "
            "--init-photo or --init-touch; grasp-success: did the grasp succeed?"
        ),
    ] = "match",
    out: CheckpointOut,
    config: Annotated[
        str | None,
        typer.Option(help="preset, such as small, mobilenet, relief or paper, or TOML file (default: small)"),
    ] = None,
    init: Init = None,
    init_photo: InitTower = None,
    init_touch: InitTower = None,
    photos: LabelledPhotos = None,
    touches: LabelledTouches = None,
    iterations: Iterations = None,
    seed: Annotated[
        int | None, typer.Option(parser=SEED, help="seed of split, pairs and weights, instead of the configuration's")
    ] = None,
    split: SplitFile = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on with an unfinished training of --out")] = False,
    cache: Annotated[
        Path | None,
        typer.Option(
            help="folder where decoded images are kept, for towers that are trained: later trainings read them"
        ),
    ] = None,
    cluster: Annotated[
        bool, typer.Option("--cluster", help="Ray Train starts the ranks: that of RAY_ADDRESS, else one here")
    ] = False,
    workers: Annotated[int | None, typer.Option(parser=WORKERS, help="of --cluster: ranks (default: 2)")] = None,
) -> None:
    """Train a matcher, a tower that sees relief, or a gate for `collect`."""
    inits = {"init": init, "init_photo": init_photo, "init_touch": init_touch, "photos": photos, "touches": touches}
    if (cluster and task != "match") or (workers is not None and not cluster):
        raise BadInput("--cluster trains matchers (--task match), and --workers says on how many ranks")
    if task == "grasp-success":
        others = {"config": config, "split": split, "resume": resume, "cache": cache, **inits}
        refuse_options("is of matchers; --task grasp-success takes --iterations and --seed", **others)
        from retrieval.training.grasp_success import train_gate

        numbers = {"iterations": iterations, "seed": seed}
        gate: dict[str, Any] = {name: value for name, value in numbers.items() if value is not None}
        for line in train_gate(recording, out, **gate).lines():
            say(line)
        return
    if task == "relief":
        if split or init_photo or init_touch or photos or touches:
            raise BadInput(
                "--task relief needs no split and no pairs, and makes what --init-photo and --init-touch take"
            )
        from retrieval.training.relief import ITERATIONS, train_relief

        settings = training_config(config, None, init=init, seed=seed)
        steps = ITERATIONS if iterations is None else iterations
        report = train_relief(recording, out, settings, iterations=steps, resume=resume, cache=cache)
        for line in report.lines():
            say(line)
        say(f"{out}: give it to `retrieve train` or `retrieve evaluate` as --init-{report.kind}")
        return
    from retrieval.search import defaults
    from retrieval.training import distributed
    from retrieval.training.train import train as train_matcher

    try:
        settings = training_config(config, iterations, seed=seed, **inits)
        asked: dict[str, Any] = {"split": read_split(split), "resume": resume, "cache": cache}
        if cluster:
            from retrieval.cluster.training import train_on_ray

            checkpoint = train_on_ray(recording, out, settings, workers=2 if workers is None else workers, **asked)
        else:
            checkpoint = train_matcher(recording, out, settings, **asked)
        if distributed.rank():
            return
    finally:
        distributed.stop()
    defaults.remember("model", out)
    metrics = checkpoint.provenance["metrics"]
    figures = ", ".join(f"{name.replace('_', ' ')} {value:.3f}" for name, value in metrics.items())
    say(f"{out}: kept step {checkpoint.provenance['step']}{', ' if figures else ''}{figures}")
