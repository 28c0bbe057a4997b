"""Training of parts of a model that find the same in images of any camera and sensor as the start model in the rig's.

Each object has images of the rig, whose partial activations by the start model are the reference, and images by other
cameras and sensors. The head of the start model stays as it is: its towers, or the cells of the late interaction, learn
to give it what it knows from the rig (knowledge distillation, Hinton et al., 2015). Labels alone would let them learn
the training objects by heart.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from retrieval.data.pairs import PairBatch
from retrieval.training.initial_weights import TOWER_WEIGHTS
from retrieval.training.trainer import Trainer

CELLS = ("touch_cells", "photo_cells")
"""Names of the networks of the late interaction in a matcher."""

LABEL_SHARE = 0.5
"""Share of the true object in the target of a touch; the rest is what the start model finds in the rig's images."""
ANCHOR_WEIGHT = 0.5
"""Weight of the distance from the reference."""

References = Mapping[str | Path, Tensor]
"""Partial activations of the rig's images by the start model, by grasp id of a touch and by file of a photo: for any
image of an object that of the rig."""


class InvariantTrainer(Trainer):
    """A trainer of some parts of a matcher, towards `references`."""

    def __init__(
        self, *arguments: Any, parts: tuple[str, ...] = TOWER_WEIGHTS, references: References, **options: Any
    ) -> None:
        """Prepare a run like `Trainer`.

        parts: prefixes of the names of the trained weights, TOWER_WEIGHTS or CELLS. references: of all training images.
        """
        super().__init__(*arguments, **options)
        self.references = references
        self.matcher.eval()  # neither dropout nor batch statistics
        for name, weight in self.matcher.named_parameters():
            if not name.startswith(parts):
                weight.requires_grad_(False)

    def feature_loss(self, batch: PairBatch, touch: Tensor, photo: Tensor) -> Tensor:
        """Return the loss of a batch: cross-entropies of touches and of photos, and distances from the references."""
        encoded = self.matcher.touch_encoding(touch).partial, self.matcher.photo_encoding(photo).partial
        keys: tuple[Iterable[str | Path], ...] = [grasp.grasp_id for grasp in batch.grasps], batch.photos
        expected = tuple(torch.stack([self.references[key] for key in part]).to(touch.device) for part in keys)
        logits, known = (self.matcher.head.all_logits(*part) for part in (encoded, expected))
        touched, shown = map(torch.from_numpy, (batch.touch_objects, batch.photo_objects))
        labels = (touched[:, None] == shown).to(logits)  # its type and device
        loss = _cross_entropy(logits, known, labels) + _cross_entropy(logits.T, known.T, labels.T)
        width = self.matcher.config.pooled_width
        for ours, reference in zip(encoded, expected, strict=True):
            distance = (ours - reference)[:, :width].square().mean(0) / reference[:, :width].var(0)
            loss = loss + ANCHOR_WEIGHT * distance.mean()
        return loss


def _cross_entropy(logits: Tensor, known: Tensor, labels: Tensor) -> Tensor:
    """Return the cross-entropy of logits (A, B) with the targets of each row: its own columns, and known logits."""
    targets = LABEL_SHARE * labels / labels.sum(1, keepdim=True) + (1 - LABEL_SHARE) * known.softmax(1)
    return functional.cross_entropy(logits, targets)
