"""Checks whether light, gel or the order of capture identify the object, so that a model may use them instead of touch.

Light and gels drift. If the objects of a recording were touched one after another, a no-contact frame shows the time of
the grasp, and the time identifies the object. The measures are leave-one-out accuracies of the nearest neighbour.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retrieval.data.check.findings import Finding, ImageRecords
from retrieval.data.dataset import Grasp
from retrieval.metrics.intervals import summarise
from retrieval.metrics.measure import Measure, object_means

_MAX_BY_DRIFT, _MAX_BY_TOUCH = 0.2, 0.6
"""Thresholds of (accuracy - chance) / (1 - chance): the first one on no-contact frames and on the order of capture, the
second one on the mean colour of touches. The mean colour depends a little on the touched object (0.2 to 0.35 on
simulated recordings)."""
_ADVICE = (
    "a model can learn drift instead of touch: touch the objects in rounds (each object once, then again), not one "
    "object after another, and compare with the controls of `retrieve evaluate`"
)


def check_light(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Report how well the no-contact frame alone, and the order of capture alone, identify the object.

    Grasps of one object with the same no-contact frame count once, since a common frame is no drift. If these measures
    are low or undefined, the mean colour of the touch must not identify the object either.

    Args:
        grasps: Grasps in the order of capture.
        records: Data of their pictures.
    """
    owners = np.unique([grasp.object_id for grasp in grasps], return_inverse=True)[1]
    by_order = nearest_grasp_accuracy(np.arange(len(grasps))[:, None], owners) if grasps else None
    if by_order is None:
        yield Finding(
            "note", "unchecked-light", "light that identifies the object cannot be checked: no object has two grasps"
        )
        return
    drift = _check_no_contact_frames(grasps, records) or _check_order(by_order)
    yield drift
    if drift.severity == "warning":
        return
    fingers = range(min(len(grasp.touches) for grasp in grasps))
    colours = [[records[grasp.touches[finger]].small for finger in fingers] for grasp in grasps]
    by_colour = nearest_grasp_accuracy(np.array(colours).mean(axis=(2, 3)), owners)
    if by_colour is not None and by_colour.exceeds_chance(_MAX_BY_TOUCH):
        yield Finding(
            "warning",
            "light",
            f"the mean colour of the touch alone identifies the object in {by_colour}: light or gel changed from "
            f"object to object, and {_ADVICE}",
        )


def _check_no_contact_frames(grasps: Sequence[Grasp], records: ImageRecords) -> Finding | None:
    """Return the finding on no-contact frames and their order, or None if no object has two different ones."""
    if any(len(grasp.backgrounds) != len(grasp.touches) for grasp in grasps):
        return None
    frames: dict[tuple[str, ...], Grasp] = {}
    for grasp in grasps:
        frames.setdefault((grasp.object_id, *(records[path].digest for path in grasp.backgrounds)), grasp)
    names, owners = np.unique([grasp.object_id for grasp in frames.values()], return_inverse=True)
    small = [[records[path].small for path in grasp.backgrounds] for grasp in frames.values()]
    found = nearest_grasp_accuracy(np.array(small), owners)
    by_order = nearest_grasp_accuracy(np.arange(len(frames))[:, None], owners)
    if found is None or by_order is None:
        return None
    text = (
        f"the no-contact frames alone identify the object in {found}, the order of their capture alone in {by_order} "
        f"({found.queries} different frames of {found.objects} objects)"
    )
    if left_out := len(names) - found.objects:
        text += f"; {left_out} object(s) with one no-contact frame for all grasps are left out"
    if found.exceeds_chance(_MAX_BY_DRIFT):
        return Finding("warning", "drift", f"{text}: light or gel drifted, and {_ADVICE}")
    return Finding("note", "drift", text)


def _check_order(by_order: "NearestGraspAccuracy") -> Finding:
    """Return the finding on the order of capture of a recording without different no-contact frames."""
    text = (
        f"the order of capture alone identifies the object in {by_order}; without a separate no-contact frame for "
        "every grasp, light that identifies the object is found only if its effect is strong"
    )
    return Finding(
        "note", "unchecked-light", f"{text}, and {_ADVICE}" if by_order.exceeds_chance(_MAX_BY_DRIFT) else text
    )


# Statistics --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NearestGraspAccuracy:
    """Leave-one-out accuracy of identifying a grasp's object by the nearest other grasp; objects have equal weight.

    Attributes:
        accuracy: Mean over objects of the fraction of grasps whose nearest other grasp has the same object.
        low: Lower end of its 95 % interval, which resamples objects.
        high: Upper end.
        chance: Expected accuracy by chance.
        queries: Number of grasps of objects with at least two.
        objects: Number of these objects.
    """

    accuracy: float
    low: float
    high: float
    chance: float
    queries: int
    objects: int

    def exceeds_chance(self, part: float) -> bool:
        """Return whether accuracy is more than `part` of the way from chance to 1, and significantly above chance."""
        deviation = np.sqrt(self.chance * (1 - self.chance) / self.queries)
        return bool(self.accuracy > self.chance + max(part * (1 - self.chance), 5 * deviation))

    def __str__(self) -> str:
        interval = f"[{100 * self.low:.0f}, {100 * self.high:.0f}]"
        return f"{self.accuracy:.0%} {interval} (chance {self.chance:.0%})"


def nearest_grasp_accuracy(
    values: NDArray[np.floating] | NDArray[np.integer], objects: NDArray[np.int64]
) -> NearestGraspAccuracy | None:
    """Return how well values of grasps identify their objects by the nearest other grasp.

    Equally near grasps count by expectation.

    Args:
        values: (n, ...) values of the grasps.
        objects: (n,) object numbers.

    Returns:
        The accuracy, or None if there is only one object, or no object has two grasps.
    """
    others = np.bincount(objects)[objects] - 1
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
    found = summarise([Measure(correct[rows, None], objects[rows], chance, "other grasps")])
    return NearestGraspAccuracy(
        found["value"][0], found["low"][0], found["high"][0], float(chance[0]), found["queries"], found["objects"]
    )
