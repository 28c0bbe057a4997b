"""Late interaction: cells of the gel images against cells of a photo (Khattab and Zaharia, SIGIR 2020, eq. 3).

A tower divides an image into a grid of cells (`Tower.divide`). A small network maps each cell to a vector, given its
place in the grid and the features of the whole image. Each cell of a touch adds its largest inner product with a cell
of the photo to the score. Vectors of photo cells have unit length; the length of a touch cell's vector is its learned
weight, so that cells without contact count little.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

CELL_HIDDEN = 256
"""Hidden units of the network of a cell."""
WEIGHT_INIT = 0.25
"""Approximate initial weight of a touch cell. 32 cells then add at most about 8 to the logit."""


class CellEncoder(nn.Module):
    """Maps the cells of an image of one modality to vectors."""

    def __init__(self, cells: int, channels: int, features: int, dim: int, norm: nn.Module, *, weighted: bool) -> None:
        """Make the network for `cells` cells of `channels` to vectors of length `dim`, with random weights.

        features: number of features of the whole image. norm: standardises cells (B, channels). weighted: the length
        of a vector is a learned weight; otherwise it is 1.
        """
        super().__init__()
        self.norm, self.weighted = norm, weighted
        self.cell = nn.Linear(channels, CELL_HIDDEN)
        self.context = nn.Linear(features, CELL_HIDDEN, bias=False)
        self.place = nn.Parameter(torch.zeros(cells, CELL_HIDDEN))
        self.output = nn.Linear(CELL_HIDDEN, dim + int(weighted))

    def forward(self, cells: Tensor, features: Tensor) -> Tensor:
        """Return vectors (B, N, dim) of the cells (B * N * channels, in any shape) of images with `features` (B, F)."""
        hidden = self.cell(self.norm(cells.reshape(-1, self.cell.in_features))).reshape(-1, *self.place.shape)
        hidden = hidden + self.context(features.reshape(-1, self.context.in_features))[:, None] + self.place
        output: Tensor = self.output(functional.relu(hidden))
        if not self.weighted:
            return functional.normalize(output.float(), dim=-1, eps=1e-6)
        weight = functional.softplus(output[..., -1:].float()) * (WEIGHT_INIT / 0.693)  # softplus(0) = 0.693
        return weight * functional.normalize(output[..., :-1].float(), dim=-1, eps=1e-6)


def cell_scores(touch_cells: Tensor, photo_cells: Tensor) -> Tensor:
    """Return scores (T, N) of every touch with every photo, from the vectors (T, Q, d) and (N, P, d) of their cells."""
    touches, each, _ = touch_cells.shape
    photos, places, _ = photo_cells.shape
    products = photo_cells.flatten(0, 1) @ touch_cells.flatten(0, 1).T
    best = products.view(photos, places, touches * each).max(dim=1).values  # `amax` has a slower gradient
    return best.view(photos, touches, each).float().sum(dim=2).T


def paired_cell_scores(touch_cells: Tensor, photo_cells: Tensor) -> Tensor:
    """Return scores (...) of pairs of vectors (..., Q, d) and (..., P, d), whose leading axes broadcast."""
    return (touch_cells @ photo_cells.transpose(-1, -2)).max(dim=-1).values.float().sum(dim=-1)
