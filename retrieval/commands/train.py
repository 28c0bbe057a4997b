"""`retrieve train`: train a matcher, or a gate for `retrieve collect`."""

from typing import Annotated, Any, Literal

import typer

from retrieval.commands.options import (
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


def train(
    recording: Recording,
    *,
    task: Annotated[
        Literal["match", "touches", "grasp-success"],
        typer.Option(
            help="match: classify whether a touch and a photo show the same object; touches: find an object by other "
            "touches of it, as with a recording without photos; grasp-success: classify whether a grasp succeeded"
        ),
    ] = "match",
    out: CheckpointOut,
    config: Annotated[
        str | None,
        typer.Option(help="a preset, such as small, mobilenet, relief or paper, or a TOML file (default: small)"),
    ] = None,
    init: Init = None,
    iterations: Iterations = None,
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
    from retrieval.model.checkpoint import require_writable

    if (cluster and task != "match") or (workers is not None and not cluster):
        raise BadInput("--cluster needs --task match, and --workers needs --cluster")
    require_writable(out)
    if task == "grasp-success":
        others = {"config": config, "split": split, "init": init}
        refuse_options("does not apply to --task grasp-success, which takes --iterations", **others)
        from retrieval.data.dataset import recording_licence
        from retrieval.training.grasp_success import train_gate

        licence = recording_licence(recording)
        say(f"licence of {licence.source}: {licence}")
        steps: dict[str, Any] = {} if iterations is None else {"iterations": iterations}
        found = train_gate(recording, out, **steps)
        trained = f"trained on {found['train_grasps']} grasps, {found['train_held']} of them held"
        say(f"{out}: uses the frame {found['frame']} the grasp; {trained}")
        say(
            f"accuracy {found['accuracy']:.3f} (95 %: {found['interval'][0]:.3f} to {found['interval'][1]:.3f}) on "
            f"{found['validation_grasps']} grasps of {found['validation_objects']} other objects; always predicting "
            f"the more frequent class: {found['chance']:.3f}"
        )
        accepted = [f"{part} of {whole} {name}" for name, (part, whole) in found["accepted"].items()]
        say(f"accepted: {', '.join(accepted)}")
        return
    from retrieval.data.dataset import load_grasps

    if task == "touches" or not any(grasp.photos for grasp in load_grasps(recording)):
        reason = "does not apply to a fit to touches only"
        refuse_options(reason, config=config, iterations=iterations, cluster=cluster)
        from retrieval.report.adaptation import print_touch_model
        from retrieval.training.touches import train_on_touches

        print_touch_model(train_on_touches(recording, out, init=init or "imagenet", split=read_split(split)))
        return
    from retrieval.training import distributed
    from retrieval.training.initial_weights import training_licences
    from retrieval.training.train import train as train_matcher

    try:
        settings = training_config(config, iterations, init=init)
        for licence in training_licences(recording, settings.training):
            say(f"licence of {licence.source}: {licence}")
        objects = read_split(split)
        if cluster:
            from retrieval.cluster.training import train_on_ray

            checkpoint = train_on_ray(recording, out, settings, workers=workers or 2, split=objects)
        else:
            checkpoint = train_matcher(recording, out, settings, split=objects)
        if distributed.rank():
            return
    finally:
        distributed.stop()
    figures = [f"{name.replace('_', ' ')} {value:.3f}" for name, value in checkpoint.provenance["metrics"].items()]
    say(", ".join([f"{out}: best step {checkpoint.provenance['step']}", *figures]))
