"""InfoNCE with several positives, between embeddings of touches and of photos."""

import math

from torch import Tensor

from retrieval.model.losses.listwise import listwise_loss
from retrieval.model.losses.loss import EncodedBatch, Loss

LOG_SCALE_INIT = math.log(1 / 0.07)
LOG_SCALE_MAX = math.log(100.0)


class ContrastiveLoss(Loss):
    """`contrastive_loss` of the embeddings of a batch. Its learnt scale is the matcher's, which checkpoints keep."""

    def forward(self, batch: EncodedBatch) -> Tensor:
        """Return the loss (scalar) of a batch."""
        objects = batch.touch_objects, batch.photo_objects
        return contrastive_loss(batch.touch.embedding, batch.photo.embedding, *objects, batch.matcher.log_scale)


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
