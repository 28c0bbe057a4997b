"""Losses on logits and unit embeddings, one per file, computed in float32 for every input type.

A training loss is a `Loss` (`retrieval.model.losses.loss`) with a row in `LOSSES`, or a class in a user's own package.
It is added to the match loss with the weight `<name>_weight` of the configuration.
"""

from typing import TYPE_CHECKING

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

if TYPE_CHECKING:
    from retrieval.model.losses.loss import Loss

LOSSES: "Registry[type[Loss]]" = Registry(
    "loss",
    "losses",
    {
        "contrastive": "retrieval.model.losses.contrastive:ContrastiveLoss",
        "listwise": "retrieval.model.losses.listwise:ListwiseLoss",
        "pooled_listwise": "retrieval.model.losses.pooled_listwise:PooledListwiseLoss",
    },
    error=ConfigError,
    base="retrieval.model.losses.loss:Loss",
)

LOGIT_LOSSES = frozenset({"listwise", "pooled_listwise"})
"""Losses on match logits only. Every other one trains the embeddings for candidate search."""
