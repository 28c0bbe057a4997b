"""X-Capture: which object was touched, of objects that nothing has seen."""

from retrieval.evaluation.real.protocol import Protocol, first_guess, registered
from retrieval.evaluation.real.rct import five_folds

OBJECTS = Protocol(
    "x-capture",
    "X-Capture: unseen objects",
    "Objects are randomly assigned to five folds, again for each seed; all points of an object stay together. A touch "
    "is never shown the photo of its own point.",
    five_folds,
    {**first_guess(10), **first_guess(5), **registered("pair_auc")},
)
