"""The loss of every touch with every photo as a pair of its own."""

import math

import torch
from torch import Tensor
from torch.nn import functional

# Where it starts: with most pairs negative, a bias of 0 would begin far from their log-odds.
SIGMOID_LOG_SCALE_INIT, SIGMOID_BIAS_INIT = math.log(10.0), -10.0


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
