"""Sigmoid loss: every touch with every photo is a pair of its own."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from retrieval.model.losses.contrastive import LOG_SCALE_MAX
from retrieval.model.losses.loss import EncodedBatch, Loss

# Initial values: most pairs are negative, so a bias of 0 would start far from their log-odds.
SIGMOID_LOG_SCALE_INIT, SIGMOID_BIAS_INIT = math.log(10.0), -10.0


class SigmoidLoss(Loss):
    """`sigmoid_loss` of the embeddings of a batch, with its own learned scale and bias."""

    def __init__(self, embedding_dim: int, objects: int) -> None:
        super().__init__(embedding_dim, objects)
        self.log_scale = nn.Parameter(torch.tensor(SIGMOID_LOG_SCALE_INIT))
        self.bias = nn.Parameter(torch.tensor(SIGMOID_BIAS_INIT))

    def forward(self, batch: EncodedBatch) -> Tensor:
        """Return the loss (scalar) of a batch."""
        objects = batch.touch_objects, batch.photo_objects
        return sigmoid_loss(batch.touch.embedding, batch.photo.embedding, *objects, self.log_scale, self.bias)

    @torch.no_grad()
    def clamp(self) -> None:
        """Clamp the scale to at most 100."""
        self.log_scale.clamp_(0.0, LOG_SCALE_MAX)


def sigmoid_loss(
    touch: Tensor, photo: Tensor, touch_objects: Tensor, photo_objects: Tensor, log_scale: Tensor, bias: Tensor
) -> Tensor:
    """Return the binary cross-entropy of every touch with every photo, summed over photos, averaged over touches.

    Zhai et al., ICCV 2023 (SigLIP), eq. in section 3.2, with logits `exp(log_scale) * cosine + bias`, and every photo
    of the touch's object a positive.

    Args:
        touch: (T, d) unit embeddings.
        photo: (N, d) unit embeddings.
        touch_objects: (T,) integer labels.
        photo_objects: (N,) integer labels.
        log_scale: Scalar.
        bias: Scalar.
    """
    logits = log_scale.float().exp() * touch.float() @ photo.float().T + bias.float()
    same = touch_objects[:, None] == photo_objects[None, :]
    # softplus(-z) is -log sigmoid(z) without overflow.
    return functional.softplus(torch.where(same, -logits, logits)).sum(1).mean()
