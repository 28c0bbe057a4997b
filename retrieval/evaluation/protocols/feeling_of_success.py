"""The Feeling of Success in the protocol of Lin, Calandra and Levine: 98 objects, 80 to train and 18 to test."""

import numpy as np

from retrieval.data.dataset import Split
from retrieval.evaluation.protocol import Protocol, RecordingFacts, fold
from retrieval.evaluation.scoring import MIN_THRESHOLD_OBJECTS
from retrieval.metrics.registry import METRICS

_OBJECTS, _TEST = 98, 18


def _paper(facts: RecordingFacts, seed: int) -> list[Split]:
    """Return one split, as in the paper; the seed changes only the validation objects."""
    rng = np.random.default_rng(37)
    names = [facts.names[place] for place in rng.permutation(len(facts.names))[:_OBJECTS]]
    tests = max(2, round(_TEST / _OBJECTS * len(names)))
    return [fold(names[tests:], names[:tests], (seed, 0), MIN_THRESHOLD_OBJECTS)]


PAPER = Protocol(
    "feeling-of-success",
    "The Feeling of Success, by the paper's protocol",
    "98 random objects: 18 for test and 80 for training. Settings and pair threshold are selected on ten of the 80. "
    "Only successful grasps are used. A touch is never compared with the photo of its own grasp.",
    _paper,
    {name: METRICS[name] for name in ("topn_k5", "topn_k10", "pair_accuracy", "pair_auc")},
    published_results=(
        "On its own data, with this rig's sensors, the paper reports a pair accuracy of 64.3 % (Lin, Calandra, "
        "Levine, ICRA 2019); it gives its top-K curves without numbers.",
    ),
)
