"""Pretrain one tower on relief and shape labels, from labelled pictures without touch-photo pairs.

A photo-only object takes a tenth of the time of a grasped one, and a photo tower is limited mainly by the number of
objects. The tower learns the relief and shape families of an object, and the pitch, amplitude, aspect and sharpness of
its relief. A matcher starts from its weights (`init_photo`, `init_touch`), and its head is trained on touched objects.
"""

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retrieval.console.interruption import interruption
from retrieval.console.progress import Bar
from retrieval.data.dataset import ImageCache
from retrieval.data.images import to_float
from retrieval.data.labelled_pictures import FAMILIES, SIZES, LabelledPicture, labels_digest, load_labelled
from retrieval.data.loading import prefetch, worker_pool
from retrieval.data.preprocessing import Preprocessing
from retrieval.errors import ConfigError, DatasetError, JobInterrupted
from retrieval.model.checkpoint import require_writable, write_tensors
from retrieval.model.config import Config
from retrieval.model.encode import autocast, default_device, to_batch
from retrieval.model.towers import build_tower
from retrieval.model.towers.weights import initialise_tower
from retrieval.training.augmentation import augment, sample_grid
from retrieval.training.disk_image_cache import DiskImageCache
from retrieval.training.fit import RATE, Plan, fit, freeze_batch_norm
from retrieval.training.labels import LabelHead
from retrieval.training.state import load_state, require_no_unfinished_state, save_state, state_path

BATCH, ITERATIONS, LEARNING_RATE = 32, 1500, 4e-4
WEIGHT_DECAY = 0.03
HEAD_RATE_FACTOR = 5.0
"""Ratio of the head's learning rate to the tower's, since the head starts at zero."""
VALIDATION, MAX_VALIDATION_OBJECTS = 0.05, 400
SAVE_EVERY = 200
BACKGROUNDS = ("none", "difference+0.5")
"""Background policies of training touches, drawn at random, so that the weights suit matchers of both policies."""
VISIBLE_FRACTION = 0.8
"""Fraction of a photo's side that a training step uses; a gel image is used whole."""


@dataclass(frozen=True)
class ReliefReport:
    """Accuracy of a pretrained tower on held-out objects.

    Attributes:
        kind: "photo" or "touch".
        pictures: Number of all pictures.
        objects: Number of all objects.
        steps: Number of training steps.
        families: Accuracy and chance accuracy for each of `FAMILIES`.
        sizes: Correlation of predicted and true value for each of `SIZES` (logarithms except for the sharpness).
    """

    kind: str
    pictures: int
    objects: int
    steps: int
    families: dict[str, tuple[float, float]]
    sizes: dict[str, float]

    def lines(self) -> list[str]:
        """Return the report as lines for people."""
        return [
            f"{self.kind}: {self.steps} steps on {self.pictures} pictures of {self.objects} objects",
            "held-out objects: "
            + ", ".join(f"{name} {value:.3f} (chance {chance:.3f})" for name, (value, chance) in self.families.items()),
            "correlations: "
            + ", ".join(f"{name.removesuffix('_mm')} {value:.2f}" for name, value in self.sizes.items()),
        ]


def train_relief(
    folder: Path,
    out: Path,
    config: Config,
    *,
    iterations: int = ITERATIONS,
    resume: bool = False,
    cache: Path | None = None,
    quiet: bool = False,
) -> ReliefReport:
    """Train a tower of `config` on the pictures in `folder` and write its weights to `out` (.safetensors).

    Photos are used as in the views "zoom" and "grey", touches with and without background subtraction. The report uses
    `config.preprocessing`. The initial weights are `config.training.init`. Ctrl-C saves a state.

    Args:
        folder: Folder that `retrieve collect --photos-only` or `--touches-only` wrote.
        out: File of the weights.
        config: The configuration.
        iterations: Number of steps.
        resume: Continue from the state next to `out`.
        cache: Folder of decoded images (`retrieval.training.disk_image_cache`).
        quiet: No progress on stderr.

    Returns:
        The accuracy on held-out objects.

    Raises:
        DatasetError, ConfigError, CheckpointError: Training is not possible with the data or settings.
        JobInterrupted: After Ctrl-C.
    """
    if config.preprocessing.background == "difference":
        raise ConfigError(
            "relief training uses 8-bit pictures, which cannot store negative differences; "
            'set background = "difference+0.5"'
        )
    if iterations < 1:
        raise ConfigError(f"iterations must be at least 1; got {iterations}")
    require_writable(out)
    kind, pictures = load_labelled(folder)
    training = ReliefTraining(kind, pictures, config, iterations)
    if resume:
        training.resume(out)
    else:
        require_no_unfinished_state(out)
    if cache:
        training.cache_decoded(cache, quiet=quiet)
    with interruption() as stop, Bar("train relief", iterations, "steps", done=training.step, quiet=quiet) as bar:
        training.run(out, bar, stop.is_set)
    if training.step < iterations:
        raise JobInterrupted(f"stopped at step {training.step} of {iterations}; --resume continues from here")
    report = training.report()
    about = {"tower": config.matcher.tower, "tower_output": config.matcher.tower_output}
    write_tensors(out, training.tower.state_dict(), about | dataclasses.asdict(report))
    state_path(out).unlink(missing_ok=True)
    return report


class ReliefTraining:
    """A tower, a head that predicts the labels from its features, and their training pictures."""

    def __init__(self, kind: str, pictures: Sequence[LabelledPicture], config: Config, iterations: int) -> None:
        self.kind, self.config, self.iterations, self.step = kind, config, iterations, 0
        self.device, seed = default_device(), config.training.seed
        objects = sorted({picture.object_id for picture in pictures})
        count = max(1, min(round(VALIDATION * len(objects)), MAX_VALIDATION_OBJECTS))
        self.labels = labels_digest(pictures)
        held_out = set(np.random.default_rng([seed, 1]).permutation(objects)[:count].tolist())
        self.pictures = [picture for picture in pictures if picture.object_id not in held_out]
        self.validation = [picture for picture in pictures if picture.object_id in held_out]
        reliefs = sorted({picture.labels.relief for picture in self.pictures})
        if len(reliefs) < 2:
            raise DatasetError(f"training needs at least two relief families, got {', '.join(reliefs)}")
        torch.manual_seed(seed)
        matcher = config.matcher
        self.tower = build_tower(matcher.tower, matcher.tower_output, matcher.architectures)
        initialise_tower(self.tower, config.training.init)
        self.head = LabelHead(self.tower.feature_count, [picture.labels for picture in self.pictures])
        self.modules = nn.ModuleDict({"tower": self.tower, "head": self.head}).to(self.device)
        groups: list[dict[str, Any]] = [
            {"params": self.tower.parameters()},
            {"params": self.head.parameters(), RATE: HEAD_RATE_FACTOR},
        ]
        self.optimizer = torch.optim.AdamW(groups, weight_decay=WEIGHT_DECAY)
        self._variants: ImageCache | DiskImageCache = ImageCache(self._load)
        self._workers = worker_pool(config.training.workers)

    def _load(self, file: Path, before: Path | None) -> NDArray[np.uint8]:
        """Return the variants (V, H, W, 3) of a picture: the matcher's, and for touches those of other policies."""
        settings = self.config.preprocessing
        if self.kind == "photo":
            variants = [Preprocessing(photo_px=settings.photo_px, views=("zoom",)).load_photo(file)]
        else:
            policies = dict.fromkeys((settings.background, *BACKGROUNDS))
            variants = [replace(settings, background=policy).load_touch(file, before) for policy in policies]
        return np.rint(255 * np.stack(variants)).astype(np.uint8)

    def cache_decoded(self, folder: Path, *, quiet: bool = False) -> None:
        """Decode all pictures into `folder`, and read them from there afterwards (`DiskImageCache`)."""
        preprocessing_digest = replace(self.config.preprocessing, views=("zoom",)).digest()
        self._variants = DiskImageCache(
            self._load, folder, f"relief-{self.kind}", preprocessing_digest, self.config.training.workers
        )
        everything = sorted([*self.pictures, *self.validation], key=lambda picture: picture.file)
        self._variants.cache_decoded([(picture.file, picture.before) for picture in everything], quiet=quiet)

    def _images(self, pictures: Sequence[LabelledPicture], rng: np.random.Generator | None = None) -> Tensor:
        """Return pictures as a batch (B, 3, H, W). `rng` draws the variant of each; default: the first."""
        images = [
            to_float(variants[rng.integers(len(variants)) if rng else 0])
            for variants in self._workers.map(lambda picture: self._variants(picture.file, picture.before), pictures)
        ]
        return to_batch(images)

    def run(self, out: Path, bar: Bar, should_stop: Callable[[], bool]) -> None:
        """Train from the current step to the last, and save the state of `out` every SAVE_EVERY steps."""
        plan = Plan(self.iterations, LEARNING_RATE, "cosine", SAVE_EVERY)
        with ThreadPoolExecutor(1) as batches:
            steps = range(self.step, self.iterations)
            prepared = (batches.submit(self._batch, step) for step in steps)
            fit(
                self.optimizer,
                plan,
                prefetch(prepared, self.config.training.prefetch),
                self._loss,
                bar=bar,
                done=self.step,
                after_step=self._after_step,
                validate=lambda _: self._save(out),
                should_stop=should_stop,
            )

    def _after_step(self, done: int) -> None:
        self.step = done

    def _batch(self, step: int) -> tuple[list[LabelledPicture], Tensor]:
        rng = np.random.default_rng([self.config.training.seed, 2, step])
        chosen = [self.pictures[row] for row in rng.integers(len(self.pictures), size=BATCH)]
        visible = VISIBLE_FRACTION if self.kind == "photo" else 1.0
        return chosen, augment(self._images(chosen, rng), self.kind, rng, visible=visible)

    def _loss(self, batch: tuple[list[LabelledPicture], Tensor]) -> Tensor:
        pictures, images = batch
        self.tower.train()
        freeze_batch_norm(self.tower)  # a batch of 32 is too small for new statistics
        self.head.train()
        torch.manual_seed(self.config.training.seed * 1_000_003 + self.step)  # the dropout mask
        return self.head.loss(self._features(images), [picture.labels for picture in pictures])

    def _features(self, images: Tensor) -> Tensor:
        with autocast(self.device, self.config.training.precision):
            features: Tensor = self.tower(images.to(self.device, memory_format=torch.channels_last))
        return features

    @torch.inference_mode()
    def report(self) -> ReliefReport:
        """Evaluate the tower on the held-out objects; each finger of a touch counts separately."""
        self.tower.eval()
        self.head.eval()
        parts = [self.validation[start : start + BATCH] for start in range(0, len(self.validation), BATCH)]
        outputs = [self.head(self._features(centre_crop(self._images(part), self.kind))) for part in parts]
        *families, sizes = (torch.cat(part).cpu().numpy() for part in zip(*outputs, strict=True))
        accuracies = {}
        for index, (name, known, logits) in enumerate(zip(FAMILIES, self.head.families, families, strict=True)):
            predicted = np.array(known)[logits.argmax(1)]
            correct = predicted == np.array([picture.labels.families[index] for picture in self.validation])
            accuracies[name] = float(correct.mean()), 1 / len(known)
        labels = [picture.labels for picture in self.validation]
        has_relief = np.array([not each.is_smooth for each in labels])
        targets = self.head.size_targets(labels).cpu().numpy()
        everything = [*self.pictures, *self.validation]
        return ReliefReport(
            kind=self.kind,
            pictures=len(everything),
            objects=len({each.object_id for each in everything}),
            steps=self.step,
            families=accuracies,
            sizes={name: _correlation(sizes[has_relief, at], targets[has_relief, at]) for at, name in enumerate(SIZES)},
        )

    def _identity(self) -> dict[str, Any]:
        """Return the settings that must not change between a training run and its resumption."""
        return {"config": self.config.to_dict(), "iterations": self.iterations, "pictures": self.labels}

    def _save(self, out: Path) -> None:
        save_state(out, self.modules, self.optimizer, {"step": self.step, **self._identity()})

    def resume(self, out: Path) -> None:
        """Continue from the state of `out`.

        Raises:
            CheckpointError: There is no state, or it belongs to another training run.
        """
        self.step = load_state(out, self.modules, self.optimizer, self._identity())["step"]


def centre_crop(images: Tensor, kind: str) -> Tensor:
    """Return images for evaluation: the middle of a photo in grey, or a whole gel image."""
    if kind == "touch":
        return images
    same = torch.tensor([[VISIBLE_FRACTION, 0.0, 0.0], [0.0, VISIBLE_FRACTION, 0.0]]).expand(len(images), 2, 3)
    middle = sample_grid(images, same, VISIBLE_FRACTION)
    return middle.mean(1, keepdim=True).expand_as(middle)


def _correlation(predictions: NDArray[np.float32], targets: NDArray[np.float32]) -> float:
    """Return Pearson's correlation, or 0 if one side does not vary."""
    if len(predictions) < 2 or predictions.std() == 0 or targets.std() == 0:
        return 0.0
    return float(np.corrcoef(predictions, targets)[0, 1])
