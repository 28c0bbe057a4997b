"""`retrieve train`: train a matcher, or a gate for `retrieve collect`."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from retrieval.commands.options import (
    SEED,
    WORKERS,
    CheckpointOut,
    Init,
    Iterations,
    Recording,
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
    recording: Recording,
    *,
    task: Annotated[
        Literal["match", "grasp-success"],
        typer.Option(
            help="match: classify whether a touch and a photo show the same object; grasp-success: classify whether a "
            "grasp succeeded"
        ),
    ] = "match",
    out: CheckpointOut,
    config: Annotated[
        str | None,
        typer.Option(help="a preset, such as small, mobilenet, relief or paper, or a TOML file (default: small)"),
    ] = None,
    init: Init = None,
    start: Annotated[
        str | None, typer.Option(help="checkpoint whose towers and head the training continues from")
    ] = None,
    iterations: Iterations = None,
    seed: Annotated[
        int | None,
        typer.Option(parser=SEED, help="seed of split, pairs and weights (default: that of the configuration)"),
    ] = None,
    split: SplitFile = None,
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
) -> None:
    """Train a matcher, or a grasp-success gate for `collect`."""
    if (cluster and task != "match") or (workers is not None and not cluster):
        raise BadInput("--cluster needs --task match, and --workers needs --cluster")
    if task == "grasp-success":
        others = {"config": config, "split": split, "init": init, "start": start}
        refuse_options("does not apply to --task grasp-success, which takes --iterations and --seed", **others)
        from retrieval.data.dataset import recording_licence
        from retrieval.model.checkpoint import require_writable
        from retrieval.training.grasp_success import train_gate

        require_writable(out)
        _show_licences([recording_licence(recording)])
        numbers = {"iterations": iterations, "seed": seed}
        gate: dict[str, Any] = {name: value for name, value in numbers.items() if value is not None}
        for line in train_gate(recording, out, **gate).lines():
            say(line)
        return
    from retrieval.model.checkpoint import require_writable
    from retrieval.training import distributed
    from retrieval.training.licences import training_licences
    from retrieval.training.train import train as train_matcher

    try:
        settings = training_config(config, iterations, seed=seed, init=init, start=start)
        require_writable(out)
        _show_licences(training_licences(recording, settings.training))
        options: dict[str, Any] = {"split": read_split(split)}
        if cluster:
            from retrieval.cluster.training import train_on_ray

            checkpoint = train_on_ray(recording, out, settings, workers=2 if workers is None else workers, **options)
        else:
            checkpoint = train_matcher(recording, out, settings, **options)
        if distributed.rank():
            return
    finally:
        distributed.stop()
    metrics = checkpoint.provenance["metrics"]
    figures = ", ".join(f"{name.replace('_', ' ')} {value:.3f}" for name, value in metrics.items())
    say(f"{out}: best step {checkpoint.provenance['step']}{', ' if figures else ''}{figures}")


def _show_licences(licences: "list[DataLicence]") -> None:
    """Print the licence of each source of training data."""
    for licence in licences:
        say(f"licence of {licence.source}: {licence}")
