"""Prediction of the relief and the shape of an object from the features of a tower."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from models.pictures import FAMILIES, SIZES, ObjectLabels

SMOOTHING, DROPOUT = 0.05, 0.2


class LabelHead(nn.Module):
    """Predicts the families and sizes of an object (`ObjectLabels`) from features of its images.

    Attributes:
        families: Names of the families, for each of `FAMILIES`.
    """

    def __init__(self, features: int, labels: Sequence[ObjectLabels]) -> None:
        """Make a head whose predictions start at zero.

        Args:
            features: Length of a feature vector.
            labels: Labels of the training objects.
        """
        super().__init__()
        self.families = [sorted({each.families[index] for each in labels}) for index in range(len(FAMILIES))]
        sizes = np.array([each.size_targets for each in labels if not each.is_smooth])
        self.register_buffer("mean", torch.from_numpy(sizes.mean(0)).float(), persistent=False)
        self.register_buffer("deviation", torch.from_numpy(sizes.std(0) + 1e-6).float(), persistent=False)
        last = nn.Linear(features, sum(map(len, self.families)) + len(SIZES))
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(nn.BatchNorm1d(features, affine=False), nn.Dropout(DROPOUT), last)

    def forward(self, features: Tensor) -> tuple[Tensor, ...]:
        """Return logits (B, kinds) of each of FAMILIES, then standardised SIZES (B, 4), of features (B, F)."""
        outputs: Tensor = self.layers(features.float())
        return torch.split(outputs, [*map(len, self.families), len(SIZES)], dim=1)

    def loss(self, features: Tensor, labels: Sequence[ObjectLabels]) -> Tensor:
        """Return the loss (scalar) of features (B, F) of objects: cross-entropies, and squared errors of the sizes.

        The sizes of smooth objects have no meaning and are left out.
        """
        *families, sizes = self(features)
        has_relief = torch.tensor([not each.is_smooth for each in labels], device=sizes.device)
        targets = torch.tensor([each.size_targets for each in labels], device=sizes.device)
        targets = (targets - self.get_buffer("mean")) / self.get_buffer("deviation")
        loss: Tensor = ((sizes - targets).square().mean(1) * has_relief).mean()
        for index, (names, logits) in enumerate(zip(self.families, families, strict=True)):
            rows = torch.tensor([names.index(each.families[index]) for each in labels], device=logits.device)
            loss = loss + functional.cross_entropy(logits, rows, label_smoothing=SMOOTHING)
        return loss
