"""Protocols: the split of a recording or data set, the galleries, the controls and the measures."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.files import read_json
from retrieval.data.dataset import Grasp, Split, data_digest, load_grasps, object_kinds, recording_source
from retrieval.evaluation.inputs import CONTROL_CCA
from retrieval.metrics.registry import Metric, k_way

VALIDATION_OBJECTS = 5
"""Default number of validation objects, on which methods select their settings."""
MAX_GRASPS = {"train": 1, "validation": 12, "test": 40}
"""Default number of scored grasps of one object at most, by part."""
CONTROLS = ("permuted", "no_contact", "order", "background")
"""Default inputs of the controls that are measured once for all rows."""


@dataclass(frozen=True, eq=False)
class RecordingFacts:
    """A recording with the facts that protocols need: classes of objects by id, published splits by name."""

    folder: Path
    source: str
    grasps: list[Grasp]
    class_of: Mapping[str, str]
    splits: Mapping[str, Split]

    @cached_property
    def digest(self) -> str:
        """Digest of the ids and images of the grasps."""
        return data_digest(self.grasps)

    @cached_property
    def sessions(self) -> dict[str | None, set[str]]:
        """The objects of each session, in the order of the sessions' first grasps."""
        found: dict[str | None, set[str]] = {}
        for grasp in self.grasps:
            found.setdefault(grasp.session, set()).add(grasp.object_id)
        return found

    @cached_property
    def names(self) -> list[str]:
        """The touched objects, sorted."""
        return sorted({grasp.object_id for grasp in self.grasps})

    @cached_property
    def kind_of(self) -> dict[str, str] | None:
        """The class of every object; None if the recording lacks the class of one."""
        found = {name: self.class_of[name] for name in self.names if name in self.class_of}
        return found if len(found) == len(self.names) else None

    @cached_property
    def sequence_of(self) -> dict[str, str]:
        """The sequence of each object's first grasp; the object itself if it has none."""
        found: dict[str, str] = {}
        for grasp in self.grasps:
            found.setdefault(grasp.object_id, grasp.sequence_id or grasp.object_id)
        return found


def read_recording_facts(folder: Path) -> RecordingFacts:
    """Read the facts of a recording from its folder.

    Raises:
        DatasetError: A file is missing or invalid.
    """
    grasps = load_grasps(folder)  # also checks recording.json
    splits = {path.stem: Split.from_dict(read_json(path)) for path in sorted((folder / "splits").glob("*.json"))}
    return RecordingFacts(folder, recording_source(folder), grasps, object_kinds(folder), splits)


@dataclass(frozen=True)
class Protocol:
    """One protocol: the objects of each part, the queries and galleries, the controls and the measures.

    Attributes:
        data_set: The importer of the data set; None for any recording.
        title: Title in the report.
        rule: The split, described in sentences.
        folds: Function from recording and seed to splits. The test objects of all folds together are the same for every
            seed.
        measures: Measures by name. The first one decides whether a result is evidence of touch (`aggregate.RULE`).
        controls: Inputs (`inputs.INPUTS`) -> the method that is fitted and scored on them, once for all rows.
        ceilings: The same for inputs of one modality.
        control_measures: Measures of controls, ceilings and comparisons; empty for all.
        max_grasps: Maximum number of scored grasps of one object, by part; a part without an entry has no limit.
        allows_own_photos: Whether a touch is compared with the photo of its own grasp, because the data set pairs them
            at random or has one photo of each object.
        is_by_sequence: Whether a gallery contains the objects of one sequence; intervals then resample sequences.
        published_results: Results of others, one sentence each.
        galleries: Function from recording and split to the gallery of each test object, if there are several galleries.
        choices: Whether the folds are different, overlapping choices of test objects. Values are then means over the
            folds, and intervals cover the choice.
        across_sessions: Whether touches of test objects are of all sessions but the first, and all other touches and
            all photos of the first.
        in_depth: Whether single objects, calibrated probabilities and decisions of each row are reported. Then one
            split serves all seeds, which only repeat the training; no method is fitted on validation objects, and rows
            have no low-pass control of their own and no verdict.

    >>> from retrieval.evaluation.protocol import topn_accuracy, folds
    >>> def halves(facts, seed):
    ...     return folds(facts.names, [facts.names[::2], facts.names[1::2]], seed)
    >>> protocol = retrieval.Protocol("vt60", "Halves", "Objects are halved by name.", halves, topn_accuracy(10))
    >>> protocol.main
    'topn_k10'
    """

    data_set: str | None
    title: str
    rule: str
    folds: Callable[[RecordingFacts, int], list[Split]]
    measures: Mapping[str, Metric]
    controls: Mapping[str, str] = field(default_factory=lambda: dict.fromkeys(CONTROLS, CONTROL_CCA))
    ceilings: Mapping[str, str] = field(default_factory=dict)
    control_measures: tuple[str, ...] = ()
    max_grasps: Mapping[str, int] = field(default_factory=lambda: MAX_GRASPS)
    allows_own_photos: bool = False
    is_by_sequence: bool = False
    published_results: tuple[str, ...] = ()
    galleries: Callable[[RecordingFacts, Split], Mapping[str, str]] | None = None
    choices: bool = False
    across_sessions: bool = False
    in_depth: bool = False

    def gallery_of(self, facts: RecordingFacts, split: Split) -> Mapping[str, str]:
        """Return the name of the gallery of each test object."""
        if self.galleries:
            return self.galleries(facts, split)
        return {name: facts.sequence_of[name] if self.is_by_sequence else "" for name in split.test}

    def rows_to_fit(self, grasps: Sequence[Grasp]) -> NDArray[np.int64]:
        """Return the rows of the grasps that methods may be fitted on: all, or those of the first session."""
        return np.flatnonzero([not self.across_sessions or one.session == grasps[0].session for one in grasps])

    @property
    def main(self) -> str:
        """The name of the deciding measure."""
        return next(iter(self.measures))


def fold(
    rest: Sequence[str], test: Sequence[str], seed: Sequence[int], validation_objects: int = VALIDATION_OBJECTS
) -> Split:
    """Return a split with these test objects, and `rest` for training and validation; `seed[0]` is that of the split.

    A quarter of `rest`, at least 2, is for validation if that is fewer than `validation_objects`.
    """
    order = np.random.default_rng([*seed, 17]).permutation(rest).tolist()
    count = max(2, min(validation_objects, len(rest) // 4))
    return split_of(seed[0], order[count:], order[:count], test)


def split_of(seed: int, *parts: Iterable[str]) -> Split:
    """Return the split with these training, validation and test objects."""
    return Split(seed, *(tuple(sorted(part)) for part in parts))


def folds(names: Sequence[str], tests: Sequence[Sequence[str]], seed: int) -> list[Split]:
    """Return a split for each set of test objects; the others of `names` are for training and validation."""
    return [
        fold([name for name in names if name not in set(test)], test, (seed, number))
        for number, test in enumerate(tests)
    ]


def topn_accuracy(k: int, *, grasps: int = 1, photos: int = 1) -> dict[str, Metric]:
    """Return the metric of top-1..top-k accuracy among k objects, by touches of a query and photos of a candidate."""
    name = f"topn_k{k}" + f"_g{grasps}" * (grasps > 1) + f"_p{photos}" * (photos > 1)
    label = f"top-1 of {k}" + f", {grasps} touches" * (grasps > 1) + f", {photos} photos" * (photos > 1)
    return {
        name: Metric(
            label,
            "real",
            lambda of: k_way(of.test if grasps == 1 else of.sets.get(grasps), k, photos=photos, seed=of.seed),
        )
    }
