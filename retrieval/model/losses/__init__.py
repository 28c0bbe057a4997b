"""Losses on logits and unit embeddings, a file each, in float32 whatever comes in.

A new loss of training is one file with a function from an `EncodedBatch` to its loss, and one row of `LOSSES`: it is
added to the match loss with the weight `<name>_weight` of the configuration.
"""

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

    from retrieval.model.fusion import Code, Matcher

LOSSES = {
    "contrastive": "retrieval.model.losses.contrastive:of_batch",
    "listwise": "retrieval.model.losses.listwise:of_batch",
}
"""Name -> the function that gives the loss of a batch, imported when it is used."""


class EncodedBatch(NamedTuple):
    """The distinct touches (T) and photos (N) of a batch: their codes, and their objects as integers (T,), (N,)."""

    matcher: "Matcher"
    touch: "Code"
    photo: "Code"
    touch_objects: "Tensor"
    photo_objects: "Tensor"


def load_loss(name: str) -> "Callable[[EncodedBatch], Tensor]":
    """The loss `name`, a scalar of an `EncodedBatch`."""
    module, function = LOSSES[name].split(":")
    loss: Callable[[EncodedBatch], Tensor] = getattr(import_module(module), function)
    return loss
