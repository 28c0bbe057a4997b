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


class CandidateEncoder(nn.Module):
    """One network with one hidden layer for each modality, and linear numbers beside what it puts out; the inner
    product of both orders photos.
    """

    def __init__(self, partial: int, width: int, embedding_dim: int, linear: int = 0) -> None:
        """linear: of the `embedding_dim` numbers, so many are linear in the last `embedding_dim` numbers of a half,
        which then hold the contrastive embedding.
        """
        super().__init__()
        self.touch_network, self.photo_network = (
            nn.Sequential(nn.Linear(partial, width), nn.ReLU(), nn.Linear(width, embedding_dim - linear))
            for _ in range(2)
        )
        self.touch_linear, self.photo_linear = (nn.Linear(embedding_dim, linear) if linear else None for _ in range(2))

    def touch(self, partial: Tensor) -> Tensor:
        """Embeddings (B, embedding_dim) of norm 1 of touch halves (B, half)."""
        return functional.normalize(_concatenated(self.touch_network, self.touch_linear, partial), dim=-1, eps=1e-6)

    def photo(self, partial: Tensor) -> Tensor:
        """Embeddings (B, embedding_dim) of norm 1 of photo halves (B, half)."""
        return functional.normalize(_concatenated(self.photo_network, self.photo_linear, partial), dim=-1, eps=1e-6)

    def scores(self, touch_partials: Tensor, photo_partials: Tensor) -> Tensor:
        """(T, N) scores in the classifier's unit, log-odds up to a constant of each touch: what is taught.

        A touch's length is its own sharpness and moves no photo past another, so embeddings need not keep it.
        """
        return _concatenated(self.touch_network, self.touch_linear, touch_partials) @ self.photo(photo_partials).T

    @torch.no_grad()
    def fold_statistics(self, touch: "PartialStatistics", photo: "PartialStatistics") -> None:
        """Change the first layers to read halves as they are, where so far they read them centred and scaled."""
        for network, axes, spread in (
            (self.touch_network, self.touch_linear, touch),
            (self.photo_network, self.photo_linear, photo),
        ):
            for first in (network[0], axes):
                if isinstance(first, nn.Linear):
                    first.weight.div_(spread.scale[-first.in_features :])
                    first.bias.sub_(first.weight @ spread.mean[-first.in_features :])

    @torch.no_grad()
    def initialise_linear(self, partials: Tensor, touch: "PartialStatistics", photo: "PartialStatistics") -> None:
        """Let the linear numbers be the principal axes of the contrastive embeddings at the end of photo halves
        (N, half), for a candidate_encoder that reads halves centred and scaled; nothing where it has none.
        """
        if self.touch_linear is None or self.photo_linear is None:
            return
        linear, dim = self.photo_linear.weight.shape
        embeddings = partials[:, -dim:]
        axes = torch.linalg.eigh(embeddings.double().T.cov()).eigenvectors[:, -linear:].T.to(partials.dtype)
        length = (embeddings @ axes.T).norm(dim=1).mean().clamp(min=1e-6)
        for layer, spread, size in ((self.touch_linear, touch, length), (self.photo_linear, photo, 1 / length)):
            layer.weight.copy_(size * spread.scale[-dim:] * axes)
            layer.bias.copy_(size * axes @ spread.mean[-dim:])


class PartialStatistics(NamedTuple):
    """Mean (half,) of halves, and (half,) the standard deviation of all units of the share or embedding each is of."""

    mean: Tensor
    scale: Tensor

    @classmethod
    def of(cls, partials: Tensor, embedding_dim: int = 0) -> Self:
        """The spread of halves (N, half), of which the last `embedding_dim` numbers are an embedding; what does not
        vary is not scaled up.
        """
        end = partials.shape[1] - embedding_dim
        parts = [part for part in (partials[:, :end], partials[:, end:]) if part.shape[1]]
        scale = torch.cat([part.std(correction=0).expand(part.shape[1]) for part in parts])
        return cls(partials.mean(0), scale.where(scale > 1e-6, 1.0))

    def __call__(self, partials: Tensor) -> Tensor:
        """Centred and scaled halves: what a network learns from at its ordinary learning rate."""
        return (partials - self.mean) / self.scale


def _concatenated(network: nn.Module, axes: nn.Linear | None, partial: Tensor) -> Tensor:
    """What a network makes of halves and what is linear in their embeddings, in one array (B, embedding_dim)."""
    made: Tensor = network(partial)
    return made if axes is None else torch.cat([made, axes(partial[..., -axes.in_features :])], dim=-1)
