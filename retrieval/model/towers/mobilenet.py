"""MobileNetV2, width 1.0 (Sandler et al., CVPR 2018), with the key names of torchvision's checkpoints."""

import re
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from retrieval.errors import ConfigError
from retrieval.model.towers.tower import Tower, stage_statistics, without_autocast

# Expansion, output channels, blocks, first stride: table 2 of the paper.
_STAGES = (
    (1, 16, 1, 1),
    (6, 24, 2, 2),
    (6, 32, 3, 2),
    (6, 64, 4, 2),
    (6, 96, 3, 1),
    (6, 160, 3, 2),
    (6, 320, 1, 1),
)
_FLOAT32_LAYERS = 3
"""Layers up to stride 4, computed in float32."""
_STEM_LAYERS = 7
"""Layers up to the first of the stages."""


class _StridedDepthwise(nn.Conv2d):
    """A strided depthwise convolution in float32: on a CPU its gradient takes ten times as long in bfloat16."""

    def _conv_forward(self, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        with without_autocast(x):
            convolved: Tensor = super()._conv_forward(x.to(weight.dtype), weight, bias)
            return convolved


class _Layers(nn.Sequential):
    """Layers in order; in training a convolution takes over a frozen batch normalisation, which would take as long."""

    def forward(self, x: Tensor) -> Tensor:
        layers = list(self)
        while layers:
            layer, *layers = layers
            if isinstance(layer, nn.Conv2d) and layers and _is_frozen(layers[0]):
                x, layers = _convolve_and_normalise(x, layer, layers[0]), layers[1:]
            else:
                x = layer(x)
        return x


def _is_frozen(layer: nn.Module) -> bool:
    """Whether a layer is a batch normalisation that keeps its statistics in training."""
    return isinstance(layer, nn.BatchNorm2d) and not layer.training and torch.is_grad_enabled()


def _convolve_and_normalise(x: Tensor, convolution: nn.Conv2d, normalisation: Any) -> Tensor:
    """Return the normalised convolution; PyTorch's own fusion returns weights without gradients."""
    scale = normalisation.weight * torch.rsqrt(normalisation.running_var + normalisation.eps)
    bias = normalisation.bias - normalisation.running_mean * scale
    convolved: Tensor = convolution._conv_forward(x, convolution.weight * scale[:, None, None, None], bias)
    return convolved


def _convolution(inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> nn.Sequential:
    kind = _StridedDepthwise if stride > 1 and groups > 1 else nn.Conv2d
    return _Layers(
        kind(inputs, outputs, kernel, stride, padding=kernel // 2, groups=groups, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU6(inplace=True),
    )


class InvertedResidual(nn.Module):
    """1 x 1 expansion, 3 x 3 depthwise, linear 1 x 1 projection; a shortcut if the shapes are equal."""

    def __init__(self, inputs: int, outputs: int, stride: int, expansion: int) -> None:
        super().__init__()
        hidden = inputs * expansion
        layers: list[nn.Module] = [] if expansion == 1 else [_convolution(inputs, hidden, 1)]
        layers += [
            _convolution(hidden, hidden, 3, stride, groups=hidden),
            nn.Conv2d(hidden, outputs, 1, bias=False),
            nn.BatchNorm2d(outputs),
        ]
        self.conv = _Layers(*layers)
        self.has_shortcut = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        """Return the block's output (B, outputs, H', W') of maps (B, inputs, H, W)."""
        y: Tensor = self.conv(x)
        return x + y if self.has_shortcut else y


class MobileNetV2(Tower):
    """Nineteen convolutional features, global average, and the 1000-way layer for the output "classes".

    1280 pooled features, 1536 of stages; 3,504,872 parameters with the 1000-way layer.
    """

    cell_channels = 64 + 96
    stages: ClassVar[Mapping[int, int]] = {6: 32, 10: 64, 13: 96, 17: 320}
    """Channels of the stages by their last layer; at strides 8, 16, 16 and 32."""
    optional_prefixes: ClassVar[tuple[str, ...]] = ("classifier.", "features.18.")
    url = "https://download.pytorch.org/models/mobilenet_v2-b0353104.pth"

    def __init__(self, output: str) -> None:
        super().__init__(output)
        layers: list[nn.Module] = [_convolution(3, 32, 3, stride=2)]
        inputs = 32
        for expansion, outputs, blocks, first_stride in _STAGES:
            for block in range(blocks):
                layers.append(InvertedResidual(inputs, outputs, first_stride if block == 0 else 1, expansion))
                inputs = outputs
        if output == "stages":
            layers = layers[: max(self.stages) + 1]
            self.feature_count = 3 * sum(self.stages.values())
        else:
            layers.append(_convolution(inputs, 1280, 1))
            self.feature_count = 1000 if output == "classes" else 1280
        self.features = nn.Sequential(*layers)
        self.classifier = nn.Sequential(nn.Dropout(0.2), nn.Linear(1280, 1000)) if output == "classes" else None
        # He initialisation by fan-out for convolutions, N(0, 0.01) for the classifier, as for the published weights.
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out")
            elif isinstance(module, nn.Linear):
                nn.init.normal_(module.weight, std=0.01)
                nn.init.zeros_(module.bias)

    def _encode(self, images: Tensor) -> Tensor:
        if self.output == "stages":
            return stage_statistics(self._stages(images))
        x = self.features[_FLOAT32_LAYERS:](self._first(images))
        x = nn.functional.adaptive_avg_pool2d(x, 1).flatten(1)
        return x if self.classifier is None else self.classifier(x)

    def _encode_with_map(self, images: Tensor) -> tuple[Tensor, Tensor]:
        maps = list(self._stages(images))
        return stage_statistics(maps), torch.cat(maps[1:3], dim=1)  # cells: the two stages at stride 16

    def _first(self, images: Tensor) -> Tensor:
        with without_autocast(images):
            first: Tensor = self.features[:_FLOAT32_LAYERS](images)
            return first

    def stem_layers(self) -> nn.Module:
        """Return the layers up to the first stage, at stride 8.

        Raises:
            ConfigError: The output is not "stages".
        """
        return self.features[:_STEM_LAYERS] if self.output == "stages" else super().stem_layers()

    def _stages(self, images: Tensor) -> Iterator[Tensor]:
        """Yield the outputs of the stages."""
        x = self._first(images)
        for number, layer in enumerate(list(self.features)[_FLOAT32_LAYERS:], start=_FLOAT32_LAYERS):
            x = layer(x)
            if number in self.stages:
                yield x

    @staticmethod
    def rename_state(state: dict[str, Tensor]) -> dict[str, Tensor]:
        """Map the flat key layout of early checkpoints (`features.1.conv.3.weight`) to the current nested one."""
        if "features.2.conv.0.0.weight" in state or "features.2.conv.0.weight" not in state:
            return state
        renamed = {}
        for key, value in state.items():
            if match := re.fullmatch(r"features\.(\d+)\.conv\.(\d+)\.(\w+)", key):
                block, layer, name = int(match[1]), int(match[2]), match[3]
                key = f"features.{block}.conv.{(_NESTED_FIRST if block == 1 else _NESTED)[layer]}.{name}"
            renamed[key] = value
        return renamed


class MobileNetV2Stride16(MobileNetV2):
    """MobileNetV2 up to stride 16, with the output "stages" only: 576 features, 0.54 million parameters.

    In the towers that ship, the layers beyond gave the same features for every image.
    """

    stages: ClassVar[Mapping[int, int]] = {6: 32, 10: 64, 13: 96}
    optional_prefixes: ClassVar[tuple[str, ...]] = ("classifier.", *(f"features.{layer}." for layer in range(14, 19)))

    def __init__(self, output: str) -> None:
        if output != "stages":
            raise ConfigError(f'the tower mobilenet_v2_stride16 has only the tower_output "stages"; got {output!r}')
        super().__init__(output)


# A flat block lists conv, bn, relu of the expansion (absent in the first block) and the depthwise step, then conv, bn.
_NESTED = {0: "0.0", 1: "0.1", 3: "1.0", 4: "1.1", 6: "2", 7: "3"}
_NESTED_FIRST = {0: "0.0", 1: "0.1", 3: "1", 4: "2"}
