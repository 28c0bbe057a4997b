"""Pretraining of one tower on relief: it predicts an object's labels from single pictures, without touch-photo pairs.

A photographed object takes a tenth of the time of a grasped one, and a photo tower is limited mainly by the number of
objects. The tower learns the families of relief and shape, and the pitch, amplitude, aspect and sharpness of a relief.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from models.labels import LabelHead
from models.pictures import FAMILIES, LabelledPicture
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import to_float
from retrieval.model.checkpoint import write_tensors
from retrieval.model.config import Config
from retrieval.model.encode import autocast, default_device, to_batch
from retrieval.model.towers.tower import build_tower
from retrieval.training.augmentation import augment, sample_grid
from retrieval.training.loop import RATE, Plan, StateFile, freeze_batch_norm, state_path, train_loop

BATCH, LEARNING_RATE, WEIGHT_DECAY, SAVE_EVERY = 32, 4e-4, 0.03, 200
WORKERS = 2
"""Processes that decode pictures."""
HEAD_RATE = 5.0
"""Ratio of the head's learning rate to the tower's, since the head starts at zero."""
VALIDATION, MAX_VALIDATION_OBJECTS = 0.05, 400
BACKGROUNDS = ("none", "difference+0.5")
"""Background policies of training touches, drawn at random, so that the weights suit matchers of both policies."""
VISIBLE = 0.8
"""Fraction of a photo's side that a training step uses; a gel image is used whole."""


def pretrain(kind: str, pictures: Sequence[LabelledPicture], out: Path, config: Config, steps: int) -> str:
    """Train a tower of `config` on pictures, write its weights to `out`, and return a line on its accuracy.

    Photos are used as in the views "zoom" and "grey", touches with and without background subtraction. Ctrl-C saves a
    state, from which the next call continues.

    Args:
        kind: "photo" or "touch".
        pictures: Labelled pictures of this kind.
        out: File of the weights (.safetensors).
        config: The configuration; `config.training.init` are the initial weights.
        steps: Number of steps.

    Raises:
        JobInterrupted: After Ctrl-C.
    """
    training = ReliefTraining(kind, pictures, config)
    state = StateFile(state_path(out), {"config": config.to_dict(), "steps": steps, "pictures": len(pictures)})
    train_loop(
        training.modules,
        training.optimizer,
        Plan(steps, LEARNING_RATE, "cosine", SAVE_EVERY),
        lambda left: DataLoader(training, batch_size=None, sampler=left, num_workers=WORKERS),
        training.loss,
        title=f"pretrain {kind} tower",
        state=state,
    )
    accuracies = training.accuracies()
    about = {"tower": config.matcher.tower, "tower_output": config.matcher.tower_output}
    write_tensors(out, training.tower.state_dict(), about | {"kind": kind, "steps": steps, "accuracies": accuracies})
    state.path.unlink()
    return f"{kind} tower on held-out objects: " + ", ".join(
        f"{name} {value:.3f}" for name, value in accuracies.items()
    )


class ReliefTraining(Dataset[tuple[list[int], Tensor]]):
    """A tower and a head that predicts labels from its features. As a data set: the batch of each step."""

    def __init__(self, kind: str, pictures: Sequence[LabelledPicture], config: Config) -> None:
        self.kind, self.config, self.device = kind, config, default_device()
        seed, matcher = config.training.seed, config.matcher
        objects = sorted({picture.object_id for picture in pictures})
        held_out = max(1, min(round(VALIDATION * len(objects)), MAX_VALIDATION_OBJECTS))
        names = set(np.random.default_rng([seed, 1]).permutation(objects)[:held_out].tolist())
        self.pictures = [picture for picture in pictures if picture.object_id not in names]
        self.validation = [picture for picture in pictures if picture.object_id in names]
        torch.manual_seed(seed)
        self.tower = build_tower(matcher.tower, matcher.tower_output)
        self.tower.initialise(config.training.init)
        self.head = LabelHead(self.tower.feature_count, [picture.labels for picture in self.pictures])
        self.modules = nn.ModuleDict({"tower": self.tower, "head": self.head}).to(self.device)
        groups: list[dict[str, Any]] = [
            {"params": self.tower.parameters()},
            {"params": self.head.parameters(), RATE: HEAD_RATE},
        ]
        self.optimizer = torch.optim.AdamW(groups, weight_decay=WEIGHT_DECAY)

    def __getitem__(self, step: int) -> tuple[list[int], Tensor]:
        """Return rows of `pictures` and their augmented images (B, 3, H, W)."""
        rng = np.random.default_rng([self.config.training.seed, 2, step])
        rows = rng.integers(len(self.pictures), size=BATCH).tolist()
        images = to_batch([self._image(self.pictures[row], rng) for row in rows])
        return rows, augment(images, self.kind, rng, visible=VISIBLE if self.kind == "photo" else 1.0)

    def _image(self, picture: LabelledPicture, rng: np.random.Generator | None = None) -> NDArray[np.float32]:
        """Return a picture as the tower sees it; `rng` draws the background policy of a touch."""
        settings = self.config.preprocessing
        if self.kind == "photo":
            image = Preprocessing(photo_px=settings.photo_px, views=("zoom",)).load_photo(picture.file)
            if rng:
                rng.integers(1)  # one variant
        else:
            policies = list(dict.fromkeys((settings.background, *BACKGROUNDS)))
            background = policies[rng.integers(len(policies)) if rng else 0]
            image = dataclasses.replace(settings, background=background).load_touch(picture.file, picture.before)
        return to_float(np.rint(255 * image).astype(np.uint8))

    def loss(self, step: int, batch: tuple[list[int], Tensor]) -> Tensor:
        """Return the loss of a step and its batch."""
        rows, images = batch
        self.modules.train()
        freeze_batch_norm(self.tower)  # a batch of 32 is too small for new statistics
        torch.manual_seed(self.config.training.seed * 1_000_003 + step)  # the dropout mask
        return self.head.loss(self._features(images), [self.pictures[row].labels for row in rows])

    def _features(self, images: Tensor) -> Tensor:
        with autocast(self.device, self.config.training.precision):
            features: Tensor = self.tower(images.to(self.device, memory_format=torch.channels_last))
        return features

    @torch.inference_mode()
    def accuracies(self) -> dict[str, float]:
        """Return the accuracy of each family on the held-out objects."""
        self.modules.eval()
        parts = [self.validation[start : start + BATCH] for start in range(0, len(self.validation), BATCH)]
        outputs = [self.head(self._features(self._middle(to_batch(list(map(self._image, part)))))) for part in parts]
        found = {}
        for index, (name, known) in enumerate(zip(FAMILIES, self.head.families, strict=True)):
            predicted = torch.cat([output[index] for output in outputs]).argmax(1).tolist()
            true = [picture.labels.families[index] for picture in self.validation]
            found[name] = float(np.mean([known[row] == each for row, each in zip(predicted, true, strict=True)]))
        return found

    def _middle(self, images: Tensor) -> Tensor:
        """Return images for evaluation: the middle of a photo in grey, or a whole gel image."""
        if self.kind == "touch":
            return images
        same = torch.tensor([[VISIBLE, 0.0, 0.0], [0.0, VISIBLE, 0.0]]).expand(len(images), 2, 3)
        middle = sample_grid(images, same, VISIBLE)
        return middle.mean(1, keepdim=True).expand_as(middle)
