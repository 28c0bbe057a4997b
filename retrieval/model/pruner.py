"""Embeddings for candidate search that foretell the match logit: small networks on halves, taught by the classifier.

An embedding trained by a contrastive loss orders photos in its own way, and the photo that the classifier would rank
first lies deep in that order. The networks here are taught the classifier's own order, as students are
(`retrieval.training.distil`), and read halves, so that an index can be given new embeddings without looking at a photo
again.
"""

from typing import NamedTuple, Self

import torch
from torch import Tensor, nn
from torch.nn import functional


class Pruner(nn.Module):
    """One network with one hidden layer for each modality; the inner product of their outputs orders photos."""

    def __init__(self, half: int, width: int, embedding_dim: int) -> None:
        super().__init__()
        self._touch, self._photo = (_student(half, width, embedding_dim) for _ in range(2))

    def touch(self, half: Tensor) -> Tensor:
        """Embeddings (B, embedding_dim) of norm 1 of touch halves (B, half)."""
        return functional.normalize(self._touch(half), dim=-1, eps=1e-6)

    def photo(self, half: Tensor) -> Tensor:
        """Embeddings (B, embedding_dim) of norm 1 of photo halves (B, half)."""
        return functional.normalize(self._photo(half), dim=-1, eps=1e-6)

    def scores(self, touch_halves: Tensor, photo_halves: Tensor) -> Tensor:
        """(T, N) scores in the classifier's unit, log-odds up to a constant of each touch: what is taught.

        A touch's length is its own sharpness and moves no photo past another, so embeddings need not keep it.
        """
        touches: Tensor = self._touch(touch_halves)
        return touches @ self.photo(photo_halves).T

    @torch.no_grad()
    def absorb(self, touch: "Spread", photo: "Spread") -> None:
        """Change the first layers to read halves as they are, where so far they read them centred and scaled."""
        for student, spread in ((self._touch, touch), (self._photo, photo)):
            first = student[0]
            assert isinstance(first, nn.Linear)
            first.weight.div_(spread.scale)
            first.bias.sub_(first.weight @ spread.mean)


class Spread(NamedTuple):
    """Mean (half,) of halves, and one standard deviation for all their units."""

    mean: Tensor
    scale: Tensor

    @classmethod
    def of(cls, halves: Tensor) -> Self:
        """Of halves (N, half); halves that do not vary are not scaled up."""
        scale = halves.std(correction=0)
        return cls(halves.mean(0), scale.where(scale > 1e-6, 1.0))

    def __call__(self, halves: Tensor) -> Tensor:
        """Centred and scaled halves: what a network learns from at its ordinary learning rate."""
        return (halves - self.mean) / self.scale


def _student(half: int, width: int, embedding_dim: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(half, width), nn.ReLU(), nn.Linear(width, embedding_dim))
