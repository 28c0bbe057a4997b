"""Choice by ranking on held-out objects, never on the objects of the fit, and the accuracies that led to it."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.data.dataset import Grasp
from retrieval.errors import BadInput, NumericalError
from retrieval.metrics.intervals import bootstrap_interval
from retrieval.metrics.measure import Measure, weight_below
from retrieval.training.features import Features

MAX_VALIDATION_ROWS = 512
GALLERY, MAX_FOLDS = 9, 5
"""Smallest usual number of objects of a fold, and largest number of folds."""
MIN_OBJECTS = 6
"""Minimum number of objects: two folds of three."""
MIN_OBJECTS_FOR_FOUR_FOLDS = 12
"""Objects that four folds need, three in each; fewer objects make two folds."""
LOW_PASS = "low-pass control"
COMPARED = "compared"
"""Key of `comparison_table` in a checkpoint's provenance."""


def validation_rows(validation: Features, max_rows: int = MAX_VALIDATION_ROWS) -> NDArray[np.int64]:
    """Return rows for the choice: equally many per object, evenly spaced, about `max_rows` in all (at least 2 each)."""
    parts = [np.flatnonzero(validation.owner == owner) for owner in range(int(validation.owner.max()) + 1)]
    each = max(max_rows // len(parts), 2)
    return np.concatenate([part[np.linspace(0, len(part) - 1, min(each, len(part))).astype(int)] for part in parts])


def ranking_auc(
    scores: NDArray[np.floating[Any]], owner: NDArray[np.int64], group: NDArray[np.int64] | None = None
) -> float:
    """Return how often another photo of the touched object scores above one of another object; ties count half.

    The mean is taken over the pairs of a touch, over the touches of an object, and over objects. `scores` (n, n) are of
    the touch of every grasp with the photo of every grasp, `owner` (n,) is the object of each. The photos of a touch's
    own group (n,), by default its own grasp, are ignored unless its object has no others.

    Raises:
        NumericalError: A score is not finite. A NaN would count as the higher one.
    """
    bad = np.flatnonzero(~np.isfinite(scores).all(axis=1))
    if len(bad):
        raise NumericalError(f"every score must be finite; touch {bad[0]} has a NaN or infinite one")
    group = np.arange(len(owner)) if group is None else group
    values = np.empty(len(scores))
    for row, score in enumerate(scores):
        same = owner == owner[row]
        own = same & (group != group[row])
        others = score[~same]
        values[row] = weight_below(score[own if own.any() else same], others).mean() / len(others)
    return float(np.mean([values[owner == each].mean() for each in np.unique(owner)]))


def objects_of_two_sessions(grasps: Sequence[Grasp], minimum: int) -> set[str]:
    """Return the objects that were touched in two sessions, if they are half of all, or 12; else nothing.

    Fewer than `minimum` are none.
    """
    sessions: dict[str, set[str]] = {}
    for grasp in grasps:
        sessions.setdefault(grasp.object_id, set()).add(grasp.session or "")
    repeated = {name for name, of_object in sessions.items() if len(of_object) > 1}
    needed = max(minimum, min(MIN_OBJECTS_FOR_FOUR_FOLDS, len(sessions) / 2))
    return repeated if len(repeated) >= needed else set()


def draw_folds(linked: Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    """Draw folds of objects, each left out once; the objects of a group stay together.

    Raises:
        BadInput: There are fewer than `MIN_OBJECTS` objects, or too many share a sequence.
    """
    total = sum(map(len, linked))
    if total < MIN_OBJECTS:
        raise BadInput(f"A fit needs a recording of at least {MIN_OBJECTS} objects, got {total}. Record more.")
    folds: list[list[str]] = [[] for _ in range(min(max(round(total / GALLERY), 2), total // 3, MAX_FOLDS))]
    for place in np.random.default_rng([0, 7]).permutation(len(linked)):
        min(folds, key=len).extend(linked[place])
    if min(map(len, folds)) < MIN_OBJECTS / 2:
        raise BadInput(
            f"A fit needs objects that do not share a sequence; {max(map(len, linked))} of {total} share one. Give "
            "each object a sequence_id of its own."
        )
    return [tuple(sorted(fold)) for fold in folds]


def held_out_folds(
    features: Features,
    kind_of: Mapping[str, str] | None = None,
    linked: Iterable[Sequence[str]] = (),
    seed: int = 0,
) -> list[tuple[str, ...]]:
    """Return the objects in four folds, or two: of each kind, every second object is in one fold, the rest in another.

    A held-out object is easier to identify than a user's next object if all similar objects are in the training set. So
    half of the objects of a kind are held out together, and the fit uses the other half.

    Args:
        features: Features of grasps.
        kind_of: The kind of each object, if the recording names it; else similar objects are of one kind
            (`appearance_order`).
        linked: Objects that stay together, such as those of one sequence.
        seed: Seed of the order within a kind.
    """
    names = sorted(set(features.object_ids))
    if kind_of is not None and all(name in kind_of for name in names):
        shuffled = [names[place] for place in np.random.default_rng([seed, 29]).permutation(len(names))]
        order = sorted(shuffled, key=lambda name: kind_of[name])
    else:
        order = appearance_order(features)
    unit_of = {name: tuple(each for each in sorted(unit) if each in names) for unit in linked for name in unit}
    sides: list[list[str]] = [[], []]
    for unit in dict.fromkeys(unit_of.get(name, (name,)) for name in order):
        min(sides, key=len).extend(unit)
    if len(names) < MIN_OBJECTS_FOR_FOUR_FOLDS or any(len(unit) > 1 for unit in unit_of.values()):
        return [tuple(sorted(side)) for side in sides]
    return [tuple(sorted(part.tolist())) for side in sides for part in np.array_split(side, 2)]


def appearance_order(features: Features) -> list[str]:
    """Return the objects in an order in which neighbours look alike.

    The order is that of the leaves of average linkage, optimally ordered (Bar-Joseph, Gifford and Jaakkola 2001), over
    the mean photo features of each object, standardised over the objects, of which there are at least two.
    """
    from scipy.cluster.hierarchy import leaves_list, linkage  # slow to import

    names, owner = sorted(set(features.object_ids)), features.owner
    means = np.stack([features.photo[owner == place].mean(0, dtype=np.float64) for place in range(len(names))])
    spread = means.std(0)
    scaled = (means - means.mean(0))[:, spread > 0] / spread[spread > 0]
    scaled = scaled / np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), 1e-12)
    return [names[place] for place in leaves_list(linkage(scaled, "average", optimal_ordering=True))]


def accuracy_row(measure: Measure) -> list[float]:
    """Return an accuracy, both ends of its 95 % interval, and chance."""
    means = measure.by_object()[1]
    return [float(number[0]) for number in (means.mean(0), *bootstrap_interval(means), measure.chance)]


def comparison_table(
    gallery: str, rows: Mapping[str, Sequence[float]], result: Measure, low_pass: Measure, *, across_sessions: bool
) -> dict[str, Any]:
    """Return accuracies on held-out objects in JSON types, as a checkpoint stores them.

    Args:
        gallery: What a touch is compared with.
        rows: `accuracy_row` by label.
        result: The accuracy of the model.
        low_pass: That of the control; `gain` is the difference, by object.
        across_sessions: Whether a touch is compared only with pictures of another session.
    """
    gain = result.by_object()[1] - low_pass.by_object()[1]
    ends = (float(end[0]) for end in bootstrap_interval(gain))
    return {
        "gallery": gallery,
        "rows": rows,
        "gain": [float(gain.mean()), *ends],
        "objects": len(gain),
        "touches": len(low_pass.owner),
        "across_sessions": across_sessions,
    }
