"""Several backbones that look at one image, their features side by side: what one was taught, the other may lack."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from retrieval.model.towers.tower import Tower


class ConcatenatedTowers(Tower):
    """A tower of towers. `parts` see the image alike; a feature vector is theirs, one after the other."""

    def __init__(self, parts: Sequence[Tower]) -> None:
        super().__init__()
        self.parts = nn.ModuleList(parts)
        self.feature_count = sum(part.feature_count for part in parts)

    @property
    def widths(self) -> list[int]:
        """How many features each part gives."""
        return [part.feature_count for part in self.parts]  # type: ignore[misc]

    def _encode(self, images: Tensor) -> Tensor:
        return torch.cat([part._encode(images) for part in self.parts], dim=1)  # type: ignore[operator]


def feature_counts_of(tower: Tower) -> list[int]:
    """How many features each of the towers that stand side by side gives, or the one."""
    return tower.widths if isinstance(tower, ConcatenatedTowers) else [tower.feature_count]
