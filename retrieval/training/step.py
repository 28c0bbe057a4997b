"""One step of training: the loss of a batch from its features, and the match logits of pairs."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retrieval.data.dataset import PairBatch
from retrieval.model.config import TrainingConfig
from retrieval.model.fusion import Matcher
from retrieval.model.losses import contrastive_loss, listwise_loss, match_loss
from retrieval.training.batches import FeatureSource


def batch_loss(
    matcher: Matcher,
    settings: TrainingConfig,
    batch: PairBatch,
    touch_features: Tensor,
    photo_features: Tensor,
) -> tuple[Tensor, Tensor]:
    """Loss (scalar) and match logits (P,) of a batch from the features of its distinct touches and photos."""
    device = touch_features.device
    touch, photo = matcher.touch_code(touch_features), matcher.photo_code(photo_features)
    touch_index, photo_index = _on(device, batch.touch_index), _on(device, batch.photo_index)
    logits = matcher.head(touch.half[touch_index], photo.half[photo_index])
    loss = match_loss(logits, _on(device, batch.labels))
    objects = _on(device, batch.touch_objects), _on(device, batch.photo_objects)
    if settings.contrastive_weight > 0:
        apart = contrastive_loss(touch.embedding, photo.embedding, *objects, matcher.log_scale)
        loss = loss + settings.contrastive_weight * apart
    if settings.listwise_weight > 0:
        every = matcher.head(touch.half[:, None], photo.half[None])
        loss = loss + settings.listwise_weight * listwise_loss(every, *objects)
    return loss, logits


def shuffle_fingers(touch_features: Tensor, fingers: int) -> Tensor:
    """Each touch's features (B, fingers * F) with its fingers in a random order, by PyTorch's seed on the CPU."""
    each = touch_features.view(len(touch_features), fingers, -1)
    order = torch.rand(len(each), fingers).argsort(dim=1).to(each.device)
    return torch.take_along_dim(each, order[..., None], dim=1).flatten(1)


def _on(device: torch.device, array: Any) -> Tensor:
    return torch.from_numpy(array).to(device)


@torch.inference_mode()
def pair_logits(matcher: Matcher, pairs: PairBatch, source: FeatureSource) -> NDArray[np.float32]:
    """Match logits (P,) of pairs, in evaluation mode, each image encoded once."""
    matcher.eval()
    touch_features, photo_features = source.eval_features(matcher, pairs)
    with source.stepping():
        touch, photo = matcher.touch_code(touch_features), matcher.photo_code(photo_features)
        logits = matcher.head(touch.half[pairs.touch_index], photo.half[pairs.photo_index])
    return np.asarray(logits.cpu().numpy())
