"""Check whether the no-contact frames or the order of capture identify the object: a model could use them, not touch.

Light and gels drift. If the objects of a recording were touched one after another, a no-contact frame shows the time of
the grasp, and the time identifies the object. The measures are leave-one-out accuracies of the nearest neighbour.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from retrieval.data.check.pictures import Finding, ImageRecords
from retrieval.data.dataset import Grasp
from retrieval.metrics.intervals import Summary, summarise
from retrieval.metrics.measure import Measure, object_means

_MAX_BY_DRIFT = 0.2
"""Threshold of (accuracy - chance) / (1 - chance)."""
_ADVICE = (
    "a model can learn drift instead of touch: touch the objects in rounds (each object once, then again), not one "
    "object after another, and compare with the controls of `retrieve evaluate`"
)


def check_drift(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Report how well the no-contact frame alone, and the order of capture alone, identify the object.

    The grasps are in the order of capture. Those of one object with the same no-contact frame count once, since a
    common frame is no drift. Without different frames only the order is reported: it does not show whether light
    changed.
    """
    by_order = _by_order(grasps)
    if by_order is None:  # no object has two grasps
        return
    frames: dict[tuple[str, ...], Grasp] = {}
    if all(len(grasp.backgrounds) == len(grasp.touches) for grasp in grasps):
        for grasp in grasps:
            frames.setdefault((grasp.object_id, *(records[path].digest for path in grasp.backgrounds)), grasp)
    different = list(frames.values())
    by_frame_order = _by_order(different)
    if by_frame_order is None:
        text = (
            f"the order of capture alone identifies the object in {_percent(by_order)}; without a separate no-contact "
            "frame for every grasp, light that identifies the object cannot be found"
        )
        yield Finding("note", "unchecked-light", f"{text}, and {_ADVICE}" if is_above_chance(by_order) else text)
        return
    small = np.array([[records[path].small for path in grasp.backgrounds] for grasp in different])
    by_frame = nearest_grasp_accuracy(small, _owners(different))
    assert by_frame is not None  # as for the order
    text = (
        f"the no-contact frames alone identify the object in {_percent(by_frame)}, the order of their capture alone in "
        f"{_percent(by_frame_order)} ({by_frame.queries} different frames of {by_frame.objects} objects)"
    )
    if is_above_chance(by_frame):
        yield Finding("warning", "drift", f"{text}: light or gel drifted, and {_ADVICE}")
    else:
        yield Finding("note", "drift", text)


def check_sessions(grasps: Sequence[Grasp]) -> Iterator[Finding]:
    """Report sessions between which no result can be tested: a single one, or sessions of different objects."""
    objects_of: dict[str | None, set[str]] = {}
    for grasp in grasps:
        objects_of.setdefault(grasp.session, set()).add(grasp.object_id)
    remedy = "collect the same objects again after the light or the gel has changed, with `retrieve collect --session`"
    if len(objects_of) == 1:
        text = "the recording has one session, or states none, so no result of it can separate touch from drift"
        yield Finding("note", "one-session", f"{text}: {remedy}")
    elif all(first.isdisjoint(second) for first, second in combinations(objects_of.values(), 2)):
        text = f"no object is in two of the {len(objects_of)} sessions, so drift may identify the objects"
        yield Finding("warning", "separate-sessions", f"{text}: {remedy}")


def _owners(grasps: Sequence[Grasp]) -> NDArray[np.int64]:
    return np.unique([grasp.object_id for grasp in grasps], return_inverse=True)[1]


def _by_order(grasps: Sequence[Grasp]) -> Summary | None:
    return nearest_grasp_accuracy(np.arange(len(grasps))[:, None], _owners(grasps)) if grasps else None


def is_above_chance(accuracy: Summary) -> bool:
    """Return whether an accuracy is far above chance (`_MAX_BY_DRIFT`), and significantly so."""
    chance = accuracy.chance[0]
    deviation = np.sqrt(chance * (1 - chance) / accuracy.queries)
    return bool(accuracy.value[0] > chance + max(_MAX_BY_DRIFT * (1 - chance), 5 * deviation))


def _percent(accuracy: Summary) -> str:
    low, high = 100 * accuracy.low[0], 100 * accuracy.high[0]
    return f"{accuracy.value[0]:.0%} [{low:.0f}, {high:.0f}] (chance {accuracy.chance[0]:.0%})"


def nearest_grasp_accuracy(
    values: NDArray[np.floating] | NDArray[np.integer], objects: NDArray[np.int64]
) -> Summary | None:
    """Return how well values (n, ...) of grasps identify their objects (n,) by the nearest other grasp.

    A query is a grasp of an object with at least two. Objects have equal weight, and equally near grasps count by
    expectation. None if there is only one object, or no object has two grasps.
    """
    others = np.bincount(objects)[objects] - 1  # grasps of the same object
    if not others.any() or others.max() == len(objects) - 1:
        return None
    flat = values.reshape(len(values), -1).astype(np.float64)
    flat = flat - flat.mean(axis=0)
    squares = (flat**2).sum(axis=1)
    rounding = 1e-12 * squares.max()
    correct = np.zeros(len(flat))
    for row in range(len(flat)):
        distances = squares - 2 * (flat @ flat[row])
        distances[row] = np.inf
        nearest = distances <= distances.min() + rounding
        correct[row] = (objects[nearest] == objects[row]).mean()
    rows = others > 0
    chance = object_means(others[rows, None] / (len(objects) - 1), objects[rows])[1].mean(axis=0)
    return summarise([Measure(correct[rows, None], objects[rows], chance, "other grasps")])
