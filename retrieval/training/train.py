"""Train a model from a recording: by the best recipe, by a configuration, or from touches only."""

from pathlib import Path

from retrieval.data.dataset import AnyRecording, Split, folder_of, load_grasps
from retrieval.errors import BadInput
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.config import Config
from retrieval.training.choice import train_best
from retrieval.training.recipes.recipe import Recipe
from retrieval.training.touches import train_on_touches
from retrieval.training.trainer import train_matcher


def train(
    recording: AnyRecording,
    out: Path,
    config: Config | str | None = None,
    *,
    recipe: str | type[Recipe] | None = None,
    model: str | Path | Checkpoint | None = None,
    init: str = "imagenet",
    split: Split | None = None,
    quiet: bool = False,
) -> Checkpoint:
    """Train a model on a recording and write the checkpoint `out`.

    Without `config` the recipes of `RECIPES` are compared on objects that they were not
    fitted to, and the best one is taken; `provenance["compared"]` has the accuracies. A recording without photos gives
    a model that compares touches with touches. Ctrl-C ends an unfinished training, which continues if it is repeated.

    Args:
        recording: A folder, or the result of `robot.read_recording`. It decides the number of fingers.
        out: The checkpoint (.safetensors).
        config: A `Config` (`Config.using` accepts your own towers and losses), or an argument of `load_config`: train
            with these settings, without a comparison.
        recipe: The only recipe: a name, or your own class.
        model: The start model. Default: the shipped model for as many fingers.
        init: Weights of the published MobileNetV2 of the linear fit: "imagenet", which are downloaded once, a file, or
            "random" to do without.
        split: A split whose test objects are not used at all; with `config`, also the training and validation objects.
        quiet: No progress on stderr.

    Raises:
        DatasetError: The recording cannot be read.
        BadInput: The recording has fewer than eight objects, or too few touches of them.
        ConfigError: The configuration or the recipe is unknown, or does not fit.
        CheckpointError: The start model or the weights cannot be read, or `out` cannot be written.
        JobInterrupted: After Ctrl-C.

    >>> from pathlib import Path
    >>> made = retrieval.train("lab", Path("own.safetensors"), model="model.safetensors", init="random", quiet=True)
    >>> made.provenance["recipe"] in ("start", "linear", "head")
    True

    With settings of your own:

    >>> import dataclasses
    >>> config = retrieval.load_config("tiny").using(losses={"contrastive": 1.0, "listwise": 0.1})
    >>> config = dataclasses.replace(config, training=config.training.with_iterations(2))  # preset paper: 26,000
    >>> made = retrieval.train("lab", Path("lab.safetensors"), config, quiet=True)
    >>> made.provenance["step"] <= 2, len(made.split.train)
    (True, 7)
    """
    if config is not None:
        if recipe is not None or model is not None:
            raise BadInput("A configuration trains without recipe and start model; leave out either.")
        return train_matcher(recording, out, config, split=split, quiet=quiet)
    if not any(grasp.photos for grasp in load_grasps(folder_of(recording))):
        if recipe is not None or model is not None:
            raise BadInput("A recording without photos has one way to be trained. Leave recipe and start model out.")
        return train_on_touches(recording, out, init=init, split=split, quiet=quiet)
    return train_best(recording, out, recipe=recipe, model=model, init=init, split=split, quiet=quiet)
