"""ResNet-18 and -50 (He et al., CVPR 2016), with the key names of torchvision's checkpoints.

The bottleneck strides in its 3 x 3 convolution ("v1.5"), as the published ImageNet weights do.
"""

from typing import ClassVar

import torch
from torch import Tensor, nn

from retrieval.model.towers.tower import Tower, stage_statistics


class BasicBlock(nn.Module):
    """Two 3 x 3 convolutions and a shortcut."""

    expansion: ClassVar[int] = 1

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, width, 3, stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.relu = nn.ReLU(inplace=True)
        self.downsample = _shortcut(inputs, width, stride)

    def forward(self, x: Tensor) -> Tensor:
        """Return the block's output (B, C', H', W') of maps (B, C, H, W)."""
        y = self.relu(self.bn1(self.conv1(x)))
        y = self.bn2(self.conv2(y))
        shortcut = x if self.downsample is None else self.downsample(x)
        return self.relu(y + shortcut)  # type: ignore[no-any-return]


class Bottleneck(nn.Module):
    """1 x 1 reduction, 3 x 3, 1 x 1 expansion by four, and a shortcut."""

    expansion: ClassVar[int] = 4

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        outputs = width * self.expansion
        self.conv1 = nn.Conv2d(inputs, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, outputs, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(outputs)
        self.relu = nn.ReLU(inplace=True)
        self.downsample = _shortcut(inputs, outputs, stride)

    def forward(self, x: Tensor) -> Tensor:
        """Return the block's output (B, C', H', W') of maps (B, C, H, W)."""
        y = self.relu(self.bn1(self.conv1(x)))
        y = self.relu(self.bn2(self.conv2(y)))
        y = self.bn3(self.conv3(y))
        shortcut = x if self.downsample is None else self.downsample(x)
        return self.relu(y + shortcut)  # type: ignore[no-any-return]


def _shortcut(inputs: int, outputs: int, stride: int) -> nn.Sequential | None:
    if stride == 1 and inputs == outputs:
        return None
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))


class ResNet(Tower):
    """Stem, four stages, global average, and the 1000-way layer for the output "classes"."""

    optional_prefixes = ("fc.",)
    block: ClassVar[type[BasicBlock | Bottleneck]]
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
                blocks.append(self.block(inputs, width, stride))
                inputs = width * self.block.expansion
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

    block, depths = BasicBlock, (2, 2, 2, 2)
    url = "https://download.pytorch.org/models/resnet18-f37072fd.pth"


class ResNet50(ResNet):
    """ResNet-50: 2048 pooled features; 25,557,032 parameters with its 1000-way layer."""

    block, depths = Bottleneck, (3, 4, 6, 3)
    url = "https://download.pytorch.org/models/resnet50-0676ba61.pth"
