"""One step of training: the loss of a batch from its features, and the match logits of pairs."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retrieval.data.dataset import PairBatch
from retrieval.model.config import TrainingConfig
from retrieval.model.fusion import Matcher
from retrieval.model.losses import EncodedBatch, load_loss
from retrieval.model.losses.match import match_loss
from retrieval.training.batches import FeatureSource


def batch_loss(
    matcher: Matcher,
    settings: TrainingConfig,
    batch: PairBatch,
    touch_features: Tensor,
    photo_features: Tensor,
) -> tuple[Tensor, Tensor]:
    """Loss (scalar) and match logits (P,) of a batch from the features of its distinct touches and photos."""
    arrays = batch.touch_index, batch.photo_index, batch.labels, batch.touch_objects, batch.photo_objects
    touch_index, photo_index, labels, *objects = (torch.from_numpy(array).to(touch_features.device) for array in arrays)
    touch, photo = matcher.touch_code(touch_features), matcher.photo_code(photo_features)
    logits = matcher.head(touch.half[touch_index], photo.half[photo_index])
    loss = match_loss(logits, labels)
    for name, weight in settings.weights.items():
        if weight > 0:
            loss = loss + weight * load_loss(name)(EncodedBatch(matcher, touch, photo, *objects))
    return loss, logits


def shuffle_fingers(touch_features: Tensor, fingers: int) -> Tensor:
    """Each touch's features (B, fingers * F) with its fingers in a random order, by PyTorch's seed on the CPU."""
    each = touch_features.view(len(touch_features), fingers, -1)
    order = torch.rand(len(each), fingers).argsort(dim=1).to(each.device)
    return torch.take_along_dim(each, order[..., None], dim=1).flatten(1)


@torch.inference_mode()
def pair_logits(matcher: Matcher, pairs: PairBatch, source: FeatureSource) -> NDArray[np.float32]:
    """Match logits (P,) of pairs, in evaluation mode, each image encoded once."""
    matcher.eval()
    touch_features, photo_features = source.eval_features(matcher, pairs)
    with source.stepping():
        touch, photo = matcher.touch_code(touch_features), matcher.photo_code(photo_features)
        logits = matcher.head(touch.half[pairs.touch_index], photo.half[pairs.photo_index])
    return np.asarray(logits.cpu().numpy())
