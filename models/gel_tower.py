"""The gel tower of the package: a touch tower for real gels (`retrieval.model.towers.weights.gel_tower`).

    python -m models.gel_tower FOLDER --init WEIGHTS [--steps N]
        press random surfaces into simulated sensors of any make, press labelled objects, train the tower from ImageNet
        weights, and write FOLDER/gel-tower.safetensors

A step encodes presses of several sensors and of labelled objects. Among the presses of one sensor, each must find the
other press of its surface, although light and contrast change between presses. Relief and shape of the labelled objects
are predicted. A third loss keeps the features near those of ImageNet. An interrupted job continues. WEIGHTS is a state
dict of MobileNetV2 with torchvision's key names.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import DataLoader, Dataset

from _touch_retrieval.files import atomic_file, write_atomically
from models.labels import LabelHead
from models.pictures import LabelledPicture, collect_pictures
from models.random_surfaces import RandomSurface, presses
from retrieval.console.memory import keep_freed_memory
from retrieval.console.output import say
from retrieval.console.progress import Bar, show_progress
from retrieval.data.card import LIBRARY, card_header
from retrieval.data.images import read_rgb
from retrieval.data.resize import resize, to_float
from retrieval.errors import JobInterrupted
from retrieval.model.checkpoint import write_tensors
from retrieval.model.encode import autocast, default_device
from retrieval.model.towers.tower import Tower, build_tower
from retrieval.training.augmentation import sample_affine
from retrieval.training.loop import RATE, Plan, StateFile, freeze_batch_norm, state_path, train_loop
from robot.sim.gel.sensor import draw_sensor
from robot.workers import Work, WorkerPool

RIG = Path(__file__).parent / "gel_tower_rig.toml"
SEED_SENSORS, SEED_LABELLED = 900_000, 61_500
OPTICS = {"varied": 0.65, "led": 0.27, "grey": 0.08}
"""Probability of the optics of a sensor."""
SENSORS, SURFACES, PRESSES = 280, 30, 4
"""Sensors, surfaces that each one is pressed on, and presses of a surface."""
LABELLED = 9000
"""Labelled objects."""
STORED_PX, TOUCH_PX = 208, 160
"""Side of the stored pictures and of those of a training step."""
STEPS, LEARNING_RATE, WEIGHT_DECAY, SAVE_EVERY = 500, 1.2e-4, 0.02, 100
EARLY_LAYERS, EARLY_RATE, HEAD_RATE = 7, 0.3, 5.0
"""Layers whose learning rate is a fraction of that of the others, this fraction, and the factor of the heads."""
SENSORS_OF_STEP, SURFACES_OF_STEP, LABELLED_OF_STEP = 2, 22, 40
WORKERS = 2
"""Processes that prepare batches."""
TEMPERATURE, EMBEDDING = 0.1, 256
LABEL_WEIGHT, DISTIL_WEIGHT = 0.5, 0.3

Rng = np.random.Generator
Batch = tuple[Tensor, list[LabelledPicture]]


def main(argv: Sequence[str] | None = None) -> int:
    """Make the tower."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--init", type=Path, required=True, help="state dict of MobileNetV2, torchvision's key names")
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--sensors", type=int, default=SENSORS, help="number of simulated sensors")
    parser.add_argument("--labelled", type=int, default=LABELLED, help="number of labelled objects")
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args(argv)
    show_progress()
    keep_freed_memory()
    folder = arguments.folder
    files = press_surfaces(folder / "surfaces", arguments.sensors, arguments.jobs)
    size: dict[str, Any] = {"objects": arguments.labelled, "seed": SEED_LABELLED, "rig": str(RIG)}
    labelled = collect_pictures("touch", folder / "labelled", jobs=arguments.jobs, **size)
    training = GelTowerTraining(files, labelled, str(arguments.init))
    try:
        training.run(folder / "gel-tower.safetensors", arguments.steps)
    except JobInterrupted as stopped:
        say(str(stopped))
        return 1
    return 0


# Presses of random surfaces ------------------------------------------------------------------------------------


def press_surfaces(folder: Path, sensors: int, jobs: int) -> list[Path]:
    """Press random surfaces into the first `sensors` sensors; return a file of pictures for each.

    A file has the no-contact frame, then PRESSES pictures of each surface: (1 + SURFACES * PRESSES, STORED_PX,
    STORED_PX, 3) uint8. Existing files are kept.
    """
    files = [folder / f"{number:03}.npy" for number in range(sensors)]
    missing = [number for number, file in enumerate(files) if not file.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    with (
        Bar("press", sensors, "sensors", done=sensors - len(missing)) as bar,
        WorkerPool(jobs, sensor_pictures, _worker) as workers,
    ):
        for number, result in zip(missing, [workers.submit("", each) for each in missing], strict=True):
            with atomic_file(files[number]) as file:
                np.lib.format.write_array(file, result(), allow_pickle=False)
            bar.advance()
    return files


def _worker() -> Work[NDArray[np.uint8]]:
    return sensor_pictures


def sensor_pictures(_: str, number: int) -> NDArray[np.uint8]:
    """Return the pictures of one sensor."""
    rng = np.random.default_rng([number, 0x11])
    sensor = draw_sensor(SEED_SENSORS + number, "a", optics=str(rng.choice(list(OPTICS), p=list(OPTICS.values()))))
    pictures, seed = [sensor.background(1)], 1000 * number
    while len(pictures) < 1 + SURFACES * PRESSES:
        made = presses(RandomSurface.draw(seed), sensor, rng, 3 * PRESSES)
        # This draws one press more than it uses. The tower of the package was trained with these draws.
        some = [picture for picture, _ in zip(made, range(PRESSES), strict=False)]
        pictures += some if len(some) == PRESSES else []
        seed += 1
    return np.stack([stored(to_float(picture)) for picture in pictures])


def stored(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) in 0..1 at the size and type of the stored pictures."""
    return np.rint(255 * resize(image, (STORED_PX, STORED_PX))).astype(np.uint8)


# Batches -------------------------------------------------------------------------------------------------------


def sensor_batch(pictures: NDArray[np.uint8], rng: Rng) -> Tensor:
    """Return two presses of each of SURFACES_OF_STEP surfaces (2 SURFACES_OF_STEP, 3, TOUCH_PX, TOUCH_PX), in pairs.

    All are changed in the same way, as by another sensor: mirrored, turned, other channels, other contrast. Each press
    is also changed on its own, as on another day: other light and contrast, shift and scale, noise.

    Args:
        pictures: A file of `press_surfaces`.
        rng: The random choices.
    """
    surfaces = rng.choice(SURFACES, SURFACES_OF_STEP, replace=False)
    rows = [1 + PRESSES * surface + press for surface in surfaces for press in rng.choice(PRESSES, 2, replace=False)]
    x, frame = as_batch(pictures[rows]), as_batch(pictures[:1])
    x = frame + (x - frame) * torch.exp(normal(rng, 0.08, len(x), 1) + normal(rng, 0.04, len(x), 3))
    x = as_another_sensor(x, rng)
    scale = rng.uniform(0.78, 1.0) * np.exp(rng.normal(0, 0.04, len(x)))
    x = sample(
        x, rng.normal(0, 0.08, len(x)), scale, rng.uniform(-1, 1, (len(x), 2)) * np.maximum(1 - scale, 0.03)[:, None]
    )
    side = TOUCH_PX // 4
    coarse = functional.interpolate(normal(rng, 1.0, len(x), 3, side, side), size=TOUCH_PX, mode="bilinear")
    x = in_other_light(x, rng) + float(rng.uniform(0, 0.012)) * coarse
    return (x + float(rng.uniform(0, 0.02)) * normal(rng, 1.0, *x.shape)).clamp(0, 1)


def as_another_sensor(x: Tensor, rng: Rng) -> Tensor:
    """Return images with other channels, mirrored or turned, or in grey, and with another contrast and brightness."""
    likely = rng.random(5) < (0.5, 0.5, 0.5, 0.5, 0.15)
    if likely[0]:
        x = x[:, rng.permutation(3).tolist()]
    if likely[1]:
        x = x.flip(2)
    if likely[2]:
        x = x.flip(3)
    if likely[3]:
        x = x.transpose(2, 3)
    if likely[4]:
        x = x.mean(1, keepdim=True).expand(-1, 3, -1, -1)
    middle = x.mean((0, 2, 3), keepdim=True)
    return (x - middle) * math.exp(rng.normal(0, 0.2)) + middle + rng.normal(0, 0.06)


def labelled_batch(images: NDArray[np.uint8], rng: Rng) -> Tensor:
    """Return labelled presses (n, 3, TOUCH_PX, TOUCH_PX), slightly changed; some are flipped top to bottom."""
    count = len(images)
    flips = np.where(rng.random(count) < 0.5, -1.0, 1.0)
    x = sample(
        as_batch(images), rng.normal(0, 0.08, count), rng.uniform(0.85, 1.05, count), np.zeros((count, 2)), flips
    )
    return (in_other_light(x, rng) + normal(rng, 0.01, *x.shape)).clamp(0, 1)


def in_other_light(x: Tensor, rng: Rng) -> Tensor:
    """Return images (n, 3, H, W), each with another brightness that changes linearly over the image."""
    count, across = len(x), torch.linspace(-1, 1, x.shape[3])
    slopes = normal(rng, 0.008, count, 3) * across + normal(rng, 0.008, count, 3) * across[:, None]
    gain = 1 + normal(rng, 0.03, count, 1) + normal(rng, 0.015, count, 3)
    return x * gain + slopes + normal(rng, 0.012, count, 3) + normal(rng, 0.015, count, 1)


def sample(
    x: Tensor,
    turn_rad: NDArray[np.float64],
    scale: NDArray[np.float64],
    shift: NDArray[np.float64],
    flips: NDArray[np.float64] | float = 1.0,
) -> Tensor:
    """Return images (n, 3, TOUCH_PX, TOUCH_PX) of x (n, 3, H, W), each turned, scaled, shifted and flipped."""
    maps = np.zeros((len(x), 2, 3), np.float32)
    maps[:, 0, 0], maps[:, 0, 1] = scale * np.cos(turn_rad), -scale * np.sin(turn_rad) * flips
    maps[:, 1, 0], maps[:, 1, 1] = scale * np.sin(turn_rad), scale * np.cos(turn_rad) * flips
    maps[:, :, 2] = shift
    return sample_affine(x, torch.from_numpy(maps), TOUCH_PX, TOUCH_PX)


def as_batch(images: NDArray[np.uint8]) -> Tensor:
    """Return images (n, H, W, 3) as (n, 3, H, W) in 0..1."""
    return torch.from_numpy(np.array(images)).permute(0, 3, 1, 2).float() / 255


def normal(rng: Rng, deviation: float, *shape: int) -> Tensor:
    """Draw normal numbers of a shape, with axes of length 1 for missing image axes."""
    full = shape if len(shape) == 4 else (*shape, 1, 1)
    return torch.from_numpy(rng.standard_normal(full, dtype=np.float32)) * deviation


# Training ------------------------------------------------------------------------------------------------------


class GelTowerTraining(Dataset[Batch]):
    """The tower in training, the frozen ImageNet tower, the heads, and the pictures. As a data set: the batches."""

    def __init__(self, files: Sequence[Path], labelled: list[LabelledPicture], init: str) -> None:
        """Load the pictures and make the towers.

        Args:
            files: Files of `press_surfaces`.
            labelled: Labelled presses.
            init: Initial weights.
        """
        self.sensors = [np.load(file, mmap_mode="r", allow_pickle=False) for file in files]
        self.labelled, self.device = labelled, default_device()
        self.published, tower = (build_tower("mobilenet_v2", "stages").to(self.device).eval() for _ in range(2))
        for each in (self.published, tower):
            each.initialise(init)
        torch.manual_seed(0)
        self.tower, self.projection = tower, nn.Linear(tower.feature_count, EMBEDDING)
        self.head = LabelHead(tower.feature_count, [picture.labels for picture in labelled])
        self.modules = nn.ModuleDict({"tower": tower, "projection": self.projection, "head": self.head}).to(self.device)
        layers = list(tower.features)  # type: ignore[arg-type]
        early, late = nn.ModuleList(layers[:EARLY_LAYERS]), nn.ModuleList(layers[EARLY_LAYERS:])
        heads = nn.ModuleList([self.projection, self.head])
        groups = ((early, EARLY_RATE), (late, 1.0), (heads, HEAD_RATE))
        parameters: list[dict[str, Any]] = [{"params": list(part.parameters()), RATE: rate} for part, rate in groups]
        self.optimizer = torch.optim.AdamW(parameters, weight_decay=WEIGHT_DECAY)
        self.optimizer.register_step_pre_hook(lambda *_: self._clip_gradients())

    def run(self, out: Path, steps: int) -> None:
        """Train to the last step, and write the tower in float16 to `out`."""
        identity = {"steps": steps, "sensors": len(self.sensors), "labelled": len(self.labelled)}
        state = StateFile(state_path(out), identity)
        train_loop(
            self.modules,
            self.optimizer,
            Plan(steps, LEARNING_RATE, "warmup", SAVE_EVERY),
            lambda left: DataLoader(self, batch_size=None, sampler=left, num_workers=WORKERS),
            lambda _, batch: self.loss(batch),
            title="train",
            state=state,
        )
        weights = self.tower.half().state_dict()
        write_tensors(out, weights, {"tower": "mobilenet_v2", "tower_output": "stages", **identity})
        write_atomically(out.with_suffix(".md"), self.card(steps).encode())
        state.path.unlink()

    def _clip_gradients(self) -> None:
        nn.utils.clip_grad_norm_(self.tower.parameters(), 5.0)

    def card(self, steps: int) -> str:
        """Return the text that describes the tower."""
        lines = (
            *card_header("MIT", library_name=LIBRARY, datasets=["simulated-presses"]),
            "# gel-tower.safetensors",
            "",
            "Touch tower for real gels. Tower `mobilenet_v2`, output `stages`, from ImageNet weights.",
            "",
            f"* Trained on: presses of {SURFACES} random surfaces into each of {len(self.sensors)} sensors, and",
            f"  {len(self.labelled)} simulated presses with labels of relief and shape; no real image",
            f"* Steps: {steps}",
            "* Made by: `python -m models.gel_tower`",
        )
        return "\n".join((*lines, ""))

    def __getitem__(self, step: int) -> Batch:
        """Return the images of a step, sensor by sensor and then labelled, and the labelled pictures."""
        rng = np.random.default_rng([0, 7, step])
        chosen = rng.choice(len(self.sensors), SENSORS_OF_STEP, replace=False)
        parts = [sensor_batch(self.sensors[number], rng) for number in chosen]
        pictures = [self.labelled[row] for row in rng.choice(len(self.labelled), LABELLED_OF_STEP, replace=False)]
        parts.append(labelled_batch(np.stack([stored(read_rgb(picture.file)) for picture in pictures]), rng))
        return torch.cat(parts).contiguous(memory_format=torch.channels_last), pictures

    def loss(self, batch: Batch) -> Tensor:
        """Return the loss (scalar) of a batch."""
        images, pictures = batch[0].to(self.device), batch[1]
        self.modules.train()
        freeze_batch_norm(self.tower)
        features = encode(self.tower, images)
        with torch.no_grad():
            published = encode(self.published, images)
        pressed = slice(len(images) - len(pictures))
        parts = zip(features[pressed].chunk(SENSORS_OF_STEP), published[pressed].chunk(SENSORS_OF_STEP), strict=True)
        losses = [self.contrast(each) + DISTIL_WEIGHT * distance(each, other) for each, other in parts]
        labels = self.head.loss(features[-len(pictures) :], [picture.labels for picture in pictures])
        return torch.stack(losses).mean() + LABEL_WEIGHT * labels

    def contrast(self, features: Tensor) -> Tensor:
        """Return the loss (scalar) of finding the other press of each surface among the presses of one sensor.

        Presses are compared by standardised features, as they are and projected.

        Args:
            features: (n, F), in pairs.
        """
        scaled = (features - features.mean(0)) / deviation(features.detach())
        pairs = torch.arange(len(features), device=features.device).view(-1, 2).flip(1).flatten()
        itself = torch.eye(len(features), dtype=torch.bool, device=features.device)
        losses = []
        for codes in (scaled, self.projection(scaled)):
            unit = functional.normalize(codes, dim=1)
            logits = (unit @ unit.T / TEMPERATURE).masked_fill(itself, -1e4)
            losses.append(functional.cross_entropy(logits, pairs))
        return torch.stack(losses).mean()


def distance(features: Tensor, published: Tensor) -> Tensor:
    """Return the mean distance (scalar, Huber's) of features (n, F) from ImageNet's, in their standard deviations.

    Both are centred over the presses of one sensor: the features of all its presses may move together.
    """
    moved = (features - features.mean(0)) - (published - published.mean(0))
    return functional.huber_loss(moved / deviation(published), torch.zeros_like(moved))


def deviation(features: Tensor) -> Tensor:
    """Return the standard deviation (F,) of each feature (n, F), at least the first quartile of all."""
    each: Tensor = features.std(0)
    return each.clamp(min=each.quantile(0.25))


def encode(tower: Tower, images: Tensor) -> Tensor:
    """Return features (n, F) in float32 of images (n, 3, H, W)."""
    with autocast(images.device, "auto"):
        features: Tensor = tower.encode_unchecked(images)
    return features.float()


if __name__ == "__main__":
    sys.exit(main())
