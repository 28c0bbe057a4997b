"""What a protocol is: a rule that splits, a rule for the gallery, and what is measured."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from _touch_retrieval.files import read_json
from retrieval.data.dataset import Grasp, Split, load_grasps
from retrieval.errors import DatasetError
from retrieval.metrics.registry import METRICS, Metric, k_way_measure

PHOTO, REFERENCE, BOTH, TOUCHES = "photo", "reference", "both", "touches"
"""What an entry of the catalogue shows: a photo, a reference touch, the one with the other, or touches that nothing is
fitted to (`retrieval.evaluation.real.touch_to_touch`)."""
VALIDATION_OBJECTS = 5
"""Objects, of those that do not test, by which methods choose their settings."""


@dataclass(frozen=True, eq=False)
class RecordingFacts:
    """A recording as protocols see it.

    objects: object_id -> what the data set says of it; splits: name -> a published split.
    """

    source: str
    grasps: list[Grasp]
    objects: Mapping[str, Mapping[str, Any]]
    splits: Mapping[str, Split]

    @property
    def names(self) -> list[str]:
        """The objects that were touched, sorted."""
        return sorted({grasp.object_id for grasp in self.grasps})

    @property
    def kind_of(self) -> dict[str, str] | None:
        """The class of every object; None where the recording does not name it of all."""
        found = {name: str(self.objects[name]["class"]) for name in self.names if "class" in self.objects.get(name, {})}
        return found if len(found) == len(self.names) else None

    @property
    def sequence_of(self) -> dict[str, str]:
        """The sequence of each object's first grasp; the object itself where there is none."""
        found: dict[str, str] = {}
        for grasp in self.grasps:
            found.setdefault(grasp.object_id, grasp.sequence_id or grasp.object_id)
        return found


def read_recording_facts(folder: Path) -> RecordingFacts:
    """What is known of a recording's grasps. Raises DatasetError."""
    grasps = load_grasps(folder)  # which checks the files that are read here
    info = read_json(folder / "recording.json")
    said = info.get("objects")
    objects = {name: about for name, about in said.items() if isinstance(about, dict)} if isinstance(said, dict) else {}
    splits = {}
    for path in sorted((folder / "splits").glob("*.json")):
        try:
            splits[path.stem] = Split.from_dict(read_json(path))
        except ValueError as error:
            raise DatasetError(f"{path} is not a JSON file: {error}") from error
    return RecordingFacts(str(info["source"]), grasps, objects, splits)


@dataclass(frozen=True)
class Protocol:
    """One way to ask one data set.

    data_set: the importer that reads it. rule: how it is split, in words, as a sentence. folds: the splits for a seed;
    the test objects of all folds together are the same for every seed. measures: by name; the first of them decides
    whether a result counts as touch. own_photos: a touch may be shown the photo of its own grasp (its data set pairs
    them by lot, or has one photo of an object). by_sequence: a gallery holds the objects of one sequence, and sequences
    are what intervals resample. counted: a measure of right and wrong answers alone, which are counted too, with an
    exact binomial interval. anchors: what others reached, a sentence each. entry: what an object's entries in the
    catalogue show, one of `PHOTO`, `REFERENCE`, `BOTH` (`retrieval.evaluation.real.reference_rows`). galleries: the gallery
    in which each test object of a split stands, where there are several. choices: every fold is another choice of test
    objects, which share objects with those of others; values are means over the folds, and intervals cover the choice.

    >>> from retrieval.evaluation.real.protocol import topn_accuracy, folds
    >>> def halves(facts, seed):
    ...     return folds(facts.names, [facts.names[::2], facts.names[1::2]], seed)
    >>> protocol = retrieval.Protocol("vt60", "Halves", "Objects are halved by name.", halves, topn_accuracy(10))
    >>> protocol.main
    'topn_k10'
    """

    data_set: str
    title: str
    rule: str
    folds: Callable[[RecordingFacts, int], list[Split]]
    measures: Mapping[str, Metric]
    allows_own_photos: bool = False
    is_by_sequence: bool = False
    binomial_measure: str | None = None
    published_results: tuple[str, ...] = ()
    entry: str = PHOTO
    galleries: Callable[[RecordingFacts, Split], Mapping[str, str]] | None = None
    choices: bool = False

    def gallery_of(self, facts: RecordingFacts, split: Split) -> Mapping[str, str]:
        """The name of the gallery in which each test object of a split stands."""
        if self.galleries:
            return self.galleries(facts, split)
        return {name: facts.sequence_of[name] if self.is_by_sequence else "" for name in split.test}

    @property
    def main(self) -> str:
        """The name of the measure that decides."""
        return next(iter(self.measures))


def fold(
    rest: Sequence[str], test: Sequence[str], seed: Sequence[int], validation_objects: int = VALIDATION_OBJECTS
) -> Split:
    """A split that tests on `test`; of the other objects `validation_objects`, or a quarter where that is fewer, validate, and
    the rest train.
    """
    order = np.random.default_rng([*seed, 17]).permutation(len(rest))
    count = max(2, min(validation_objects, len(rest) // 4))
    return Split(
        seed=seed[0],
        train=tuple(sorted(rest[place] for place in order[count:])),
        validation=tuple(sorted(rest[place] for place in order[:count])),
        test=tuple(sorted(test)),
    )


def folds(names: Sequence[str], tests: Sequence[Sequence[str]], seed: int) -> list[Split]:
    """A fold for each set of test objects; of `names` the others train and choose."""
    return [
        fold([name for name in names if name not in set(test)], test, (seed, number))
        for number, test in enumerate(tests)
    ]


# Measures --------------------------------------------------------------------------------------------


def registered_metrics(*names: str) -> dict[str, Metric]:
    """Metrics of every evaluation, by name."""
    return {name: METRICS[name] for name in names}


def topn_accuracy(k: int, *, grasps: int = 1, photos: int = 1, entries: str = "photos") -> dict[str, Metric]:
    """The first guess among k objects, after so many touches, each object shown by so many photos, or what `entries`
    calls them.
    """
    name = f"topn_k{k}" + (f"_g{grasps}" if grasps > 1 else "") + (f"_p{photos}" if photos > 1 else "")
    label = f"first guess of {k}"
    label += f", {grasps} touches" if grasps > 1 else ""
    label += f", {photos} {entries}" if photos > 1 else ""
    return {
        name: Metric(
            label,
            label,
            "real",
            lambda of: k_way_measure(of.test if grasps == 1 else of.sets.get(grasps), k, of.seed, photos),
        )
    }
