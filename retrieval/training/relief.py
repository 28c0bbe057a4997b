"""Teaching one tower what relief looks like, from labelled pictures alone: no touch needs its photo.

A photographed object costs a tenth of a felt one, and what a matcher lacks on the photo's side is objects. The tower
learns which relief and shape an object has, how wide, high, drawn out and sharp its relief is; its weights then begin a
matcher's (`init_photo`, `init_touch`), whose head is trained on felt objects as before.
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
from torch.nn import functional

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
from retrieval.training.disk_image_cache import DiskImageCache
from retrieval.training.fit import Plan, fit
from retrieval.training.state import load_state, require_no_unfinished_state, save_state, state_path

BATCH, ITERATIONS, LEARNING_RATE = 32, 1500, 4e-4
WEIGHT_DECAY, SMOOTHING, DROPOUT = 0.03, 0.05, 0.2
HEAD_RATE_FACTOR = 5.0
"""The head, which begins at zero, learns so many times faster than the tower."""
VALIDATION, MAX_VALIDATION_OBJECTS = 0.05, 400
SAVE_EVERY = 200
BACKGROUNDS = ("none", "difference+0.5")
"""Policies under which touches are seen, in turns: the weights serve matchers of both."""
VISIBLE_FRACTION = 0.8
"""Share of a photo's side that a step sees; a gel is seen whole."""


@dataclass(frozen=True)
class ReliefReport:
    """How well objects that were held out are told.

    families: of `FAMILIES`, the share named right and what chance would name. sizes: of `SIZES`, the correlation of the
    reading with the truth (of pitch, amplitude and aspect their logarithms).
    """

    kind: str
    pictures: int
    objects: int
    steps: int
    families: dict[str, tuple[float, float]]
    sizes: dict[str, float]

    def lines(self) -> list[str]:
        """The report as lines for people."""
        return [
            f"{self.kind}: {self.steps} steps on {self.pictures} pictures of {self.objects} objects",
            "objects held out: "
            + ", ".join(f"{name} {share:.3f} (chance {chance:.3f})" for name, (share, chance) in self.families.items()),
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

    Photos are seen as the view "grey" or "zoom" shows them, touches with and without their background, whichever of
    both the matcher wants (`config.preprocessing`, by which the report judges); the first weights are
    `config.training.init`. resume: go on from the state beside `out`. cache: folder where decoded images are kept
    (`retrieval.training.disk_image_cache`). Ctrl-C keeps a state and raises JobInterrupted.
    Raises DatasetError, ConfigError, CheckpointError.
    """
    if config.preprocessing.background == "difference":
        raise ConfigError(
            'pictures are learned from in 8 bits, which hold no darker than black; set background = "difference+0.5"'
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
        raise JobInterrupted(f"stopped at step {training.step} of {iterations}; --resume goes on from here")
    report = training.report()
    about = {"tower": config.matcher.tower, "tower_output": config.matcher.tower_output}
    write_tensors(out, training.tower.state_dict(), about | dataclasses.asdict(report))
    state_path(out).unlink(missing_ok=True)
    return report


class ReliefTraining:
    """A tower, the head that reads relief off its features, and the pictures they learn from."""

    def __init__(self, kind: str, pictures: Sequence[LabelledPicture], config: Config, iterations: int) -> None:
        self.kind, self.config, self.iterations, self.step = kind, config, iterations, 0
        self.device, seed = default_device(), config.training.seed
        objects = sorted({picture.object_id for picture in pictures})
        held_out = max(1, min(round(VALIDATION * len(objects)), MAX_VALIDATION_OBJECTS))
        self.labels = labels_digest(pictures)
        chosen = set(np.random.default_rng([seed, 1]).permutation(objects)[:held_out].tolist())
        self.pictures = [picture for picture in pictures if picture.object_id not in chosen]
        self.validation = [picture for picture in pictures if picture.object_id in chosen]
        self.families = [sorted({each.families[place] for each in self.pictures}) for place in range(len(FAMILIES))]
        if len(self.families[0]) < 2:
            raise DatasetError(f"relief can be learned from two families and more; got {', '.join(self.families[0])}")
        sizes = np.array([each.size_targets for each in self.pictures if not each.is_smooth])
        self.mean, self.deviation = sizes.mean(0), sizes.std(0) + 1e-6
        torch.manual_seed(seed)
        matcher = config.matcher
        self.tower = build_tower(matcher.tower, matcher.tower_output, matcher.architectures)
        initialise_tower(self.tower, config.training.init)
        features = self.tower.feature_count
        last = nn.Linear(features, sum(map(len, self.families)) + len(SIZES))
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.head = nn.Sequential(nn.BatchNorm1d(features, affine=False), nn.Dropout(DROPOUT), last)
        self.modules = nn.ModuleDict({"tower": self.tower, "head": self.head}).to(self.device)
        self.optimizer = torch.optim.AdamW(
            [{"params": self.tower.parameters()}, {"params": self.head.parameters()}], weight_decay=WEIGHT_DECAY
        )
        self._variants: ImageCache | DiskImageCache = ImageCache(self._load)
        self._workers = worker_pool(config.training.workers)

    def _load(self, file: Path, before: Path | None) -> NDArray[np.uint8]:
        """(forms, H, W, 3) of a picture as the matcher sees it; a touch also as a matcher of another policy for the
        background would.
        """
        settings = self.config.preprocessing
        if self.kind == "photo":
            forms = [Preprocessing(photo_px=settings.photo_px, views=("zoom",)).load_photo(file)]
        else:
            policies = dict.fromkeys((settings.background, *BACKGROUNDS))
            forms = [replace(settings, background=policy).load_touch(file, before) for policy in policies]
        return np.rint(255 * np.stack(forms)).astype(np.uint8)

    def cache_decoded(self, folder: Path, *, quiet: bool = False) -> None:
        """Have all pictures decoded into `folder`, and taken from there from now on (`DiskImageCache`)."""
        preprocessing_digest = replace(self.config.preprocessing, views=("zoom",)).digest()
        self._variants = DiskImageCache(
            self._load, folder, f"relief-{self.kind}", preprocessing_digest, self.config.training.workers
        )
        everything = sorted([*self.pictures, *self.validation], key=lambda picture: picture.file)
        self._variants.cache_decoded([(picture.file, picture.before) for picture in everything], quiet=quiet)

    def _images(self, pictures: Sequence[LabelledPicture], rng: np.random.Generator | None = None) -> Tensor:
        """(B, 3, H, W) of pictures in 8 bits. rng: draws how each touch is seen."""
        seen = [
            to_float(forms[rng.integers(len(forms)) if rng else 0])
            for forms in self._workers.map(lambda picture: self._variants(picture.file, picture.before), pictures)
        ]
        return to_batch(seen)

    def run(self, out: Path, bar: Bar, should_stop: Callable[[], bool]) -> None:
        """Train from the current step to the last, saving the state of `out` now and then."""
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
                before_step=self._scale_head_rate,
                after_step=self._after_step,
                validate=lambda _: self._save(out),
                should_stop=should_stop,
            )

    def _scale_head_rate(self) -> None:
        self.optimizer.param_groups[1]["lr"] *= HEAD_RATE_FACTOR

    def _after_step(self, done: int) -> None:
        self.step = done

    def _batch(self, step: int) -> tuple[list[LabelledPicture], Tensor]:
        rng = np.random.default_rng([self.config.training.seed, 2, step])
        chosen = [self.pictures[row] for row in rng.integers(len(self.pictures), size=BATCH)]
        return chosen, augment(self._images(chosen, rng), self.kind, rng)

    def _loss(self, batch: tuple[list[LabelledPicture], Tensor]) -> Tensor:
        pictures, images = batch
        self.tower.train()
        for module in self.tower.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()  # the published statistics hold; a batch of 32 is too few for new ones
        self.head.train()
        torch.manual_seed(self.config.training.seed * 1_000_003 + self.step)  # the dropout mask
        *families, sizes = self._readings(images)
        worn = torch.tensor([not each.is_smooth for each in pictures], device=self.device)
        loss = ((sizes - self._targets(pictures)).square().mean(1) * worn).mean()
        for place, (names, readings) in enumerate(zip(self.families, families, strict=True)):
            named = torch.tensor([names.index(each.families[place]) for each in pictures], device=self.device)
            loss = loss + functional.cross_entropy(readings, named, label_smoothing=SMOOTHING)
        return loss

    def _readings(self, images: Tensor) -> tuple[Tensor, ...]:
        """Of images (B, 3, H, W): logits (B, kinds) for each of FAMILIES, then standardised SIZES (B, sizes)."""
        with autocast(self.device, self.config.training.precision):
            features = self.tower(images.to(self.device, memory_format=torch.channels_last))
        readings: Tensor = self.head(features.float())
        return torch.split(readings, [*map(len, self.families), len(SIZES)], dim=1)

    def _targets(self, pictures: Sequence[LabelledPicture]) -> Tensor:
        sizes = (np.array([each.size_targets for each in pictures]) - self.mean) / self.deviation
        return torch.from_numpy(sizes.astype(np.float32)).to(self.device)

    @torch.inference_mode()
    def report(self) -> ReliefReport:
        """FusionScorer the objects that were held out; a touch by each of its fingers."""
        self.tower.eval()
        self.head.eval()
        parts = [self.validation[start : start + BATCH] for start in range(0, len(self.validation), BATCH)]
        read = [self._readings(centre_crop(self._images(part), self.kind)) for part in parts]
        *families, sizes = (torch.cat(part).cpu().numpy() for part in zip(*read, strict=True))
        told = {}
        for place, (name, known, readings) in enumerate(zip(FAMILIES, self.families, families, strict=True)):
            named = np.array(known)[readings.argmax(1)]
            right = named == np.array([each.families[place] for each in self.validation])
            told[name] = float(right.mean()), 1 / len(known)
        worn = np.array([not each.is_smooth for each in self.validation])
        wanted = self._targets(self.validation).cpu().numpy()
        everything = [*self.pictures, *self.validation]
        return ReliefReport(
            kind=self.kind,
            pictures=len(everything),
            objects=len({each.object_id for each in everything}),
            steps=self.step,
            families=told,
            sizes={name: _correlation(sizes[worn, at], wanted[worn, at]) for at, name in enumerate(SIZES)},
        )

    def _identity(self) -> dict[str, Any]:
        """What must be the same for a training to be resumed."""
        return {"config": self.config.to_dict(), "iterations": self.iterations, "pictures": self.labels}

    def _save(self, out: Path) -> None:
        save_state(out, self.modules, self.optimizer, {"step": self.step, **self._identity()})

    def resume(self, out: Path) -> None:
        """Continue from the state of `out`. Raises CheckpointError where there is none, or one of another training."""
        self.step = load_state(out, self.modules, self.optimizer, self._identity())["step"]


def augment(images: Tensor, kind: str, rng: np.random.Generator) -> Tensor:
    """Other pictures of the same relief, from images (B, 3, H, W): turned by up to .1 rad, 8 % nearer or further,
    shifted, flipped, in other light, with noise; photos also drawn towards grey, for colour says nothing of relief.

    A gel's colours come from its lamps: they keep their places, so a gel is flipped only top to bottom, where it is
    the same press with the finger turned, and its channels are scaled alike.
    """
    count = len(images)

    def draw(low: float, high: float, *shape: int) -> Tensor:
        return torch.from_numpy(rng.uniform(low, high, (count, *shape)).astype(np.float32))

    turn, size = draw(-0.1, 0.1), draw(0.92, 1.08)
    flip = torch.from_numpy(np.where(rng.random(count) < 0.5, -1.0, 1.0).astype(np.float32))
    shown = VISIBLE_FRACTION if kind == "photo" else 1.0
    across, down = (flip, torch.ones(count)) if kind == "photo" else (torch.ones(count), flip)
    cosine, sine = torch.cos(turn) * size * shown, torch.sin(turn) * size * shown
    shift = draw(-0.1, 0.1, 2) if kind == "photo" else draw(-0.05, 0.05, 2)
    maps = torch.stack([across * cosine, -down * sine, shift[:, 0], across * sine, down * cosine, shift[:, 1]], 1)
    seen = _sample_grid(images, maps.view(count, 2, 3), shown)
    if kind == "photo":
        grey, towards = seen.mean(1, keepdim=True), draw(0.0, 1.0, 1, 1, 1)
        seen = torch.lerp(seen, grey.expand_as(seen), (towards + 0.5).clamp(max=1.0) * (towards > 0.25))
        middle = seen.mean((1, 2, 3), keepdim=True)
        seen = (seen - middle) * draw(0.7, 1.3, 1, 1, 1) + middle + draw(-0.15, 0.15, 1, 1, 1)
    else:
        seen = (seen - 0.5) * draw(0.7, 1.4, 1, 1, 1) + 0.5
    noise = torch.from_numpy(rng.standard_normal(seen.shape, dtype=np.float32))
    return (seen + 0.01 * noise).clamp(0.0, 1.0)


def centre_crop(images: Tensor, kind: str) -> Tensor:
    """What of images is seen where nothing is drawn: the middle of a photo, in grey; a whole gel."""
    if kind == "touch":
        return images
    same = torch.tensor([[VISIBLE_FRACTION, 0.0, 0.0], [0.0, VISIBLE_FRACTION, 0.0]]).expand(len(images), 2, 3)
    seen = _sample_grid(images, same, VISIBLE_FRACTION)
    return seen.mean(1, keepdim=True).expand_as(seen)


def _sample_grid(images: Tensor, maps: Tensor, shown: float) -> Tensor:
    side = [max(round(shown * length), 1) for length in images.shape[2:]]
    grid = functional.affine_grid(maps, [len(images), 3, *side], align_corners=False)
    return functional.grid_sample(images.contiguous(), grid, padding_mode="reflection", align_corners=False)


def _correlation(readings: NDArray[np.float32], wanted: NDArray[np.float32]) -> float:
    """Pearson's correlation; 0 where one side does not vary."""
    if len(readings) < 2 or readings.std() == 0 or wanted.std() == 0:
        return 0.0
    return float(np.corrcoef(readings, wanted)[0, 1])
