"""What a loss of training is given, and what it returns."""

from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor, nn

if TYPE_CHECKING:
    from retrieval.model.fusion import ImageEncoding, Matcher


class EncodedBatch(NamedTuple):
    """The distinct touches (T) and photos (N) of a batch.

    matcher: the model in training, for its head. touch, photo: `half` (T or N, half), `embedding` (T or N,
    embedding_dim) of norm 1. touch_objects (T,), photo_objects (N,): their objects as integers from 0, the same in
    every batch.
    """

    matcher: "Matcher"
    touch: "ImageEncoding"
    photo: "ImageEncoding"
    touch_objects: Tensor
    photo_objects: Tensor


class Loss(nn.Module):
    """A term of the training loss, with parameters of its own where it has any.

    The optimiser trains its parameters together with the matcher's, and the state of an unfinished training keeps them;
    a checkpoint does not. A subclass writes `forward`.

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
        """Make the loss of a training.

        Args:
            embedding_dim: Length of an embedding.
            objects: How many objects are trained on.
        """
        super().__init__()

    def forward(self, batch: EncodedBatch) -> Tensor:
        """Return the loss (scalar, float32) of a batch."""
        raise NotImplementedError

    def clamp(self) -> None:
        """Hold parameters within their range, after each step."""
