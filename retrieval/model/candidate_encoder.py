"""Candidate encoder: embeddings for candidate search that predict the order of the match logits.

A contrastive embedding orders photos differently from the fusion head. The two small networks here are distilled from
the head (`retrieval.training.distil`) and read partial activations. With `candidate_linear`, some output components are
linear in the contrastive embeddings. They start as principal axes, which carry nearly all of the logit's cosine, and
are trained too.
"""

from typing import NamedTuple, Self

import torch
from torch import Tensor, nn
from torch.nn import functional


class CandidateEncoder(nn.Module):
    """For each modality, a network with one hidden layer, and optional linear components appended.

    The inner product of a touch's and a photo's output orders the photos.
    """

    def __init__(self, partial: int, width: int, embedding_dim: int, linear: int = 0) -> None:
        """Make the networks, `width` hidden units each, with random weights.

        They read pooled partial activations (without cells). `linear` components of an embedding are linear in the last
        `embedding_dim` numbers of these, which must then be the contrastive embedding.
        """
        super().__init__()
        self.touch_network, self.photo_network = (
            nn.Sequential(nn.Linear(partial, width), nn.ReLU(), nn.Linear(width, embedding_dim - linear))
            for _ in range(2)
        )
        self.touch_linear, self.photo_linear = (nn.Linear(embedding_dim, linear) if linear else None for _ in range(2))

    def touch(self, partial: Tensor) -> Tensor:
        """Return unit embeddings (B, embedding_dim) of touch partial activations (B, partial)."""
        return functional.normalize(_concatenated(self.touch_network, self.touch_linear, partial), dim=-1, eps=1e-6)

    def photo(self, partial: Tensor) -> Tensor:
        """Return unit embeddings (B, embedding_dim) of photo partial activations (B, partial)."""
        return functional.normalize(_concatenated(self.photo_network, self.photo_linear, partial), dim=-1, eps=1e-6)

    def scores(self, touch_partials: Tensor, photo_partials: Tensor) -> Tensor:
        """Return scores (T, N), trained to equal the match logits up to a constant per touch.

        The norm of a touch's output is its sharpness. It does not reorder photos, so embeddings drop it.
        """
        return _concatenated(self.touch_network, self.touch_linear, touch_partials) @ self.photo(photo_partials).T

    @torch.no_grad()
    def fold_statistics(self, touch: "PartialStatistics", photo: "PartialStatistics") -> None:
        """Fold the standardisation of the inputs into the first layers, which then read raw partial activations."""
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
        """Set the linear components, if there are any, to the principal axes of the contrastive embeddings.

        The networks must still read standardised partial activations. `partials` (N, partial) of photos end with their
        contrastive embeddings.
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
    """Mean (partial,) of each unit, and one standard deviation for the head's term and one for the embedding."""

    mean: Tensor
    scale: Tensor

    @classmethod
    def of(cls, partials: Tensor, embedding_dim: int) -> Self:
        """Return the statistics of (N, partial), whose rows end with an embedding; a constant part has scale 1."""
        end = partials.shape[1] - embedding_dim
        parts = [part for part in (partials[:, :end], partials[:, end:]) if part.shape[1]]
        scale = torch.cat([part.std(correction=0).expand(part.shape[1]) for part in parts])
        return cls(partials.mean(0), scale.where(scale > 1e-6, 1.0))

    def __call__(self, partials: Tensor) -> Tensor:
        """Return centred and scaled partial activations."""
        return (partials - self.mean) / self.scale


def _concatenated(network: nn.Module, axes: nn.Linear | None, partial: Tensor) -> Tensor:
    """Concatenate a network's output and the linear components to (B, embedding_dim)."""
    output: Tensor = network(partial)
    return output if axes is None else torch.cat([output, axes(partial[..., -axes.in_features :])], dim=-1)
