"""ObjectFolder's cross-sensory retrieval: mean average precision over unseen objects, by the published split."""

from retrieval.data.dataset import Split
from retrieval.errors import DatasetError
from retrieval.evaluation.real.protocol import Protocol, RecordingFacts, registered_metrics


def _published(facts: RecordingFacts, seed: int) -> list[Split]:
    if not facts.splits:
        raise DatasetError(
            "the recording must hold splits/published.json, which parts objects; import a pack of the benchmark with "
            "its split.json. Where that split parts pictures, it judges no unseen object, and is not kept"
        )
    split = next(iter(facts.splits.values()))
    return [Split(seed, split.train, split.validation, split.test)]


PUBLISHED = Protocol(
    "objectfolder",
    "ObjectFolder: cross-sensory retrieval",
    "The published split: its test objects are asked, its validation objects choose. Any picture of the object is "
    "right, that of the query's own number too.",
    _published,
    registered_metrics("objectfolder_touch_to_photo", "objectfolder_photo_to_touch", "pair_auc", "topn_k10"),
    published_results=(
        "On 100 unseen simulated objects the benchmark's authors report a mAP of 8.50 % (CCA) and 8.80 % (DAR).",
        "For real objects 64.9 % are reported, on objects that were trained on.",
    ),
)
