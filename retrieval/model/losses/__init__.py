"""Losses on logits and unit embeddings, computed in float32 for every input type.

A training loss is a `Loss` (`retrieval.model.losses.loss`) with a row in `LOSSES`, or a class in a user's own package.
It is added to the match loss with the weight `<name>_weight` of the configuration.
"""

from typing import Any

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

LOSSES: Registry[Any] = Registry(
    "loss",
    "losses",
    {
        "contrastive": "retrieval.model.losses.listwise:ContrastiveLoss",
        "listwise": "retrieval.model.losses.listwise:ListwiseLoss",
        "pooled_listwise": "retrieval.model.losses.listwise:PooledListwiseLoss",
    },
    error=ConfigError,
    base="retrieval.model.losses.loss:Loss",
)

LOGIT_LOSSES = frozenset({"listwise", "pooled_listwise"})
"""Losses on match logits only. Every other one trains the embeddings for candidate search."""
