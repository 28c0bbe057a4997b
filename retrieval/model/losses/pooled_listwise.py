"""Listwise loss of the pooled logit: with late interaction, the rest of the match logit is trained on its own, too."""

from torch import Tensor

from retrieval.model.losses.listwise import listwise_loss
from retrieval.model.losses.loss import EncodedBatch, Loss


class PooledListwiseLoss(Loss):
    """`listwise_loss` of the match logits without late interaction.

    Candidates are found by the pooled logit, and an index without cells ranks by it. Without this loss the cells learn
    to explain everything, and the pooled logit becomes useless.
    """

    def forward(self, batch: EncodedBatch) -> Tensor:
        """Return the loss (scalar) of a batch."""
        pooled = batch.matcher.config.pooled_width
        logits = batch.matcher.head.all_logits(batch.touch.partial[:, :pooled], batch.photo.partial[:, :pooled])
        return listwise_loss(logits, batch.touch_objects, batch.photo_objects)
