"""The paper's loss of pairs, which every training run includes."""

from torch import Tensor
from torch.nn import functional


def match_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """Return the mean binary cross-entropy of match logits (P,) against labels (P,) of 0 and 1.

    It is computed from logits: `log(sigmoid(z))` is -inf below z = -104 in float32, and its gradient NaN.
    """
    return functional.binary_cross_entropy_with_logits(logits.float(), labels.float())
