"""Train a matcher with given settings: from a recording to a checkpoint.

recording -> grasps -> split -> images or cached features -> `train_loop` -> candidate encoder, calibrations -> file
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor, nn

from _touch_retrieval.registry import code_digest
from retrieval.console.interruption import resumable
from retrieval.console.progress import Bar
from retrieval.data.camera import USUAL_CAMERA, PhotoCamera
from retrieval.data.check.split import require_fit
from retrieval.data.dataset import (
    AnyRecording,
    Grasp,
    Split,
    finger_count,
    folder_of,
    load_grasps,
    make_split,
    recording_camera,
)
from retrieval.data.pairs import PairBatch, PairSampler
from retrieval.metrics.pairs import negative_log_likelihood, pair_accuracy, pair_auc
from retrieval.model.checkpoint import (
    Checkpoint,
    load_checkpoint,
    require_writable,
    store_checkpoint,
    tensors_digest,
)
from retrieval.model.config import Config, TrainingConfig, named_config
from retrieval.model.encode import default_device
from retrieval.model.fusion import Matcher
from retrieval.model.losses import LOSSES
from retrieval.model.losses.loss import EncodedBatch, match_loss
from retrieval.model.towers.tower import Tower
from retrieval.training.batches import FeatureSource, FrozenFeatures, LoadedBatch, TrainedFeatures
from retrieval.training.calibration.checkpoint import calibrate_checkpoint
from retrieval.training.distil import add_candidate_encoder
from retrieval.training.features import encode_recording, features_by_image
from retrieval.training.initial_weights import (
    TOWER_WEIGHTS,
    build_matcher,
    made_from,
    training_licences,
)
from retrieval.training.loop import (
    RATE,
    OnStep,
    Plan,
    StateFile,
    freeze_batch_norm,
    state_path,
    train_loop,
)


def train_matcher(
    recording: AnyRecording,
    out: Path,
    config: Config | str,
    *,
    split: Split | None = None,
    on_step: OnStep | None = None,
) -> Checkpoint:
    """Train on a recording and write the checkpoint with the best validation score to `out`.

    An unfinished run of `out` continues from the state file next to it. Ctrl-C stops after the current step, a second
    one immediately. Arguments and errors are those of `retrieval.train`, whose `config` this function takes.
    """
    folder, config = folder_of(recording), named_config(config)[0]
    require_writable(out)
    grasps = load_grasps(folder)
    config = dataclasses.replace(config, matcher=dataclasses.replace(config.matcher, fingers=finger_count(grasps)))
    settings = config.training
    if split is None:
        split = make_split(
            grasps, validation=settings.validation_fraction, test=settings.test_fraction, seed=settings.seed
        )
    else:
        require_fit(split, grasps)
    made = made_from(folder, grasps, training_licences(folder, settings))
    camera = recording_camera(folder, grasps, config.preprocessing)
    return Trainer(config, split, grasps, out, made, camera=camera).run(on_step=on_step)


_MADE_FROM = ("data_digest", "weights_digest", "code", "camera")


class Trainer:
    """One training run of a matcher.

    Attributes:
        matcher: The model.
        modules: All that is trained: the matcher and the losses.
        sampler: The pairs of each step.
        features: Source of the features of images.
        out: The checkpoint.
    """

    def __init__(
        self,
        config: Config,
        split: Split,
        grasps: list[Grasp],
        out: Path,
        provenance: Mapping[str, Any],
        features: FeatureSource | None = None,
        weights: Mapping[str, Tensor] = MappingProxyType({}),
        camera: PhotoCamera = USUAL_CAMERA,
    ) -> None:
        """Prepare a run.

        `provenance`: origin of the data (`made_from`). `features`: features in place of the images, which are then not
        read, also for no calibration. `weights`: weights that replace the initial ones of these names. `camera`: camera
        of the photos.
        """
        settings = config.training
        self.config, self.split, self.out = config, split, out
        self.device = default_device()
        torch.manual_seed(settings.seed)
        self.has_images = features is None
        self.matcher = build_matcher(config.without_candidate_encoder()).to(self.device)
        self.matcher.load_state_dict(weights, strict=False)
        self.sampler = self._sampler(split.select(grasps, "train"))
        self.losses = WeightedLosses(settings.weights, self.matcher, len(self.sampler.grasps)).to(self.device)
        self.modules = nn.ModuleDict({"matcher": self.matcher, "losses": self.losses})
        groups: list[dict[str, Any]] = [{"params": []}, {"params": [], RATE: settings.tower_rate}]
        for name, parameter in self.matcher.named_parameters():
            if parameter.requires_grad:
                groups[name.startswith(TOWER_WEIGHTS)]["params"].append(parameter)
        groups[0]["params"] += self.losses.parameters()
        # On a CPU, PyTorch's default optimizer reads every tensor eight times. The fused optimizer reads it once. On
        # CUDA the default optimizer is fast.
        self.optimizer = torch.optim.Adam(groups, lr=settings.learning_rate, fused=self.device.type == "cpu")
        self.optimizer.register_step_post_hook(lambda *_: self.matcher.clamp_scale())
        held_out = split.select(grasps, "validation")
        self.validation = self._sampler(held_out).evaluation_pairs() if split.validation else None
        if features is None and settings.freeze_towers:
            used = [*split.select(grasps, "train"), *held_out]
            encoded = encode_recording(used, self.matcher, config, None, camera=camera)
            features = FrozenFeatures(features_by_image(used, encoded, self.device))
        self.features = features or TrainedFeatures(config, self.device, camera)
        set_training_mode(self.matcher, settings)
        towers = [module for module in self.matcher.modules() if isinstance(module, Tower)]
        self.provenance = {
            **provenance,
            **({"weights_digest": tensors_digest(weights, "")} if weights else {}),
            **({"camera": list(camera)} if camera != USUAL_CAMERA else {}),
            **code_digest(*map(type, (*self.losses.terms, *towers))),
        }

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

    def run(self, *, replace: bool = False, on_step: OnStep | None = None) -> Checkpoint:
        """Train from the first step, or from that of the state file, to the last; write the checkpoint and return it.

        `replace`: replace the state of another run, which is else an error. `on_step`: see `train_loop`.

        Raises:
            CheckpointError: The state file belongs to another run.
            JobInterrupted: After Ctrl-C; the next call continues.
        """
        settings, touches = self.config.training, self.config.training.touches_per_batch
        made_from = {name: self.provenance.get(name) for name in _MADE_FROM}
        identity = {"config": self.config.to_dict(), "split": self.split.to_dict(), **made_from}
        state = StateFile(state_path(self.out), identity, is_replaceable=replace)
        best = train_loop(
            self.modules,
            self.optimizer,
            Plan(settings.iterations, settings.learning_rate, settings.schedule, settings.validate_every),
            lambda steps: self.features.batches(
                self.matcher, ((step, self.sampler.batch(step, touches)) for step in steps)
            ),
            self.loss,
            title="training",
            validate=self.validate,
            state=state,
            step_context=self.features.step_context,
            on_step=on_step,
        )
        made = Checkpoint(
            self.out,
            digest="",
            config=self.config.without_candidate_encoder(),
            provenance={"step": best.step, **self.provenance, "metrics": best.metrics},
            matcher=self.matcher.eval(),
            split=self.split,
        )
        with resumable(state.path), Bar("calibrating", 1, "model") as bar:
            train = [grasp for part in self.sampler.grasps for grasp in part]
            held_out = self.validation.grasps if self.validation else []
            if self.config.matcher.candidate_width:
                made = add_candidate_encoder(made, self.config, self.features, train, held_out)
            if self.has_images:
                made = calibrate_checkpoint(made, self.features, train, held_out)
            store_checkpoint(made, self.out)
            state.path.unlink()
            bar.advance()
        return load_checkpoint(self.out)

    def run_or_reuse(self, *, on_step: OnStep | None = None) -> Checkpoint:
        """Return the finished checkpoint of this run, or run; files of another run are replaced.

        Raises:
            JobInterrupted: After Ctrl-C; the next call continues.
        """
        if self.out.is_file() and not state_path(self.out).exists():
            stored = load_checkpoint(self.out)
            same = all(stored.provenance.get(name) == self.provenance.get(name) for name in _MADE_FROM)
            if same and (stored.config, stored.split) == (self.config, self.split):
                return stored
        return self.run(replace=True, on_step=on_step)

    def loss(self, step: int, loaded: LoadedBatch) -> Tensor:
        """Return the loss of a step and its prepared batch."""
        settings = self.config.training
        torch.manual_seed(settings.seed * 1_000_003 + step)  # the dropout mask
        touch, photo = self.features.train_features(self.matcher, loaded)
        if settings.shuffle_fingers:
            touch = shuffle_fingers(touch, self.matcher.config.fingers)
        return self.feature_loss(loaded.batch, touch, photo)

    def feature_loss(self, batch: PairBatch, touch: Tensor, photo: Tensor) -> Tensor:
        """Return the loss of a batch and the features of its touches and photos (`Matcher.touch_features`)."""
        return batch_loss(self.matcher, self.losses, batch, touch, photo)

    @torch.inference_mode()
    def validate(self) -> dict[str, float]:
        """Return the metrics of the fixed validation pairs; empty without validation objects."""
        pairs, matcher = self.validation, self.matcher
        if pairs is None:
            return {}
        matcher.eval()
        features = self.features.eval_features(matcher, pairs.grasps, pairs.photos)
        with self.features.step_context():
            touch, photo = matcher.touch_encoding(features[0]), matcher.photo_encoding(features[1])
            logits = matcher.head(touch.partial[pairs.touch_index], photo.partial[pairs.photo_index]).cpu().numpy()
        set_training_mode(matcher, self.config.training)
        return {
            "validation_auc": pair_auc(logits, pairs.labels),
            "validation_pair_accuracy": pair_accuracy(logits, pairs.labels),
            "validation_nll": negative_log_likelihood(logits, pairs.labels),
        }


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


# The loss --------------------------------------------------------------------------------------------------


class WeightedLosses(nn.Module):
    """The losses of a training run whose weight is above 0, with their own parameters."""

    def __init__(self, weights: Mapping[str, float], matcher: Matcher, objects: int) -> None:
        """Create the losses by name, to train `matcher` on this number of objects.

        Raises:
            ConfigError: A name is unknown.
        """
        super().__init__()
        self.weights = {name: weight for name, weight in weights.items() if weight > 0}
        dim = matcher.config.embedding_dim
        self.terms = nn.ModuleList(LOSSES.load(name)(dim, objects) for name in self.weights)


def batch_loss(
    matcher: Matcher, losses: WeightedLosses, batch: PairBatch, touch_features: Tensor, photo_features: Tensor
) -> Tensor:
    """Return the loss (scalar) of a batch, from features of its distinct touches and photos."""
    arrays = batch.touch_index, batch.photo_index, batch.labels, batch.touch_objects, batch.photo_objects
    touch_index, photo_index, labels, *objects = (torch.from_numpy(array).to(touch_features.device) for array in arrays)
    touch, photo = matcher.touch_encoding(touch_features), matcher.photo_encoding(photo_features)
    encoded = EncodedBatch(matcher, touch, photo, *objects)
    loss = match_loss(matcher.head(touch.partial[touch_index], photo.partial[photo_index]), labels)
    for weight, term in zip(losses.weights.values(), losses.terms, strict=True):
        loss = loss + weight * term(encoded)
    return loss


def shuffle_fingers(touch_features: Tensor, fingers: int) -> Tensor:
    """Return features (B, fingers * F) with the fingers of each touch permuted, drawn by PyTorch's CPU generator."""
    each = touch_features.view(len(touch_features), fingers, -1)
    order = torch.rand(len(each), fingers).argsort(dim=1).to(each.device)
    return torch.take_along_dim(each, order[..., None], dim=1).flatten(1)
