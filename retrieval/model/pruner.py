"""Embeddings for candidate search that foretell the match logit: small networks on halves, taught by the classifier.

An embedding trained by a contrastive loss orders photos in its own way, and the photo that the classifier would rank
first lies deep in that order. The networks here are taught the classifier's own order, as students are
(`retrieval.training.distil`), and read halves, so that an index can be given new embeddings without looking at a photo
again. Where the cosine of the contrastive embeddings is part of the logit, some of the numbers are linear in these:
their principal axes, which hold nearly all of that cosine, so that the networks have the rest alone to learn.
"""

from typing import NamedTuple, Self

import torch
from torch import Tensor, nn
from torch.nn import functional


class Pruner(nn.Module):
    """One network with one hidden layer for each modality, and linear numbers beside what it puts out; the inner
    product of both orders photos."""

    def __init__(self, half: int, width: int, embedding_dim: int, linear: int = 0) -> None:
        """linear: of the `embedding_dim` numbers, so many are linear in the last `embedding_dim` numbers of a half,
        which then hold the contrastive embedding."""
        super().__init__()
        self._touch, self._photo = (
            nn.Sequential(nn.Linear(half, width), nn.ReLU(), nn.Linear(width, embedding_dim - linear)) for _ in range(2)
        )
        self._touch_axes, self._photo_axes = (nn.Linear(embedding_dim, linear) if linear else None for _ in range(2))

    def touch(self, half: Tensor) -> Tensor:
        """Embeddings (B, embedding_dim) of norm 1 of touch halves (B, half)."""
        return functional.normalize(_side_by_side(self._touch, self._touch_axes, half), dim=-1, eps=1e-6)

    def photo(self, half: Tensor) -> Tensor:
        """Embeddings (B, embedding_dim) of norm 1 of photo halves (B, half)."""
        return functional.normalize(_side_by_side(self._photo, self._photo_axes, half), dim=-1, eps=1e-6)

    def scores(self, touch_halves: Tensor, photo_halves: Tensor) -> Tensor:
        """(T, N) scores in the classifier's unit, log-odds up to a constant of each touch: what is taught.

        A touch's length is its own sharpness and moves no photo past another, so embeddings need not keep it.
        """
        return _side_by_side(self._touch, self._touch_axes, touch_halves) @ self.photo(photo_halves).T

    @torch.no_grad()
    def absorb(self, touch: "Spread", photo: "Spread") -> None:
        """Change the first layers to read halves as they are, where so far they read them centred and scaled."""
        for student, axes, spread in (
            (self._touch, self._touch_axes, touch),
            (self._photo, self._photo_axes, photo),
        ):
            for first in (student[0], axes):
                if isinstance(first, nn.Linear):
                    first.weight.div_(spread.scale[-first.in_features :])
                    first.bias.sub_(first.weight @ spread.mean[-first.in_features :])

    @torch.no_grad()
    def begin_with_axes(self, halves: Tensor, touch: "Spread", photo: "Spread") -> None:
        """Let the linear numbers be the principal axes of the contrastive embeddings at the end of photo halves
        (N, half), for a pruner that reads halves centred and scaled; nothing where it has none."""
        if self._touch_axes is None or self._photo_axes is None:
            return
        linear, dim = self._photo_axes.weight.shape
        embeddings = halves[:, -dim:]
        axes = torch.linalg.eigh(embeddings.double().T.cov()).eigenvectors[:, -linear:].T.to(halves.dtype)
        length = (embeddings @ axes.T).norm(dim=1).mean().clamp(min=1e-6)
        for layer, spread, size in ((self._touch_axes, touch, length), (self._photo_axes, photo, 1 / length)):
            layer.weight.copy_(size * spread.scale[-dim:] * axes)
            layer.bias.copy_(size * axes @ spread.mean[-dim:])


class Spread(NamedTuple):
    """Mean (half,) of halves, and (half,) the standard deviation of all units of the share or embedding each is of."""

    mean: Tensor
    scale: Tensor

    @classmethod
    def of(cls, halves: Tensor, embedding_dim: int = 0) -> Self:
        """The spread of halves (N, half), of which the last `embedding_dim` numbers are an embedding; what does not
        vary is not scaled up."""
        end = halves.shape[1] - embedding_dim
        parts = [part for part in (halves[:, :end], halves[:, end:]) if part.shape[1]]
        scale = torch.cat([part.std(correction=0).expand(part.shape[1]) for part in parts])
        return cls(halves.mean(0), scale.where(scale > 1e-6, 1.0))

    def __call__(self, halves: Tensor) -> Tensor:
        """Centred and scaled halves: what a network learns from at its ordinary learning rate."""
        return (halves - self.mean) / self.scale


def _side_by_side(student: nn.Module, axes: nn.Linear | None, half: Tensor) -> Tensor:
    """What a network makes of halves and what is linear in their embeddings, in one array (B, embedding_dim)."""
    made: Tensor = student(half)
    return made if axes is None else torch.cat([made, axes(half[..., -axes.in_features :])], dim=-1)
