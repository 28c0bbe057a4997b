"""ResNet-18 and -50 (He et al., CVPR 2016), with the key names of torchvision's checkpoints.

The bottleneck strides in its 3 x 3 convolution ("v1.5"), as the published ImageNet weights do.
"""

from typing import ClassVar

import torch
from torch import Tensor, nn

from retrieval.model.towers.tower import Tower, stage_statistics

BOTTLENECK_EXPANSION = 4


class Block(nn.Module):
    """Convolutions and a shortcut: 3 x 3 twice, or as a bottleneck 1 x 1, 3 x 3, 1 x 1 with four times the outputs."""

    def __init__(self, inputs: int, width: int, stride: int, *, is_bottleneck: bool) -> None:
        super().__init__()
        outputs = BOTTLENECK_EXPANSION * width if is_bottleneck else width
        kernels, counts = ((1, 3, 1), (width, width, outputs)) if is_bottleneck else ((3, 3), (width, outputs))
        strided, self.depth, channels = kernels.index(3), len(kernels), inputs
        for place, (kernel, count) in enumerate(zip(kernels, counts, strict=True)):
            convolution = nn.Conv2d(
                channels, count, kernel, stride if place == strided else 1, padding=kernel // 2, bias=False
            )
            self.add_module(f"conv{place + 1}", convolution)
            self.add_module(f"bn{place + 1}", nn.BatchNorm2d(count))
            channels = count
        self.relu = nn.ReLU(inplace=True)
        self.downsample = None
        if stride > 1 or inputs != outputs:
            shortcut = nn.Conv2d(inputs, outputs, 1, stride, bias=False)
            self.downsample = nn.Sequential(shortcut, nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Return the block's output (B, C', H', W') of maps (B, C, H, W)."""
        y = x
        for place in range(1, self.depth + 1):
            y = self.get_submodule(f"bn{place}")(self.get_submodule(f"conv{place}")(y))
            y = self.relu(y) if place < self.depth else y
        return self.relu(y + (x if self.downsample is None else self.downsample(x)))  # type: ignore[no-any-return]


class ResNet(Tower):
    """Stem, four stages, global average, and the 1000-way layer for the output "classes"."""

    optional_prefixes = ("fc.",)
    is_bottleneck: ClassVar[bool]
    depths: ClassVar[tuple[int, ...]]
    """Blocks of each stage."""

    def __init__(self, output: str) -> None:
        super().__init__(output)
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        inputs = 64
        for stage, depth in enumerate(self.depths):
            width = 64 * 2**stage
            strides = [1 if stage == 0 else 2] + [1] * (depth - 1)
            blocks: list[nn.Module] = []
            for stride in strides:
                blocks.append(Block(inputs, width, stride, is_bottleneck=self.is_bottleneck))
                inputs = BOTTLENECK_EXPANSION * width if self.is_bottleneck else width
            self.add_module(f"layer{stage + 1}", nn.Sequential(*blocks))
        self.fc = nn.Linear(inputs, 1000) if output == "classes" else None
        # Stages 2 to 4, at strides 8, 16 and 32; each has twice the channels of the previous one.
        counts = {"classes": 1000, "pooled": inputs, "stages": 3 * (inputs + inputs // 2 + inputs // 4)}
        self.feature_count = counts[output]
        # He initialisation by fan-out, as for the published weights; the linear layer keeps PyTorch's default.
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def _encode(self, images: Tensor) -> Tensor:
        x = self.maxpool(self.relu(self.bn1(self.conv1(images))))
        maps = []
        for stage in range(1, 5):
            x = self.get_submodule(f"layer{stage}")(x)
            maps.append(x)
        if self.output == "stages":
            return stage_statistics(maps[1:])
        x = torch.flatten(nn.functional.adaptive_avg_pool2d(x, 1), 1)
        return x if self.fc is None else self.fc(x)


class ResNet18(ResNet):
    """ResNet-18: 512 pooled features."""

    is_bottleneck, depths = False, (2, 2, 2, 2)
    url = "https://download.pytorch.org/models/resnet18-f37072fd.pth"


class ResNet50(ResNet):
    """ResNet-50: 2048 pooled features; 25,557,032 parameters with its 1000-way layer."""

    is_bottleneck, depths = True, (3, 4, 6, 3)
    url = "https://download.pytorch.org/models/resnet50-0676ba61.pth"
