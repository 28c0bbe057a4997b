"""Listwise loss: each touch picks the photos of its object out of all photos of a batch, each photo its touches."""

import torch
from torch import Tensor
from torch.nn import functional

from retrieval.model.losses.loss import EncodedBatch, Loss


class ListwiseLoss(Loss):
    """`listwise_loss` of the match logits of every touch of a batch with every photo of it."""

    def forward(self, batch: EncodedBatch) -> Tensor:
        """Return the loss (scalar) of a batch."""
        logits = batch.matcher.head.all_logits(batch.touch.partial, batch.photo.partial)
        return listwise_loss(logits, batch.touch_objects, batch.photo_objects)


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
