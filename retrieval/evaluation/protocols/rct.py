"""RCT: identify the pressed material among unseen materials."""

import numpy as np

from retrieval.data.dataset import Split
from retrieval.evaluation.protocol import Protocol, RecordingFacts, folds, topn_accuracy
from retrieval.metrics.registry import METRICS

_FOLDS = 5


def five_folds(facts: RecordingFacts, seed: int) -> list[Split]:
    """Return five folds of randomly assigned objects."""
    names = facts.names
    order = [names[place] for place in np.random.default_rng([seed, 31]).permutation(len(names))]
    return folds(names, [order[turn::_FOLDS] for turn in range(_FOLDS)], seed)


MATERIALS = Protocol(
    "rct",
    "RCT: unseen materials",
    "Materials are randomly assigned to five folds, again for each seed; all presses of a material stay together. "
    "Each material has one photo, and every press is compared with it.",
    five_folds,
    {**topn_accuracy(10), **topn_accuracy(5), "pair_auc": METRICS["pair_auc"]},
    allows_own_photos=True,
)
