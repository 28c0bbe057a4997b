"""X-Capture: identify the touched object among unseen objects."""

from retrieval.evaluation.real.protocol import Protocol, registered_metrics, topn_accuracy
from retrieval.evaluation.real.rct import five_folds

OBJECTS = Protocol(
    "x-capture",
    "X-Capture: unseen objects",
    "Objects are randomly assigned to five folds, again for each seed; all points of an object stay together. A touch "
    "is never compared with the photo of its own point.",
    five_folds,
    {**topn_accuracy(10), **topn_accuracy(5), **registered_metrics("pair_auc")},
)
