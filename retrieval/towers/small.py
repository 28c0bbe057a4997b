"""A tower for tests, the demo and two CPU cores: four strided convolutions with group normalisation.

Group normalisation keeps every image's output independent of the rest of its batch, in training too.
"""

import torch
from torch import Tensor, nn

from retrieval.towers.base import Tower

_WIDTHS = (24, 48, 96, 128)


class Small(Tower):
    """Four 3 x 3 convolutions of stride 2 (the first 5 x 5); mean and maximum over the last map: 256 features."""

    classifier_prefix = "fc"

    def __init__(self, classes: int | None) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        inputs = 3
        for stage, width in enumerate(_WIDTHS):
            kernel = 5 if stage == 0 else 3
            layers += [
                nn.Conv2d(inputs, width, kernel, stride=2, padding=kernel // 2, bias=False),
                nn.GroupNorm(8, width),
                nn.ReLU(inplace=True),
            ]
            inputs = width
        self.stages = nn.Sequential(*layers)
        self.fc = nn.Linear(2 * inputs, classes) if classes else None
        self.feature_count = classes or 2 * inputs

    def _encode(self, images: Tensor) -> Tensor:
        x = self.stages(images).flatten(2)
        x = torch.cat([x.mean(2), x.amax(2)], dim=1)
        return x if self.fc is None else self.fc(x)


def small(classes: int | None) -> Small:
    """The small tower: 256 pooled features."""
    return Small(classes)
