"""The two terms of the training loss, on logits and in float32."""

import math

import torch
from torch import Tensor
from torch.nn import functional

LOG_SCALE_INIT = math.log(1 / 0.07)
LOG_SCALE_MAX = math.log(100.0)


def match_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """Mean binary cross-entropy of match logits (P,) against labels (P,) of 0 and 1: the paper's loss.

    Computed from logits; `log(sigmoid(z))` is -inf below z = -104 in float32, and its gradient NaN.
    """
    return functional.binary_cross_entropy_with_logits(logits.float(), labels.float())


def contrastive_loss(
    touch: Tensor, photo: Tensor, touch_objects: Tensor, photo_objects: Tensor, log_scale: Tensor
) -> Tensor:
    """Symmetric cross-entropy between unit embeddings of touches (T, d) and photos (N, d).

    Each touch must pick each photo of its own object out of the photos of OTHER objects: photos of the same object
    are never negatives of each other, and so the other way round (InfoNCE with several positives: Khosla et al.,
    NeurIPS 2020, eq. 2, with the positives taken out of the denominator). `*_objects` are integer labels (T,), (N,).
    Zero where no touch has both a positive and a negative.
    """
    scores = log_scale.float().exp() * touch.float() @ photo.float().T
    same = touch_objects[:, None] == photo_objects[None, :]
    return (_pick_loss(scores, same) + _pick_loss(scores.T, same.T)) / 2


def _pick_loss(scores: Tensor, same: Tensor) -> Tensor:
    """Mean over rows of the mean over a row's positives of -log softmax(positive among itself and the negatives)."""
    negatives = torch.logsumexp(scores.masked_fill(same, -torch.inf), dim=1, keepdim=True)
    # log(1 + exp(negatives - positive)) without overflow, for every cell; cells that are no positives weigh nothing.
    losses = functional.softplus(negatives - scores)
    usable = same & torch.isfinite(negatives)
    per_row = torch.where(usable, losses, 0.0).sum(1) / usable.sum(1).clamp(min=1)
    rows = usable.any(1)
    return per_row.sum() / rows.sum().clamp(min=1)
