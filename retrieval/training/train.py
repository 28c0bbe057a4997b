"""Train a model from a recording: by the best recipe, by a configuration, or from touches only."""

import dataclasses
import shutil
from pathlib import Path

from retrieval.data.check.split import require_fit
from retrieval.data.dataset import LICENCES, AnyRecording, Split, folder_of, load_grasps
from retrieval.errors import BadInput
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, require_writable, sibling_file, store_checkpoint
from retrieval.model.config import Config
from retrieval.training.choice import fit_best, pose
from retrieval.training.initial_weights import made_from
from retrieval.training.loop import OnStep
from retrieval.training.recipes.recipe import Recipe
from retrieval.training.touches import fit_to_touches
from retrieval.training.trainer import train_matcher


def train(
    recording: AnyRecording,
    out: Path,
    config: Config | str | None = None,
    *,
    recipe: str | type[Recipe] | None = None,
    model: str | Path | Checkpoint | None = None,
    init: str = "imagenet",
    touches_only: bool = False,
    split: Split | None = None,
    on_step: OnStep | None = None,
) -> Checkpoint:
    """Train a model on a recording and write the checkpoint `out`.

    Without `config` the recipes of `RECIPES` are compared on objects that they were not fitted to, and the best one is
    taken; `provenance["compared"]` has the accuracies. Ctrl-C ends an unfinished training, which continues if it is
    repeated.

    Args:
        recording: A folder, or the result of `robot.read_recording`. It decides the number of fingers.
        out: The checkpoint (.safetensors).
        config: A `Config` (`Config.using` accepts your own towers and losses), or an argument of `load_config`: train
            with these settings, without a comparison.
        recipe: The only recipe: a name, or your own class.
        model: The start model. Default: the shipped model for as many fingers.
        init: Weights of the published MobileNetV2 of the linear fit: "imagenet", which are downloaded once, a file, or
            "random" to do without.
        touches_only: Whether the model compares touches with touches, as always for a recording without photos.
        split: A split whose test objects are not used at all; with `config`, also the training and validation objects.
        on_step: Called after each step of a head or tower: with the number of completed steps, and `loss`,
            `learning_rate` and, after a validation, its metrics. Before the first step it gets 0 and the metrics. With
            recipes it is told of the final fit only; the recipes `start` and `linear`, and models of touches only,
            have no steps.

    Raises:
        DatasetError: The recording cannot be read.
        BadInput: The recording has fewer than eight objects (six with `touches_only`), or too few touches of them.
        ConfigError: The configuration or the recipe is unknown, or does not fit.
        CheckpointError: The start model or the weights cannot be read, or `out` cannot be written.
        JobInterrupted: After Ctrl-C.

    >>> from pathlib import Path
    >>> made = retrieval.train("lab", Path("own.safetensors"), model="model.safetensors", init="random")
    >>> made.provenance["recipe"] in ("start", "linear", "head")
    True

    With settings of your own:

    >>> import dataclasses
    >>> config = retrieval.load_config("tiny").using(losses={"contrastive": 1.0, "listwise": 0.1})
    >>> config = dataclasses.replace(config, training=config.training.with_iterations(2))  # preset paper: 26,000
    >>> made = retrieval.train("lab", Path("lab.safetensors"), config)
    >>> made.provenance["step"] <= 2, len(made.split.train)
    (True, 7)
    """
    if config is not None:
        if recipe is not None or model is not None or touches_only:
            raise BadInput("A configuration trains without recipe and start model; leave out either.")
        return train_matcher(recording, out, config, split=split, on_step=on_step)
    require_writable(out)
    recording, parts = folder_of(recording), sibling_file(out, ".parts")
    grasps = load_grasps(recording)
    if split is not None:
        require_fit(split, grasps)
        grasps = [grasp for grasp in grasps if grasp.object_id not in split.test]
    if not touches_only and any(grasp.photos for grasp in grasps):
        problem = pose(recording, grasps, parts, model=model, init=init, on_step=on_step)
        fitted, licences = fit_best(recording, problem, recipe)
    elif recipe is not None or model is not None:
        raise BadInput("A model of touches only has one way to be trained. Leave recipe and start model out.")
    else:
        fitted, licences = fit_to_touches(recording, grasps, init)
    made = made_from(recording, grasps, licences)
    provenance = made | fitted.provenance | {LICENCES: made[LICENCES]}  # a start model has licences of its own
    store_checkpoint(dataclasses.replace(fitted, provenance=provenance), out)
    shutil.rmtree(parts, ignore_errors=True)
    return load_checkpoint(out)
