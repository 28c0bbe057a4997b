"""The Feeling of Success in the protocol of Lin, Calandra and Levine: 98 objects, 80 to train and 18 to test."""

import numpy as np

from retrieval.data.dataset import Split
from retrieval.evaluation.calibrate import MIN_THRESHOLD_OBJECTS
from retrieval.evaluation.real.protocol import Protocol, RecordingFacts, fold, registered_metrics

_OBJECTS, _TEST = 98, 18


def _paper(facts: RecordingFacts, seed: int) -> list[Split]:
    """One split, as in the paper; with the seed only those who choose change."""
    rng = np.random.default_rng(37)
    names = [facts.names[place] for place in rng.permutation(len(facts.names))[:_OBJECTS]]
    tested = max(2, round(_TEST / _OBJECTS * len(names)))
    return [fold(names[tested:], names[:tested], (seed, 0), MIN_THRESHOLD_OBJECTS)]


PAPER = Protocol(
    "feeling-of-success",
    "The Feeling of Success, as the paper asks",
    "98 objects by lot, of which 18 test and 80 train (ten of these choose settings and the threshold of pairs); "
    "grasps that held. A touch is never shown the photo of its own grasp.",
    _paper,
    registered_metrics("topn_k5", "topn_k10", "pair_accuracy", "pair_auc"),
    published_results=(
        "On data of its own, with this rig's sensors, the paper reports a pair accuracy of 64.3 % (Lin, Calandra, "
        "Levine, ICRA 2019); its guess curves are printed without numbers.",
    ),
)
