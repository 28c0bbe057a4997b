"""Embeddings for candidate search that foretell the match logit: small networks on halves, taught by the classifier.

An embedding trained by a contrastive loss orders photos in its own way, and the photo that the classifier would rank
first lies deep in that order. The networks here are taught the classifier's own order, as students are
(`retrieval.distil`), and read halves, so that an index can be given new embeddings without looking at a photo again.
"""

from torch import Tensor, nn
from torch.nn import functional


class Pruner(nn.Module):
    """One network with one hidden layer for each modality; the inner product of their outputs orders photos."""

    def __init__(self, hidden: int, width: int, embedding_dim: int) -> None:
        super().__init__()
        self._touch, self._photo = (_student(hidden, width, embedding_dim) for _ in range(2))

    def touch(self, half: Tensor) -> Tensor:
        """Embeddings (B, embedding_dim) of norm 1 of touch halves (B, hidden)."""
        return functional.normalize(self._touch(half), dim=-1, eps=1e-6)

    def photo(self, half: Tensor) -> Tensor:
        """Embeddings (B, embedding_dim) of norm 1 of photo halves (B, hidden)."""
        return functional.normalize(self._photo(half), dim=-1, eps=1e-6)


def _student(hidden: int, width: int, embedding_dim: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(hidden, width), nn.ReLU(), nn.Linear(width, embedding_dim))
