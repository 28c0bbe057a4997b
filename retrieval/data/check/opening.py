"""Check the openings of the jaws: values that no gripper measures, and openings that say nothing of the object."""

from collections import defaultdict
from collections.abc import Iterator, Sequence

import numpy as np

from retrieval.data.check.pictures import Finding, findings_for
from retrieval.data.dataset import Grasp
from retrieval.data.opening import RANGE_MM, believed

_MIN_OBJECTS = 5
"""Smallest number of objects with two openings whose spreads are compared."""


def check_openings(grasps: Sequence[Grasp]) -> Iterator[Finding]:
    """Report doubtful openings of accepted grasps; grasps without an opening are left out."""
    logs, doubtful = defaultdict[str, list[float]](list), list[str]()
    for grasp in grasps:
        if (opening := believed(grasp.opening_mm)) is not None:
            logs[grasp.object_id].append(float(np.log(opening)))
        elif grasp.opening_mm is not None:
            doubtful.append(grasp.grasp_id)
    what = "the opening of the jaws is not between {:g} and {:g} millimetres (is it in metres?)".format(*RANGE_MM)
    yield from findings_for("warning", "opening", what, doubtful, grasps)
    several = [values for values in logs.values() if len(values) > 1]
    if len(several) < _MIN_OBJECTS:
        return
    within = float(np.sqrt(np.mean([np.var(values, ddof=1) for values in several])))
    between = float(np.std([np.mean(values) for values in several], ddof=1))
    if round(within, 4) >= round(between, 4):
        spread = f"by {100 * within:.0f} % among grasps of an object and by {100 * between:.0f} % among objects"
        what = f"the opening of the jaws says nothing of the object (is it the commanded one?): it differs {spread}"
        yield Finding("warning", "opening", what)
