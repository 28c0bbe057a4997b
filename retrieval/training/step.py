"""One step of training: the loss of a batch from its features, and the match logits of pairs."""

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retrieval.data.pairs import PairBatch
from retrieval.model.fusion import Matcher
from retrieval.model.losses import LOSSES
from retrieval.model.losses.loss import EncodedBatch, Loss
from retrieval.model.losses.match import match_loss
from retrieval.training.batches import FeatureSource


class WeightedLosses(nn.Module):
    """The losses of a training run whose weight is above 0, with their own parameters."""

    def __init__(self, weights: Mapping[str, float], matcher: Matcher, objects: int) -> None:
        """Create the losses with a weight above 0.

        Args:
            weights: Weight of each loss by name.
            matcher: The model that they train.
            objects: Number of training objects.

        Raises:
            ConfigError: A name is unknown.
        """
        super().__init__()
        self.weights = {name: weight for name, weight in weights.items() if weight > 0}
        dim = matcher.config.embedding_dim
        self.terms = nn.ModuleList(LOSSES.load(name)(dim, objects) for name in self.weights)

    def forward(self, batch: EncodedBatch) -> list[Tensor]:
        """Return the weighted losses (scalars) of a batch."""
        return [weight * term(batch) for weight, term in zip(self.weights.values(), self.terms, strict=True)]

    def clamp(self) -> None:
        """Clamp the losses' parameters to their ranges."""
        for term in self.terms:
            if isinstance(term, Loss):
                term.clamp()


def batch_loss(
    matcher: Matcher,
    losses: WeightedLosses,
    batch: PairBatch,
    touch_features: Tensor,
    photo_features: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return loss (scalar) and match logits (P,) of a batch, from features of its distinct touches and photos."""
    arrays = batch.touch_index, batch.photo_index, batch.labels, batch.touch_objects, batch.photo_objects
    touch_index, photo_index, labels, *objects = (torch.from_numpy(array).to(touch_features.device) for array in arrays)
    touch, photo = matcher.touch_encoding(touch_features), matcher.photo_encoding(photo_features)
    logits = matcher.head(touch.partial[touch_index], photo.partial[photo_index])
    loss = match_loss(logits, labels)
    for term in losses(EncodedBatch(matcher, touch, photo, *objects)):
        loss = loss + term
    return loss, logits


def shuffle_fingers(touch_features: Tensor, fingers: int) -> Tensor:
    """Return features (B, fingers * F) with the fingers of each touch permuted, drawn by PyTorch's CPU generator."""
    each = touch_features.view(len(touch_features), fingers, -1)
    order = torch.rand(len(each), fingers).argsort(dim=1).to(each.device)
    return torch.take_along_dim(each, order[..., None], dim=1).flatten(1)


@torch.inference_mode()
def pair_logits(matcher: Matcher, pairs: PairBatch, source: FeatureSource) -> NDArray[np.float32]:
    """Return match logits (P,) of pairs in evaluation mode; each image is encoded once."""
    matcher.eval()
    touch_features, photo_features = source.eval_features(matcher, pairs)
    with source.step_context():
        touch, photo = matcher.touch_encoding(touch_features), matcher.photo_encoding(photo_features)
        logits = matcher.head(touch.partial[pairs.touch_index], photo.partial[pairs.photo_index])
    return np.asarray(logits.cpu().numpy())
