"""VT60: identify the touched one of nine everyday objects.

08_bottlefull is left out: its bottles are those of 02_bottleempty, and no photo distinguishes them.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from retrieval.data.dataset import Split
from retrieval.errors import DatasetError
from retrieval.evaluation.protocol import Protocol, RecordingFacts, folds, topn_accuracy
from retrieval.metrics.registry import METRICS

LEFT_OUT = "bottlefull"
GALLERY = 9
DRAWN_CHOICES = 9
_CLASSES_OF_A_FOLD = 3
_SPLIT_NOTE = (
    "08_bottlefull is left out, because it is 02_bottleempty filled. Settings are selected on five of the other "
    "objects."
)


def by_class(facts: RecordingFacts) -> dict[str, list[str]]:
    """Return the sorted objects of each class, without the class that is left out.

    Raises:
        DatasetError: The recording lacks the class of an object.
    """
    if facts.kind_of is None:
        raise DatasetError(
            "recording.json lacks the class of an object. Import the data set again with `retrieve import vt60`."
        )
    found: dict[str, list[str]] = defaultdict(list)
    for name, kind in facts.kind_of.items():
        if kind != LEFT_OUT:
            found[kind].append(name)
    return dict(sorted(found.items()))


def _names(classes: Mapping[str, Sequence[str]]) -> list[str]:
    return [name for names in classes.values() for name in names]


def _seen_classes(facts: RecordingFacts, seed: int) -> list[Split]:
    """Return a fold for each instance number i, which tests instance i of every class."""
    classes = by_class(facts)
    return folds(_names(classes), list(zip(*classes.values(), strict=False)), seed)


def _choices(facts: RecordingFacts, seed: int) -> list[Split]:
    """Return folds that test two instances of every class.

    All pairs of instance numbers, the same in every class, come first, then seeded draws.

    Raises:
        DatasetError: A class has fewer than three instances.
    """
    classes = by_class(facts)
    rng = np.random.default_rng([seed, 31])
    fewest = min(map(len, classes.values()))
    if fewest < 3:
        raise DatasetError(
            f"Each class needs at least 3 instances, 2 for test and the others for training, but a class has {fewest}."
        )
    tests = [[names[turn] for names in classes.values() for turn in pair] for pair in combinations(range(fewest), 2)]
    for _ in range(DRAWN_CHOICES):
        tests.append([name for names in classes.values() for name in rng.choice(names, 2, replace=False).tolist()])
    return folds(_names(classes), tests, seed)


def _one_of_each_class(facts: RecordingFacts, split: Split) -> dict[str, str]:
    """Return galleries with one test object of each class: the first of each, the second, and so on."""
    tested = [[name for name in names if name in split.test] for names in by_class(facts).values()]
    return {name: f"instance {place}" for names in tested for place, name in enumerate(names)}


def _random(facts: RecordingFacts, seed: int) -> list[Split]:
    names = _names(by_class(facts))
    order = np.random.default_rng([seed, 19]).permutation(names).tolist()
    count = max(1, len(names) // GALLERY)
    return folds(names, [order[turn::count] for turn in range(count)], seed)


def _classes(facts: RecordingFacts, seed: int) -> list[Split]:
    classes = by_class(facts)
    order = np.random.default_rng([seed, 23]).permutation(list(classes)).tolist()
    groups = [order[start : start + _CLASSES_OF_A_FOLD] for start in range(0, len(order), _CLASSES_OF_A_FOLD)]
    return folds(_names(classes), [[name for kind in group for name in classes[kind]] for group in groups], seed)


SEEN_CLASSES = Protocol(
    "vt60",
    "VT60: an unseen instance of each seen class",
    "A fold tests one instance of each of nine classes and trains on the others; every object is tested once. "
    f"{_SPLIT_NOTE}",
    _seen_classes,
    {
        **topn_accuracy(GALLERY),
        **topn_accuracy(GALLERY, photos=3),
        **topn_accuracy(GALLERY, grasps=5, photos=3),
        "pair_auc": METRICS["pair_auc"],
    },
    allows_own_photos=True,
)
CHOICES = replace(
    SEEN_CLASSES,
    title="VT60: two unseen instances of each class, over choices of them",
    rule="A fold tests two instances of each of nine classes and trains on the others. All pairs of instance numbers "
    f"are held out, the same in every class, and {DRAWN_CHOICES} seeded draws of two instances in each class. A "
    "gallery contains one test object of each class; each query searches its own gallery. 08_bottlefull is left out, "
    "because it is 02_bottleempty filled. Settings are selected within the training objects of each fold.",
    folds=_choices,
    galleries=_one_of_each_class,
    choices=True,
)
RANDOM = replace(
    SEEN_CLASSES,
    title="VT60: nine random unseen objects",
    rule="Objects are randomly assigned to folds of nine, again for each seed; every object is tested once. "
    f"{_SPLIT_NOTE}",
    folds=_random,
)
CLASSES = replace(
    SEEN_CLASSES,
    title="VT60: unseen classes",
    rule="A fold tests all instances of three unseen classes, drawn again for each seed; a gallery contains nine of "
    f"their objects. {_SPLIT_NOTE}",
    folds=_classes,
)
