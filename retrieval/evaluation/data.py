"""Inputs of an evaluation: the grasps of the recording, its split, and frozen towers."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from retrieval.data.check.split import require_fit
from retrieval.data.dataset import Grasp, Split, data_digest, finger_count, load_grasps, make_split, recording_source
from retrieval.errors import DatasetError
from retrieval.methods.late_fusion import frozen_matcher
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, require_writable
from retrieval.model.config import Config
from retrieval.model.fusion import Matcher
from retrieval.training.licences import training_licences
from retrieval.training.train import Trainer


@dataclass(frozen=True, eq=False)
class EvaluationData:
    """The recording, its split, and a matcher whose towers compute the features.

    Attributes:
        name: Name of the recording's folder.
        source: Source of the recording.
        digest: Digest of the grasps.
        grasps: All grasps.
        split: Training, validation and test objects.
        split_from: Origin of the split, in words.
        config: Configuration of the heads that are fitted.
        matcher: Matcher with the towers.
        checkpoint: The whole model, which late fusion then uses as it is; None if only heads are fitted on frozen
            towers.
    """

    name: str
    source: str
    digest: str
    grasps: list[Grasp]
    split: Split
    split_from: str
    config: Config
    matcher: Matcher
    checkpoint: Checkpoint | None


def prepare(
    recording: Path, out: Path, config: Config, *, model: Path | None, split: Split | None, quiet: bool
) -> EvaluationData:
    """Read a recording and prepare its towers.

    The towers are those of `model`; without a model, the frozen towers of `config`. If `config` trains its towers, a
    model is trained and written to `out`/model.safetensors.

    Args:
        recording: Folder of the recording.
        out: Folder of the results.
        config: Configuration. With a model, the model's own configuration replaces it, except for the number of
            iterations.
        model: A checkpoint.
        split: The split; None for the split of the model, or without a model for a random one.
        quiet: No progress on stderr.

    Raises:
        DatasetError: The recording cannot be read, or does not fit the split.
        CheckpointError: The model cannot be read.
    """
    grasps = load_grasps(recording)
    digest = data_digest(grasps)
    checkpoint = load_checkpoint(model) if model else None
    if checkpoint:
        config = _of_model(checkpoint, config)
    config = dataclasses.replace(config, matcher=dataclasses.replace(config.matcher, fingers=finger_count(grasps)))
    split, split_from = _split(grasps, config, checkpoint, split)
    if checkpoint is None and not config.training.freeze_towers:
        done = out / "model.safetensors"
        require_writable(done)
        licences = training_licences(recording, config.training)
        source = recording_source(recording)
        trainer = Trainer(config, split, grasps, done, source=source, licences=licences)
        checkpoint = trainer.run_or_reuse(quiet)
        config = _of_model(checkpoint, config)
    return EvaluationData(
        name=recording.resolve().name,
        source=recording_source(recording),
        digest=digest,
        grasps=grasps,
        split=split,
        split_from=split_from,
        config=config,
        matcher=checkpoint.matcher if checkpoint else frozen_matcher(config),
        checkpoint=checkpoint,
    )


def _of_model(checkpoint: Checkpoint, config: Config) -> Config:
    """Return the configuration of heads on a model's towers; its initial weights are not needed again."""
    training = dataclasses.replace(
        checkpoint.config.training,
        init="random",
        init_photo="",
        start="",
        init_touch="",
        iterations=config.training.iterations,
        freeze_towers=True,
    )
    return dataclasses.replace(checkpoint.config, training=training)


def _split(
    grasps: Sequence[Grasp], config: Config, checkpoint: Checkpoint | None, requested: Split | None
) -> tuple[Split, str]:
    """Return the requested split, else the model's own, else a new one; and its origin in words."""
    if requested is not None:
        require_fit(requested, grasps)
        return requested, "given"
    own = checkpoint.split if checkpoint else None
    trained = {*own.train, *own.validation} if own else set()
    recorded = {grasp.object_id for grasp in grasps}
    if checkpoint and checkpoint.split and trained and trained <= recorded:
        test = checkpoint.split.test or tuple(sorted(recorded - trained))
        return dataclasses.replace(checkpoint.split, test=test), "the model's own"
    if shared := trained & recorded:
        raise DatasetError(
            f"The recording must contain all training objects of the model or none of them, but contains {len(shared)} "
            f"of {len(trained)}, such as {min(shared)}. Give a split with --split."
        )
    settings = config.training
    drawn = make_split(grasps, validation=settings.validation_fraction, test=settings.test_fraction, seed=settings.seed)
    return drawn, "drawn; the model was trained on none of its objects" if checkpoint else "drawn"
