"""HapticMatch: identify the pressed material among unseen materials."""

from retrieval.evaluation.real.protocol import Protocol, registered_metrics, topn_accuracy
from retrieval.evaluation.real.rct import five_folds

MATERIALS = Protocol(
    "hapticmatch",
    "HapticMatch: unseen materials",
    "Materials are randomly assigned to five folds, again for each seed; all samples of a material stay together. A "
    "touch is never compared with the photo of its own patch, so the material must be recognised.",
    five_folds,
    {**topn_accuracy(10), **topn_accuracy(5), **registered_metrics("pair_auc")},
)
