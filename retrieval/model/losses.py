"""Losses on logits and unit embeddings, in float32 whatever comes in."""

import math

import torch
from torch import Tensor
from torch.nn import functional

LOG_SCALE_INIT = math.log(1 / 0.07)
LOG_SCALE_MAX = math.log(100.0)
# Where the sigmoid loss starts: with most pairs negative, a bias of 0 would begin far from their log-odds.
SIGMOID_LOG_SCALE_INIT, SIGMOID_BIAS_INIT = math.log(10.0), -10.0


def match_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """Mean binary cross-entropy of match logits (P,) against labels (P,) of 0 and 1: the paper's loss.

    Computed from logits; `log(sigmoid(z))` is -inf below z = -104 in float32, and its gradient NaN.
    """
    return functional.binary_cross_entropy_with_logits(logits.float(), labels.float())


def contrastive_loss(
    touch: Tensor, photo: Tensor, touch_objects: Tensor, photo_objects: Tensor, log_scale: Tensor
) -> Tensor:
    """Symmetric cross-entropy between unit embeddings of touches (T, d) and photos (N, d); scores are exp(log_scale)
    times their cosines. `*_objects` are integer labels (T,), (N,).

    Each touch must pick each photo of its own object out of that photo and the photos of OTHER objects: photos of the
    same object are never negatives of each other (InfoNCE with several positives: Khosla et al., NeurIPS 2020, eq. 2,
    with the other positives taken out of the denominator). Mean over a touch's photos, then over the touches that have
    a photo of their own object and one of another. The same is asked of each photo among the touches, and the loss is
    the mean of the two; a way in which nobody has both adds zero.
    """
    scores = log_scale.float().exp() * touch.float() @ photo.float().T
    return listwise_loss(scores, touch_objects, photo_objects)


def listwise_loss(scores: Tensor, touch_objects: Tensor, photo_objects: Tensor) -> Tensor:
    """The same for any scores (T, N) of touches with photos, such as match logits: it asks for order alone."""
    same = touch_objects[:, None] == photo_objects[None, :]
    return (_pick_loss(scores.float(), same) + _pick_loss(scores.float().T, same.T)) / 2


def _pick_loss(scores: Tensor, same: Tensor) -> Tensor:
    """Mean over rows of the mean over a row's positives of -log softmax(positive among itself and the negatives)."""
    negatives = torch.logsumexp(scores.masked_fill(same, -torch.inf), dim=1, keepdim=True)
    # log(1 + exp(negatives - positive)) without overflow, for every cell; cells that are no positives weigh nothing.
    losses = functional.softplus(negatives - scores)
    usable = same & torch.isfinite(negatives)
    per_row = torch.where(usable, losses, 0.0).sum(1) / usable.sum(1).clamp(min=1)
    rows = usable.any(1)
    return per_row.sum() / rows.sum().clamp(min=1)


def sigmoid_loss(
    touch: Tensor, photo: Tensor, touch_objects: Tensor, photo_objects: Tensor, log_scale: Tensor, bias: Tensor
) -> Tensor:
    """Binary cross-entropy of every touch with every photo, summed over the photos of a touch, mean over touches.

    Zhai et al., ICCV 2023 (SigLIP), eq. in section 3.2, with logits `exp(log_scale) * cosine + bias`, and every photo
    of the touch's object a positive. touch (T, d) and photo (N, d) are unit embeddings, `*_objects` integer labels.
    """
    logits = log_scale.float().exp() * touch.float() @ photo.float().T + bias.float()
    same = touch_objects[:, None] == photo_objects[None, :]
    # softplus(-z) is -log sigmoid(z) without overflow.
    return functional.softplus(torch.where(same, -logits, logits)).sum(1).mean()
