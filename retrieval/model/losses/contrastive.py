"""InfoNCE with several positives, between embeddings of touches and of photos."""

import math

from torch import Tensor

from retrieval.model.losses.listwise import listwise_loss
from retrieval.model.losses.loss import EncodedBatch, Loss

LOG_SCALE_INIT = math.log(1 / 0.07)
LOG_SCALE_MAX = math.log(100.0)


class ContrastiveLoss(Loss):
    """`contrastive_loss` of the embeddings of a batch. Its learned scale belongs to the matcher and its checkpoints."""

    def forward(self, batch: EncodedBatch) -> Tensor:
        """Return the loss (scalar) of a batch."""
        objects = batch.touch_objects, batch.photo_objects
        return contrastive_loss(batch.touch.embedding, batch.photo.embedding, *objects, batch.matcher.log_scale)


def contrastive_loss(
    touch: Tensor, photo: Tensor, touch_objects: Tensor, photo_objects: Tensor, log_scale: Tensor
) -> Tensor:
    """Return the symmetric cross-entropy between unit embeddings of touches and of photos (InfoNCE).

    Each touch must pick each photo of its own object out of that photo and the photos of OTHER objects: photos of the
    same object are never negatives of each other (InfoNCE with several positives: Khosla et al., NeurIPS 2020, eq. 2,
    with the other positives removed from the denominator). The loss is averaged over a touch's photos, then over the
    touches that have a photo of their own object and one of another. The other direction does the same for each photo
    among the touches, and the result is the mean of the two. A direction without such rows contributes zero.

    Args:
        touch: (T, d) unit embeddings.
        photo: (N, d) unit embeddings.
        touch_objects: (T,) integer labels.
        photo_objects: (N,) integer labels.
        log_scale: Scores are exp(log_scale) times the cosines.
    """
    scores = log_scale.float().exp() * touch.float() @ photo.float().T
    return listwise_loss(scores, touch_objects, photo_objects)
