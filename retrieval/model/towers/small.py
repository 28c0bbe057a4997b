"""A tower for tests, the demo and two CPU cores: four strided convolutions with group normalisation.

Group normalisation makes every image's output independent of the rest of its batch, in training too.
"""

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from retrieval.model.towers.tower import Tower, stage_statistics, without_autocast

_WIDTHS = (24, 48, 96, 128)
_FLOAT32_LAYERS = 3
"""The first convolution, its norm and its ReLU."""


class GroupNorm(nn.GroupNorm):
    """Group normalisation in the weights' float32, even if convolutions multiply in bfloat16.

    With channels last, PyTorch's bfloat16 version is so slow on a CPU that a step takes 1.4 times as long.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Return normalised maps (B, C, H, W) in the type of the weights."""
        with without_autocast(x):
            return super().forward(x.to(self.weight.dtype))


class SmallTower(Tower):
    """Four 3 x 3 convolutions of stride 2 (the first 5 x 5), then mean and maximum over the last map.

    256 features, or 888 for the output "stages".
    """

    cell_channels = _WIDTHS[-1]
    optional_prefixes = ("fc.",)

    def __init__(self, output: str) -> None:
        super().__init__(output)
        layers: list[nn.Module] = []
        inputs = 3
        for stage, width in enumerate(_WIDTHS):
            kernel = 5 if stage == 0 else 3
            layers += [
                nn.Conv2d(inputs, width, kernel, stride=2, padding=kernel // 2, bias=False),
                GroupNorm(8, width),
                nn.ReLU(inplace=True),
            ]
            inputs = width
        self.stages = nn.Sequential(*layers)
        self.fc = nn.Linear(2 * inputs, 1000) if output == "classes" else None
        self.feature_count = {"classes": 1000, "pooled": 2 * inputs, "stages": 3 * sum(_WIDTHS)}[output]

    def _encode(self, images: Tensor) -> Tensor:
        maps = list(self._maps(images))
        if self.output == "stages":
            return stage_statistics(maps)
        x = maps[-1].flatten(2)
        x = torch.cat([x.mean(2), x.amax(2)], dim=1)
        return x if self.fc is None else self.fc(x)

    def _encode_with_map(self, images: Tensor) -> tuple[Tensor, Tensor]:
        maps = list(self._maps(images))
        return stage_statistics(maps), maps[-1]

    def _maps(self, images: Tensor) -> Iterator[Tensor]:
        """Yield the map of each stage."""
        with without_autocast(images):
            x = self.stages[:_FLOAT32_LAYERS](images)
        yield x
        for layer in list(self.stages)[_FLOAT32_LAYERS:]:
            x = layer(x)
            if isinstance(layer, nn.ReLU):
                yield x
