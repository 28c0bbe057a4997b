"""VT60: nine everyday objects, of which one was touched. One of the two classes of bottles is left out: 08_bottlefull
and 02_bottleempty are the same things, and no photo tells them apart.
"""

from collections import defaultdict
from dataclasses import replace
from itertools import combinations

import numpy as np

from retrieval.data.dataset import Split
from retrieval.errors import DatasetError
from retrieval.evaluation.real.protocol import (
    BOTH,
    REFERENCE,
    Protocol,
    RecordingFacts,
    folds,
    registered_metrics,
    topn_accuracy,
)

LEFT_OUT = "bottlefull"
GALLERY = 9
DRAWN_CHOICES = 9
_CLASSES_OF_A_FOLD = 3
_MEASURES = {
    **topn_accuracy(GALLERY),
    **topn_accuracy(GALLERY, photos=3),
    **topn_accuracy(GALLERY, grasps=5, photos=3),
    **registered_metrics("pair_auc"),
}
_SPLIT_NOTE = "08_bottlefull is left out, which is 02_bottleempty filled. Five of the other objects choose settings."
_REFERENCE_MEASURES = {
    **topn_accuracy(GALLERY),
    **topn_accuracy(GALLERY, photos=3, entries="references"),
    **topn_accuracy(GALLERY, grasps=5, photos=3, entries="references"),
    **registered_metrics("pair_auc"),
}
_REFERENCE_SPLIT = (
    "Of each object the first quarter of its touches are references, the last half asks. References and queries are of "
    "one sitting and one finger, so that the control of the order knows all: only what the blur loses is touch."
)


def by_class(facts: RecordingFacts) -> dict[str, list[str]]:
    """Objects of each class, sorted; without the class that is left out. Raises DatasetError where none is told."""
    found: dict[str, list[str]] = defaultdict(list)
    for name in facts.names:
        kind = facts.objects.get(name, {}).get("class")
        if kind is None:
            raise DatasetError(
                f"recording.json must say of {name} what class it is of; make it with `retrieve import vt60`"
            )
        if kind != LEFT_OUT:
            found[str(kind)].append(name)
    return dict(sorted(found.items()))


def _seen_classes(facts: RecordingFacts, seed: int) -> list[Split]:
    """Instance number i of every class."""
    classes = by_class(facts)
    least = min(map(len, classes.values()))
    tests = [[names[turn] for names in classes.values()] for turn in range(least)]
    return folds([name for names in classes.values() for name in names], tests, seed)


def _choices(facts: RecordingFacts, seed: int) -> list[Split]:
    """Two instances of every class: all pairs of instance numbers, the same in every class, then seeded draws. Raises
    DatasetError for fewer than three instances of a class.
    """
    classes = by_class(facts)
    rng = np.random.default_rng([seed, 31])
    least = min(map(len, classes.values()))
    if least < 3:
        raise DatasetError(
            f"two instances of each class test and others train; a class has {least}, give three or more"
        )
    tests = [[names[turn] for names in classes.values() for turn in pair] for pair in combinations(range(least), 2)]
    for _ in range(DRAWN_CHOICES):
        tests.append([name for names in classes.values() for name in rng.choice(names, 2, replace=False).tolist()])
    return folds([name for names in classes.values() for name in names], tests, seed)


def _one_of_each_class(facts: RecordingFacts, split: Split) -> dict[str, str]:
    """Galleries of one test object of each class: the first of each, the second, and so on."""
    test = set(split.test)
    return {
        name: f"instance {place}"
        for names in by_class(facts).values()
        for place, name in enumerate(name for name in names if name in test)
    }


def _random(facts: RecordingFacts, seed: int) -> list[Split]:
    names = [name for members in by_class(facts).values() for name in members]
    order = [names[place] for place in np.random.default_rng([seed, 19]).permutation(len(names))]
    count = max(1, len(names) // GALLERY)
    return folds(names, [order[turn::count] for turn in range(count)], seed)


def _classes(facts: RecordingFacts, seed: int) -> list[Split]:
    classes = by_class(facts)
    kinds = list(classes)
    order = [kinds[place] for place in np.random.default_rng([seed, 23]).permutation(len(kinds))]
    groups = [order[start : start + _CLASSES_OF_A_FOLD] for start in range(0, len(order), _CLASSES_OF_A_FOLD)]
    names = [name for members in classes.values() for name in members]
    return folds(names, [[name for kind in group for name in classes[kind]] for group in groups], seed)


SEEN_CLASSES = Protocol(
    "vt60",
    "VT60: an unseen instance of each seen class",
    "A fold tests one instance of each of nine classes, the other instances train; every object is tested once. "
    f"{_SPLIT_NOTE}",
    _seen_classes,
    _MEASURES,
    allows_own_photos=True,
)
CHOICES = Protocol(
    "vt60",
    "VT60: two unseen instances of each class, over choices of them",
    "A fold tests two instances of each of nine classes and learns from the others. All pairs of instance numbers are "
    f"held out, the same in every class, and {DRAWN_CHOICES} seeded draws of two instances in each class. A gallery "
    "holds one test object of each class, and both galleries are asked. 08_bottlefull is left out, which is "
    "02_bottleempty filled. Settings are chosen within the training objects of each fold.",
    _choices,
    _MEASURES,
    allows_own_photos=True,
    galleries=_one_of_each_class,
    choices=True,
)
RANDOM = Protocol(
    "vt60",
    "VT60: nine random unseen objects",
    f"Objects are dealt by lot into folds of nine, again for each seed; every object is tested once. {_SPLIT_NOTE}",
    _random,
    _MEASURES,
    allows_own_photos=True,
)
CLASSES = Protocol(
    "vt60",
    "VT60: unseen classes",
    "A fold tests all instances of three classes that nothing else has seen, drawn again for each seed; of their "
    f"objects nine stand in a gallery. {_SPLIT_NOTE}",
    _classes,
    _MEASURES,
    allows_own_photos=True,
)


def _with_references(name: str, protocol: Protocol, entry: str) -> Protocol:
    """The protocol `name` with a catalogue of reference touches."""
    called, held = {
        REFERENCE: ("reference touches", "touches in place of photos"),
        BOTH: ("reference touches with photos", "a touch with each photo"),
    }[entry]
    return replace(
        protocol,
        title=protocol.title.replace("VT60", f"VT60, {called}"),
        rule=f"As {name}, the catalogue holding {held}. {_REFERENCE_SPLIT} {_SPLIT_NOTE}",
        measures=_REFERENCE_MEASURES,
        entry=entry,
    )


REFERENCE_SEEN_CLASSES = _with_references("vt60-seen-classes", SEEN_CLASSES, REFERENCE)
REFERENCE_RANDOM = _with_references("vt60-random", RANDOM, REFERENCE)
REFERENCE_AND_PHOTO = _with_references("vt60-seen-classes", SEEN_CLASSES, BOTH)
REFERENCE_AND_PHOTO_RANDOM = _with_references("vt60-random", RANDOM, BOTH)
