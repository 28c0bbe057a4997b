"""Protocols of ObjectFolder's cross-sensory retrieval, and The Feeling of Success: unseen objects."""

import numpy as np

from retrieval.data.dataset import Split
from retrieval.errors import DatasetError
from retrieval.evaluation.protocol import Protocol, RecordingFacts, fold
from retrieval.evaluation.queries import MIN_THRESHOLD_OBJECTS
from retrieval.metrics.registry import METRICS, Metric, average_precision

_OBJECTS, _TEST = 98, 18  # of Lin, Calandra and Levine


def _published(facts: RecordingFacts, seed: int) -> list[Split]:
    if not facts.splits:
        raise DatasetError(
            "The recording lacks splits/published.json, a split by object. Import a pack of the benchmark with its "
            "split.json. The import drops a split by image, because it tests no unseen object."
        )
    split = next(iter(facts.splits.values()))
    return [Split(seed, split.train, split.validation, split.test)]


OBJECTFOLDER = Protocol(
    "objectfolder",
    "ObjectFolder: cross-sensory retrieval",
    "The published split: its test objects are queries; settings are selected on its validation objects. Every image "
    "of the object is a correct answer, also the one with the query's own number.",
    _published,
    {
        "objectfolder_touch_to_photo": Metric(
            "mAP, touch to photo", "real", lambda of: average_precision(of.test.with_own())
        ),
        "objectfolder_photo_to_touch": Metric(
            "mAP, photo to touch", "real", lambda of: average_precision(of.test.transposed().with_own())
        ),
        "pair_auc": METRICS["pair_auc"],
        "topn_k10": METRICS["topn_k10"],
    },
    published_results=(
        "On 100 unseen simulated objects the benchmark's authors report a mAP from touch to photo of 8.50 % for CCA "
        "and 8.80 % for a neural network (DAR, Deep Aligned Representations).",
        "For real objects, 64.9 % was reported, but on objects that the model was trained on.",
    ),
)


def _paper(facts: RecordingFacts, seed: int) -> list[Split]:
    """Return one split, as in the paper; the seed changes only the validation objects."""
    names = np.random.default_rng(37).permutation(facts.names)[:_OBJECTS].tolist()
    tests = max(2, round(_TEST / _OBJECTS * len(names)))
    return [fold(names[tests:], names[:tests], (seed, 0), MIN_THRESHOLD_OBJECTS)]


FEELING_OF_SUCCESS = Protocol(
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
