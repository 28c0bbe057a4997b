"""Check the openings of the jaws: values that no gripper measures, and openings that say nothing of the object."""

from collections.abc import Iterator, Sequence

import numpy as np

from retrieval.data.check.pictures import Finding, findings_for
from retrieval.data.dataset import Grasp
from retrieval.data.opening import RANGE_MM

_MIN_OBJECTS = 5
"""Smallest number of objects with two openings whose spreads are compared."""
_MIN_DIFFERENCE_MM = 0.01
"""Smaller differences are rounding: grippers state 0.1 mm."""


def check_openings(grasps: Sequence[Grasp]) -> Iterator[Finding]:
    """Report doubtful openings of accepted grasps; grasps without an opening are left out."""
    measured = [(grasp, grasp.opening_mm) for grasp in grasps if grasp.opening_mm is not None]
    low, high = RANGE_MM
    doubtful = [grasp.grasp_id for grasp, opening in measured if not low <= opening <= high]
    metres = "; all are below 1: are they metres?" if all(opening < 1 for _, opening in measured) else ""
    what = f"the opening of the jaws is not between {low:g} and {high:g} millimetres{metres}"
    yield from findings_for("warning", "opening", what, doubtful, grasps)
    believed = [(grasp.object_id, float(np.log(opening))) for grasp, opening in measured if low <= opening <= high]
    if len({name for name, _ in believed}) < 2:
        return
    logs = np.array([opening for _, opening in believed])
    if np.ptp(np.exp(logs)) < _MIN_DIFFERENCE_MM:
        opening = f"{np.exp(logs[0]):.1f} mm"
        yield Finding(
            "warning", "opening", f"the opening of the jaws is {opening} in all grasps: is it the commanded one?"
        )
        return
    owner = np.unique([name for name, _ in believed], return_inverse=True)[1]
    counts = np.bincount(owner)
    several = counts > 1
    if several.sum() < _MIN_OBJECTS:
        return
    means = np.bincount(owner, logs) / counts
    squares = np.bincount(owner, (logs - means[owner]) ** 2)[several] / (counts[several] - 1)
    within, between = float(np.sqrt(squares.mean())), float(means[several].std(ddof=1))
    if within >= between:
        yield Finding(
            "warning",
            "opening",
            f"the opening of the jaws says nothing of the object: it differs among grasps of one object by "
            f"{100 * within:.0f} % (standard deviation of the log), among objects by {100 * between:.0f} %",
        )
