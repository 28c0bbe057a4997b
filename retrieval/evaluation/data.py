"""What an evaluation works on: the recording's grasps, who trains and who tests, and towers that stand still."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from retrieval.data.check.recording import require_fit
from retrieval.data.dataset import Grasp, Split, data_digest, finger_count, load_grasps, make_split, recording_source
from retrieval.errors import DatasetError
from retrieval.methods.late_fusion import frozen_matcher
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, require_writable
from retrieval.model.config import Config
from retrieval.model.fusion import Matcher
from retrieval.training.state import finish_training, unfinished_path
from retrieval.training.train import Trainer, labelled_pairs


@dataclass(frozen=True, eq=False)
class EvaluationData:
    """The recording, its split, and a matcher whose towers make the features.

    pairs: labelled ones, which train beside the split's training objects. split_from: in words. checkpoint: the whole
    model where there is one, which late fusion then is; None where towers are frozen and only heads are to be fitted.
    config: what these heads are fitted with.
    """

    name: str
    source: str
    digest: str
    grasps: list[Grasp]
    pairs: list[Grasp]
    split: Split
    split_from: str
    config: Config
    matcher: Matcher
    checkpoint: Checkpoint | None


def prepare(
    recording: Path, out: Path, config: Config, *, model: Path | None, split: Split | None, quiet: bool
) -> EvaluationData:
    """Read a recording and make towers for it: those of `model`, the frozen ones of `config`, or, where `config`
    trains its towers, those of a training into `out`/model.safetensors.

    With a model, all of its configuration counts but the number of iterations. Raises DatasetError, CheckpointError.
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
        require_writable(unfinished_path(done))
        trainer = Trainer(config, split, grasps, unfinished_path(done), source=recording_source(recording))
        checkpoint = finish_training(trainer, done, quiet)
        config = _of_model(checkpoint, config)
    return EvaluationData(
        name=recording.resolve().name,
        source=recording_source(recording),
        digest=digest,
        grasps=grasps,
        pairs=labelled_pairs(config),
        split=split,
        split_from=split_from,
        config=config,
        matcher=checkpoint.matcher if checkpoint else frozen_matcher(config),
        checkpoint=checkpoint,
    )


def _of_model(checkpoint: Checkpoint, config: Config) -> Config:
    """The configuration of heads on a model's towers; these are there already, wherever their first weights lay."""
    training = dataclasses.replace(
        checkpoint.config.training,
        init="random",
        init_photo="",
        init_touch="",
        photos=config.training.photos,
        touches=config.training.touches,
        iterations=config.training.iterations,
        freeze_towers=True,
    )
    return dataclasses.replace(checkpoint.config, training=training)


def _split(
    grasps: Sequence[Grasp], config: Config, checkpoint: Checkpoint | None, given: Split | None
) -> tuple[Split, str]:
    """The split given, else the model's own, else a new one; and which, in words."""
    if given is not None:
        require_fit(given, grasps)
        return given, "given"
    known = checkpoint.split if checkpoint else None
    seen = {*known.train, *known.validation} if known else set()
    recorded = {grasp.object_id for grasp in grasps}
    if checkpoint and checkpoint.split and seen and seen <= recorded:
        test = checkpoint.split.test or tuple(sorted(recorded - seen))
        return dataclasses.replace(checkpoint.split, test=test), "the model's own"
    if shared := seen & recorded:
        raise DatasetError(
            f"the recording must hold all objects that the model was trained with, or none; it holds {len(shared)} of "
            f"{len(seen)}, such as {min(shared)}; give a split with --split"
        )
    settings = config.training
    drawn = make_split(grasps, validation=settings.validation_fraction, test=settings.test_fraction, seed=settings.seed)
    return drawn, "drawn; the model has seen none of its objects" if checkpoint else "drawn"
