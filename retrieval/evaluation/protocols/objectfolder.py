"""ObjectFolder's cross-sensory retrieval: mean average precision on unseen objects, with the published split."""

from retrieval.data.dataset import Split
from retrieval.errors import DatasetError
from retrieval.evaluation.protocol import Protocol, RecordingFacts
from retrieval.metrics.registry import METRICS, Metric, average_precision


def _published(facts: RecordingFacts, seed: int) -> list[Split]:
    if not facts.splits:
        raise DatasetError(
            "The recording lacks splits/published.json, a split by object. Import a pack of the benchmark with its "
            "split.json. The import drops a split by image, because it tests no unseen object."
        )
    split = next(iter(facts.splits.values()))
    return [Split(seed, split.train, split.validation, split.test)]


PUBLISHED = Protocol(
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
