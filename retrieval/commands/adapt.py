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
    from retrieval.adaptation.curve import learning_curve, write_curve
    from retrieval.adaptation.recipe import adapt as fit
    from retrieval.data.dataset import finger_count, load_grasps
    from retrieval.model.checkpoint import load_checkpoint, require_writable
    from retrieval.search import defaults

    if report:
        require_ours(report / "curve.md", TEXT)
    require_writable(out)
    fingers = finger_count(load_grasps(recording))
    start = load_checkpoint(model or defaults.shipped_model(min(fingers, 2)))
    material, estimate = fit(recording, out, start, init=init, split=read_split(split), cache=cache, seed=seed)
    defaults.remember("model", out)
    for line in estimate.lines() if estimate else ():
        say(line)
    if report and estimate:
        say(f"learning curve: {write_curve(report, learning_curve(material, start, cache=cache, seed=seed))}")
    elif report:
        say(f"{report} is not written: a learning curve, too, is judged on objects that are left out")
    objects = len({grasp.object_id for grasp in material.grasps})
    say(f"{out}: fitted to {objects} objects, {len(material.grasps)} touches")
