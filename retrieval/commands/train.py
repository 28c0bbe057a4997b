"""`retrieve train`: train a matcher, pretrain a tower on relief, or train a gate for `retrieve collect`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

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

if TYPE_CHECKING:
    from retrieval.data.licences import DataLicence


def train(
    recording: Annotated[
        Path,
        typer.Argument(help="recording folder; for --task relief, the folder of labelled pictures", show_default=False),
    ],
    *,
    task: Annotated[
        Literal["match", "relief", "grasp-success"],
        typer.Option(
            help="match: classify whether a touch and a photo show the same object; relief: pretrain one tower to "
            "classify relief, for --init-photo or --init-touch; grasp-success: classify whether a grasp succeeded"
        ),
    ] = "match",
    out: CheckpointOut,
    config: Annotated[
        str | None,
        typer.Option(help="a preset, such as small, mobilenet, relief or paper, or a TOML file (default: small)"),
    ] = None,
    init: Init = None,
    init_photo: InitTower = None,
    init_touch: InitTower = None,
    photos: LabelledPhotos = None,
    touches: LabelledTouches = None,
    start: Annotated[
        str | None, typer.Option(help="checkpoint whose towers and head the training continues from")
    ] = None,
    iterations: Iterations = None,
    seed: Annotated[
        int | None,
        typer.Option(parser=SEED, help="seed of split, pairs and weights (default: that of the configuration)"),
    ] = None,
    split: SplitFile = None,
    resume: Annotated[bool, typer.Option("--resume", help="continue an unfinished training run of --out")] = False,
    cache: Annotated[
        Path | None,
        typer.Option(help="folder that stores decoded images for later training runs; for towers that are not frozen"),
    ] = None,
    cluster: Annotated[
        bool,
        typer.Option(
            "--cluster",
            help="start the ranks (processes) with Ray Train, on the Ray cluster at RAY_ADDRESS, else on this machine",
        ),
    ] = False,
    workers: Annotated[
        int | None, typer.Option(parser=WORKERS, help="with --cluster: number of ranks (default: 2)")
    ] = None,
    require_licence: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="refuse data whose licence is not in this list, separated by commas, such as 'open,CC BY-NC 4.0'. "
            "open: every licence that allows any use, commercial use included, such as CC BY, CC BY-SA, MIT or GPL. "
            "Published initial weights are not checked",
        ),
    ] = None,
) -> None:
    """Train a matcher, pretrain a tower on relief, or train a grasp-success gate for `collect`."""
    inits = {"init": init, "init_photo": init_photo, "init_touch": init_touch, "photos": photos, "touches": touches}
    inits["start"] = start
    if (cluster and task != "match") or (workers is not None and not cluster):
        raise BadInput("--cluster needs --task match, and --workers needs --cluster")
    if task == "grasp-success":
        others = {"config": config, "split": split, "resume": resume, "cache": cache, **inits}
        refuse_options("does not apply to --task grasp-success, which takes --iterations and --seed", **others)
        from retrieval.data.dataset import recording_licence
        from retrieval.model.checkpoint import require_writable
        from retrieval.training.grasp_success import train_gate

        require_writable(out)
        _show_licences([recording_licence(recording)], require_licence)
        numbers = {"iterations": iterations, "seed": seed}
        gate: dict[str, Any] = {name: value for name, value in numbers.items() if value is not None}
        for line in train_gate(recording, out, **gate).lines():
            say(line)
        return
    if task == "relief":
        if split or init_photo or init_touch or start or photos or touches:
            raise BadInput(
                "--task relief does not take --split, --photos, --touches, --start, --init-photo or --init-touch"
            )
        reason = "does not apply to --task relief, whose pictures state no licence"
        refuse_options(reason, require_licence=require_licence)
        from retrieval.training.relief import ITERATIONS, train_relief

        settings = training_config(config, None, init=init, seed=seed)
        steps = ITERATIONS if iterations is None else iterations
        report = train_relief(recording, out, settings, iterations=steps, resume=resume, cache=cache)
        for line in report.lines():
            say(line)
        say(f"{out}: pass it to `retrieve train` or `retrieve evaluate` as --init-{report.kind}")
        return
    from retrieval.model.checkpoint import require_writable
    from retrieval.search import defaults
    from retrieval.training import distributed
    from retrieval.training.licences import training_licences
    from retrieval.training.train import train as train_matcher

    try:
        settings = training_config(config, iterations, seed=seed, **inits)
        require_writable(out)
        _show_licences(training_licences(recording, settings.training), require_licence)
        options: dict[str, Any] = {"split": read_split(split), "resume": resume, "cache": cache}
        if cluster:
            from retrieval.cluster.training import train_on_ray

            checkpoint = train_on_ray(recording, out, settings, workers=2 if workers is None else workers, **options)
        else:
            checkpoint = train_matcher(recording, out, settings, **options)
        if distributed.rank():
            return
    finally:
        distributed.stop()
    defaults.remember("model", out)
    metrics = checkpoint.provenance["metrics"]
    figures = ", ".join(f"{name.replace('_', ' ')} {value:.3f}" for name, value in metrics.items())
    say(f"{out}: best step {checkpoint.provenance['step']}{', ' if figures else ''}{figures}")


def _show_licences(licences: "list[DataLicence]", accepted: str | None) -> None:
    """Print the licence of each source of training data; raise BadInput if one of them is not accepted."""
    from retrieval.data.licences import require_licences

    for licence in licences:
        say(f"licence of {licence.source}: {licence}")
    if accepted is not None:
        require_licences(licences, [name.strip() for name in accepted.split(",")])
