"""`retrieve train`: train a matcher, or a gate for `retrieve collect`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from retrieval.commands.options import (
    CheckpointOut,
    Iterations,
    Recording,
    SplitFile,
    read_split,
    refuse_options,
    training_config,
)
from retrieval.console.output import say
from retrieval.training.recipes import RECIPES

if TYPE_CHECKING:
    from retrieval.model.config import Config


def train(
    recording: Recording,
    *,
    task: Annotated[
        Literal["match", "touches", "grasp-success"],
        typer.Option(
            help="match: identify the photo of a touched object; touches: find an object by other touches of it, as "
            "with a recording without photos; grasp-success: classify whether a grasp succeeded"
        ),
    ] = "match",
    out: CheckpointOut,
    recipe: Annotated[
        str | None,
        typer.Option(help=f"train by this recipe: {', '.join(RECIPES)} (default: the best one on held-out objects)"),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="start model of the recipes (default: the shipped one for as many fingers)")
    ] = None,
    config: Annotated[
        str | None, typer.Option(help="train with these settings instead: a preset, such as paper, or a TOML file")
    ] = None,
    init: Annotated[
        str | None,
        typer.Option(
            help="weights of the published towers: imagenet (a download), random, or a state dict file; with --config "
            "also shipped or gel (default: imagenet, or that of --config)"
        ),
    ] = None,
    iterations: Iterations = None,
    split: SplitFile = None,
) -> None:
    """Train a matcher by the best of several recipes, or a grasp-success gate for `collect`."""
    from retrieval.model.checkpoint import require_writable

    require_writable(out)
    if task == "grasp-success":
        others = {"recipe": recipe, "model": model, "config": config, "split": split, "init": init}
        refuse_options("does not apply to --task grasp-success, which takes --iterations", **others)
        _train_gate(recording, out, iterations)
    elif config is not None:
        refuse_options("does not apply with --config", recipe=recipe, model=model, task=task != "match")
        settings = training_config(config, iterations, init=init)
        _train_with_config(recording, out, settings, split)
    else:
        refuse_options("needs --config", iterations=iterations)
        from retrieval.data.check.recording import check_gel_layout
        from retrieval.report.training import print_comparison
        from retrieval.training.train import train as train_model

        for finding in check_gel_layout(recording):
            say(f"{finding.severity}: {finding.message}")
        options: dict[str, Any] = {"recipe": recipe, "model": model, "init": init or "imagenet"}
        if task == "touches":
            refuse_options("does not apply to --task touches", recipe=recipe, model=model)
        made = train_model(recording, out, touches_only=task == "touches", split=read_split(split), **options)
        print_comparison(made)


def _train_gate(recording: Path, out: Path, iterations: int | None) -> None:
    from retrieval.data.dataset import recording_licence
    from retrieval.training.grasp_success import train_gate

    licence = recording_licence(recording)
    say(f"licence of {licence.source}: {licence}")
    steps: dict[str, Any] = {} if iterations is None else {"iterations": iterations}
    result = train_gate(recording, out, **steps)
    say(
        f"{out}: uses the frame {result['frame']} the grasp; trained on {result['train_grasps']} grasps, "
        f"{result['train_held']} of them held"
    )
    say(
        f"accuracy {result['accuracy']:.3f} (95 %: {result['interval'][0]:.3f} to {result['interval'][1]:.3f}) on "
        f"{result['validation_grasps']} grasps of {result['validation_objects']} other objects; always predicting "
        f"the more frequent class: {result['chance']:.3f}"
    )


def _train_with_config(recording: Path, out: Path, settings: "Config", split: Path | None) -> None:
    from retrieval.training.initial_weights import training_licences
    from retrieval.training.trainer import train_matcher

    for licence in training_licences(recording, settings.training):
        say(f"licence of {licence.source}: {licence}")
    checkpoint = train_matcher(recording, out, settings, split=read_split(split))
    accuracy = checkpoint.provenance["metrics"].get("validation_pair_accuracy")
    reached = "" if accuracy is None else f", pair accuracy of validation objects {accuracy:.3f} (chance 0.5)"
    say(f"{out}: best step {checkpoint.provenance['step']}{reached}")
