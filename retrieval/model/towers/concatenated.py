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

    @property
    def widths(self) -> list[int]:
        """Number of features of each part."""
        return [part.feature_count for part in self.parts]  # type: ignore[misc]

    def _encode(self, images: Tensor) -> Tensor:
        return torch.cat([part._encode(images) for part in self.parts], dim=1)  # type: ignore[operator]


def feature_counts_of(tower: Tower) -> list[int]:
    """Return the number of features of each concatenated tower, or of a single tower."""
    return tower.widths if isinstance(tower, ConcatenatedTowers) else [tower.feature_count]
