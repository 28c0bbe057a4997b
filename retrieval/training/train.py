"""Train a matcher: steps, validation, checkpoints, interruption and resumption.

Every step depends only on the seed, the step number and the state. So a run that is stopped and resumed on the same
machine gives the same bits as an uninterrupted run.
"""

import dataclasses
import math
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.graph import increment_version

from retrieval.console.interruption import interruption
from retrieval.console.progress import Bar
from retrieval.data.check.split import require_fit
from retrieval.data.dataset import (
    AnyRecording,
    Grasp,
    Split,
    data_digest,
    finger_count,
    folder_of,
    load_grasps,
    make_split,
    recording_source,
)
from retrieval.data.licences import LICENCES, DataLicence
from retrieval.data.pairs import PairBatch, PairSampler
from retrieval.errors import CheckpointError, JobInterrupted
from retrieval.metrics.pairs import negative_log_likelihood, pair_accuracy, pair_auc
from retrieval.model.checkpoint import (
    Checkpoint,
    load_checkpoint,
    require_writable,
    save_checkpoint,
    store_checkpoint,
)
from retrieval.model.config import Config, TrainingConfig, named_config
from retrieval.model.encode import default_device
from retrieval.model.fusion import Matcher
from retrieval.model.towers.tower import Tower
from retrieval.training import distributed
from retrieval.training.batches import FeatureSource, FrozenFeatures, LoadedBatch, TrainedFeatures
from retrieval.training.calibration.calibrate import calibrate_checkpoint
from retrieval.training.distil import add_candidate_encoder
from retrieval.training.features import Features, features_by_image
from retrieval.training.fit import RATE, Plan, fit, freeze_batch_norm
from retrieval.training.initial_weights import TOWER_WEIGHTS, build_matcher
from retrieval.training.licences import training_licences
from retrieval.training.state import code_digest, load_state, require_no_unfinished_state, save_state, state_path
from retrieval.training.step import WeightedLosses, batch_loss, pair_logits, shuffle_fingers


def train(
    recording: AnyRecording,
    out: Path,
    config: Config | str = "small",
    *,
    split: Split | None = None,
    resume: bool = False,
    quiet: bool = False,
) -> Checkpoint:
    """Train on a recording and write the checkpoint with the best validation score to `out`.

    Ctrl-C ends after the current step with a usable checkpoint; a second Ctrl-C stops immediately.

    Args:
        recording: A folder, or the result of `robot.read_recording`. It decides the number of fingers.
        out: The checkpoint (.safetensors).
        config: A `Config` (`Config.using` accepts your own towers and losses), or an argument of `load_config`.
        split: Objects of each part. Default: a random split as the configuration sets it.
        resume: Continue from the state next to `out`.
        quiet: No progress on stderr.

    Raises:
        DatasetError, ConfigError, CheckpointError: Training is not possible with the data or settings.
        JobInterrupted: After Ctrl-C.

    >>> import dataclasses
    >>> from pathlib import Path
    >>> config = retrieval.load_config("tiny").using(losses={"contrastive": 1.0, "listwise": 0.1})
    >>> config = dataclasses.replace(config, training=config.training.with_iterations(2))  # preset small: 500 steps
    >>> made = retrieval.train("lab", Path("lab.safetensors"), config, quiet=True)
    >>> made.provenance["step"], len(made.split.train)
    (2, 7)
    """
    recording, (config, _) = folder_of(recording), named_config(config)
    require_writable(out)
    distributed.start()
    grasps = load_grasps(recording)
    config = dataclasses.replace(config, matcher=dataclasses.replace(config.matcher, fingers=finger_count(grasps)))
    settings = config.training
    if split is None:
        split = make_split(
            grasps, validation=settings.validation_fraction, test=settings.test_fraction, seed=settings.seed
        )
    else:
        require_fit(split, grasps)
    source, licences = recording_source(recording), training_licences(recording, settings)
    trainer = Trainer(config, split, grasps, out, source, licences=licences)
    if not resume:
        require_no_unfinished_state(out)
    else:
        trainer.resume()
    trainer.run(quiet)
    return load_checkpoint(out)


class Trainer:
    """The state of one training run."""

    def __init__(
        self,
        config: Config,
        split: Split,
        grasps: list[Grasp],
        out: Path,
        source: str,
        known: Features | None = None,
        licences: Sequence[DataLicence] = (),
    ) -> None:
        """Prepare a run.

        `known`: features of all grasps. They replace the images if the towers are frozen. `licences`: licences of the
        data.
        """
        settings = config.training
        self.config, self.split, self.out, self.source = config, split, out, source
        self.licences = [dataclasses.asdict(licence) for licence in licences]
        self.data_digest = known.digest if known else data_digest(grasps)
        self.device = default_device()
        torch.manual_seed(settings.seed)
        self.config_without_encoder = config.without_candidate_encoder()
        self.has_images = known is None
        self.matcher = build_matcher(self.config_without_encoder).to(self.device)
        self.sampler = self._sampler(split.select(grasps, "train"))
        self.losses = WeightedLosses(settings.weights, self.matcher, len(self.sampler.grasps)).to(self.device)
        self.modules = nn.ModuleDict({"matcher": self.matcher, "losses": self.losses})
        towers = (module for module in self.matcher.modules() if isinstance(module, Tower))
        self.code = code_digest(*map(type, (*self.losses.terms, *towers)))
        groups: list[dict[str, Any]] = [{"params": []}, {"params": [], RATE: settings.tower_rate}]
        for name, parameter in self.modules.named_parameters():
            if parameter.requires_grad:
                groups[name.startswith(TOWERS)]["params"].append(parameter)
        # On a CPU, PyTorch's default optimizer reads every tensor eight times. The fused optimizer reads it once. On
        # CUDA the default optimizer is fast.
        self.optimizer = torch.optim.Adam(groups, lr=settings.learning_rate, fused=self.device.type == "cpu")
        held_out = split.select(grasps, "validation")
        self.validation = self._sampler(held_out).evaluation_pairs() if split.validation else None
        stored = features_by_image(grasps, known, self.device) if known else {}
        self.features: FeatureSource = (
            FrozenFeatures(config, self.device, stored)
            if settings.freeze_towers
            else TrainedFeatures(config, self.device)
        )
        set_training_mode(self.matcher, settings)
        for tower in (self.matcher.touch_tower, self.matcher.photo_tower):
            distributed.synchronise_batch_norm(tower, self.device)
        self.step, self.best = 0, -math.inf

    def _sampler(self, chosen: list[Grasp]) -> PairSampler:
        settings = self.config.training
        # Frozen towers have cached features: negatives from all objects cost nothing.
        shared = not settings.freeze_towers if settings.negatives == "auto" else settings.negatives == "batch"
        return PairSampler(
            chosen,
            seed=settings.seed,
            positives=settings.positives_per_touch,
            negatives=settings.negatives_per_touch,
            share_photos=shared,
        )

    def run(self, quiet: bool = False) -> None:
        """Train from the current step to the last."""
        total = self.config.training.iterations
        quiet = quiet or distributed.rank() > 0
        if self.step < total:
            with interruption() as stop:
                self._steps(stop, quiet)
        self._finish(quiet)

    def _steps(self, stop: threading.Event, quiet: bool) -> None:
        settings = self.config.training
        plan = Plan(settings.iterations, settings.learning_rate, settings.schedule, settings.validate_every)
        steps, touches = range(self.step, plan.steps), settings.touches_per_batch
        batches = ((step, self.sampler.batch(step, touches)) for step in steps)
        with Bar("train", plan.steps, "steps", done=self.step, quiet=quiet) as bar:
            fit(
                self.optimizer,
                plan,
                self.features.batches(self.matcher, batches),
                distributed.averaging_gradients(self.modules, self.loss),
                bar=bar,
                done=self.step,
                step_context=self.features.step_context,
                after_step=self._after_step,
                note=self._note,
                validate=lambda _: self._validate_and_save(),
                # All ranks must stop after the same step, or the remaining ranks would wait forever.
                should_stop=lambda: distributed.any_rank(stop.is_set(), self.device),
            )
        if self.step < plan.steps:
            raise JobInterrupted(
                f"stopped at step {self.step} of {plan.steps}; {self.out} is usable, --resume continues from here"
            )

    def loss(self, loaded: LoadedBatch) -> Tensor:
        """Return the loss of a prepared batch."""
        settings = self.config.training
        torch.manual_seed(settings.seed * 1_000_003 + self.step)  # the dropout mask, the same on every rank
        touch, photo = self.features.train_features(self.matcher, loaded)
        if settings.shuffle_fingers:
            touch = shuffle_fingers(touch, self.matcher.config.fingers)
        return self.feature_loss(loaded.batch, touch, photo)

    def feature_loss(self, batch: PairBatch, touch: Tensor, photo: Tensor) -> Tensor:
        """Return the loss of a batch and the features of its touches and photos (`Matcher.touch_features`)."""
        loss, logits = batch_loss(self.matcher, self.losses, batch, touch, photo)
        self._last_logits = logits.detach(), batch.labels
        return loss

    def _after_step(self, done: int) -> None:
        # Fused steps do not increment the versions of the weights. Without this line, values that were cached from old
        # weights would seem up to date.
        increment_version(list(self.matcher.parameters()))
        self.matcher.clamp_scale()
        self.losses.clamp()
        self.step = done

    def _note(self) -> str:
        logits, labels = self._last_logits
        best = "" if math.isinf(self.best) else f"  validation AUC {self.best:.3f}"
        return f"  accuracy {pair_accuracy(logits.cpu().numpy(), labels):.2f}{best}"

    def _finish(self, quiet: bool) -> None:
        """Complete the best checkpoint on the first rank; after Ctrl-C all ranks stop."""
        interrupted = False
        if not distributed.rank():
            try:
                self._complete(quiet)
                state_path(self.out).unlink(missing_ok=True)
            except KeyboardInterrupt:
                interrupted = True
        with interruption():
            interrupted = distributed.any_rank(interrupted, self.device)  # all ranks wait here until the files exist
        if interrupted:
            raise JobInterrupted(
                f"stopped before the last parts were fitted; {self.out} can rank photos but is not complete. Run the "
                "same command with --resume to add these parts"
            )

    def _complete(self, quiet: bool) -> None:
        """Add the parts that are fitted after training: candidate encoder, calibrations and gel check."""
        train = [grasp for part in self.sampler.grasps for grasp in part]
        held_out = self.validation.grasps if self.validation else []
        made = load_checkpoint(self.out)
        made.matcher.to(self.device)
        if self.config.matcher.candidate_width:
            made = add_candidate_encoder(made, self.config, self.features, train, held_out, quiet=quiet)
        if self.has_images:
            made = calibrate_checkpoint(made, self.features, train, held_out, quiet=quiet)
        store_checkpoint(made, self.out)

    def _validate_and_save(self) -> None:
        metrics = self.validate()
        better = metrics.get("validation_auc", 0.0) > self.best or self.validation is None
        self.best = max(self.best, metrics.get("validation_auc", -math.inf))
        if not distributed.rank():
            if better:
                self._save_best(metrics)
            self._save_state()
        distributed.any_rank(False, self.device)  # all ranks wait here until the files are written

    def validate(self) -> dict[str, float]:
        """Return the metrics of the fixed validation pairs; empty without validation objects."""
        if self.validation is None:
            return {}
        logits, labels = pair_logits(self.matcher, self.validation, self.features), self.validation.labels
        set_training_mode(self.matcher, self.config.training)
        return {
            "validation_auc": pair_auc(logits, labels),
            "validation_pair_accuracy": pair_accuracy(logits, labels),
            "validation_nll": negative_log_likelihood(logits, labels),
        }

    def _save_best(self, metrics: dict[str, float]) -> None:
        provenance = {
            "step": self.step,
            "source": self.source,
            LICENCES: self.licences,
            "data_digest": self.data_digest,
            "metrics": metrics,
            **self.code,
        }
        save_checkpoint(self.out, self.matcher, self.config_without_encoder, split=self.split, provenance=provenance)

    def _identity(self) -> dict[str, Any]:
        """Return the settings that must not change between a run and its resumption."""
        return {
            "config": self.config.to_dict(),
            "split": self.split.to_dict(),
            "data_digest": self.data_digest,
            **self.code,
        }

    def _save_state(self) -> None:
        header = {"step": self.step, "best": None if self.validation is None else self.best, **self._identity()}
        save_state(self.out, self.modules, self.optimizer, header)

    def resume(self) -> None:
        """Continue from the state next to `out`. Raises CheckpointError if it belongs to another run."""
        header = load_state(self.out, self.modules, self.optimizer, self._identity())
        stored = load_checkpoint(self.out)  # the best checkpoint so far is part of the state
        mine = (stored.split, stored.provenance.get("data_digest")) == (self.split, self.data_digest)
        # The configuration changes when the candidate encoder is added.
        if not mine or stored.config not in (self.config_without_encoder, self.config):
            raise CheckpointError(
                f"{self.out} does not belong to the training run to resume; restore its checkpoint or start a new run"
            )
        self.step, self.best = header["step"], -math.inf if header["best"] is None else header["best"]


TOWERS = tuple(f"matcher.{prefix}" for prefix in TOWER_WEIGHTS)
"""Prefixes of the names of the towers' weights."""


def set_training_mode(matcher: Matcher, settings: TrainingConfig) -> None:
    """Put the matcher into training mode; frozen parts stay in evaluation mode, so their running statistics are fixed.

    Frozen towers never enter training mode, not even for a moment, because another thread may encode with them.
    """
    towers = (matcher.touch_tower, matcher.photo_tower)
    for part in matcher.children():
        part.train(not (settings.freeze_towers and part in towers))
    if settings.freeze_stem:
        for tower in towers:
            tower.stem_layers().eval()
    if settings.freeze_batch_norm:
        freeze_batch_norm(matcher)
