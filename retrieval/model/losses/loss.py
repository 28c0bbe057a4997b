"""Contract of a training loss, and the paper's loss of pairs."""

from typing import NamedTuple

from torch import Tensor, nn
from torch.nn import functional

from retrieval.model.fusion import ImageEncoding, Matcher


class EncodedBatch(NamedTuple):
    """The distinct touches (T) and photos (N) of a batch.

    Attributes:
        matcher: The model in training, for its head.
        touch: `partial` (T, partial) and unit `embedding` (T, embedding_dim) of the touches.
        photo: The same for the photos, with N rows.
        touch_objects: (T,) objects as integers from 0, the same in every batch.
        photo_objects: (N,) objects of the photos.
    """

    matcher: Matcher
    touch: ImageEncoding
    photo: ImageEncoding
    touch_objects: Tensor
    photo_objects: Tensor


class Loss(nn.Module):
    """A term of the training loss, possibly with parameters of its own.

    The optimiser trains its parameters together with the matcher's. The state of an unfinished training run stores
    them; a checkpoint does not. A subclass implements `forward`.

    >>> import torch
    >>> class Proxies(retrieval.Loss):
    ...     def __init__(self, embedding_dim, objects):
    ...         super().__init__(embedding_dim, objects)
    ...         self.proxies = torch.nn.Embedding(objects, embedding_dim)
    ...     def forward(self, batch):
    ...         embeddings = torch.cat([batch.touch.embedding, batch.photo.embedding])
    ...         objects = torch.cat([batch.touch_objects, batch.photo_objects])
    ...         return torch.nn.functional.cross_entropy(embeddings @ self.proxies.weight.T, objects)
    >>> sum(parameter.numel() for parameter in Proxies(embedding_dim=8, objects=3).parameters())
    24
    """

    def __init__(self, embedding_dim: int, objects: int) -> None:
        """Make the loss for a training run with embeddings of this length and this number of training objects."""
        super().__init__()

    def forward(self, batch: EncodedBatch) -> Tensor:
        """Return the loss (scalar, float32) of a batch."""
        raise NotImplementedError


def match_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """Return the mean binary cross-entropy of match logits (P,) against labels (P,) of 0 and 1.

    This is the paper's loss, which every training run includes. It is computed from logits: `log(sigmoid(z))` is -inf
    below z = -104 in float32, and its gradient NaN.
    """
    return functional.binary_cross_entropy_with_logits(logits.float(), labels.float())
