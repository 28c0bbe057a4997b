"""Listwise losses: each touch picks the photos of its object out of all photos of a batch, each photo its touches."""

import torch
from torch import Tensor
from torch.nn import functional

from retrieval.model.losses.loss import EncodedBatch, Loss


class ContrastiveLoss(Loss):
    """`contrastive_loss` of the embeddings of a batch. Its learned scale belongs to the matcher and its checkpoints."""

    def forward(self, batch: EncodedBatch) -> Tensor:
        """Return the loss (scalar) of a batch."""
        objects = batch.touch_objects, batch.photo_objects
        return contrastive_loss(batch.touch.embedding, batch.photo.embedding, *objects, batch.matcher.log_scale)


class ListwiseLoss(Loss):
    """`listwise_loss` of the match logits of every touch of a batch with every photo of it."""

    has_cells = True

    def forward(self, batch: EncodedBatch) -> Tensor:
        """Return the loss (scalar) of a batch."""
        width = None if self.has_cells else batch.matcher.config.pooled_width
        logits = batch.matcher.head.all_logits(batch.touch.partial[:, :width], batch.photo.partial[:, :width])
        return listwise_loss(logits, batch.touch_objects, batch.photo_objects)


class PooledListwiseLoss(ListwiseLoss):
    """`listwise_loss` of the match logits without late interaction.

    Candidates are found by the pooled logit, and an index without cells ranks by it. Without this loss the cells learn
    to explain everything, and the pooled logit becomes useless.
    """

    has_cells = False


def contrastive_loss(
    touch: Tensor, photo: Tensor, touch_objects: Tensor, photo_objects: Tensor, log_scale: Tensor
) -> Tensor:
    """Return the symmetric cross-entropy between unit embeddings of touches and of photos (InfoNCE).

    Each touch must pick each photo of its own object out of that photo and the photos of OTHER objects (Khosla et al.,
    NeurIPS 2020, eq. 2, with the other positives removed from the denominator). The loss is averaged over a touch's
    photos, then over the touches that have a photo of their own object and one of another; a direction without such
    touches contributes zero. The other direction does the same for each photo among the touches.

    Args:
        touch: (T, d) unit embeddings.
        photo: (N, d) unit embeddings.
        touch_objects: (T,) integer labels.
        photo_objects: (N,) integer labels.
        log_scale: Scores are exp(log_scale) times the cosines.
    """
    scores = log_scale.float().exp() * touch.float() @ photo.float().T
    return listwise_loss(scores, touch_objects, photo_objects)


def listwise_loss(scores: Tensor, touch_objects: Tensor, photo_objects: Tensor) -> Tensor:
    """Return `contrastive_loss` of any scores (T, N) of touches with photos, such as match logits."""
    same = touch_objects[:, None] == photo_objects[None, :]
    return (pick_loss(scores.float(), same) + pick_loss(scores.float().T, same.T)) / 2


def pick_loss(scores: Tensor, same: Tensor) -> Tensor:
    """Return the mean over rows of a row's mean of -log softmax(positive among itself and the negatives)."""
    negatives = torch.logsumexp(scores.masked_fill(same, -torch.inf), dim=1, keepdim=True)
    # log(1 + exp(negatives - positive)) without overflow, for every cell; cells of negatives have weight 0.
    losses = functional.softplus(negatives - scores)
    usable = same & torch.isfinite(negatives)
    per_row = torch.where(usable, losses, 0.0).sum(1) / usable.sum(1).clamp(min=1)
    rows = usable.any(1)
    return per_row.sum() / rows.sum().clamp(min=1)
