"""Several backbones on one image, with concatenated features: differently pretrained ones complement each other."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from retrieval.model.towers.tower import Tower


class ConcatenatedTowers(Tower):
    """A tower of towers: all `parts` encode the same image, and their features are concatenated."""

    def __init__(self, parts: Sequence[Tower]) -> None:
        super().__init__()
        self.parts = nn.ModuleList(parts)
        self.feature_count = sum(part.feature_count for part in parts)

    def _encode(self, images: Tensor) -> Tensor:
        return torch.cat([part._encode(images) for part in self.parts], dim=1)  # type: ignore[operator]


def parts_of(tower: Tower) -> list[Tower]:
    """Return the concatenated towers, or a single tower."""
    return list(tower.parts) if isinstance(tower, ConcatenatedTowers) else [tower]  # type: ignore[arg-type]


def feature_counts_of(tower: Tower) -> list[int]:
    """Return the number of features of each concatenated tower, or of a single tower."""
    return [part.feature_count for part in parts_of(tower)]
