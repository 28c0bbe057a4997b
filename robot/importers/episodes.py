"""Grasps from episodes: data sets for robot learning contain videos of contact, without labels for grasps.

An episode becomes one grasp. Its first step shows the gel without contact and the scene; the step whose gel images
differ most from the first ones is the touch. If the steps are labelled (`moments`: before, during, after, as `retrieve
export-recording` writes them), the labels decide instead. Steps are read one by one; only the first step and the step
of strongest contact so far stay in memory.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, partial
from string import ascii_lowercase

import numpy as np
from numpy.typing import NDArray

from robot.errors import ImporterError
from robot.importers.importing import Images

Picture = NDArray[np.uint8]
"""(H, W, 3), red first."""
Step = tuple[Picture, Sequence[Picture]]
"""The camera picture, and one gel image per finger."""

MOMENT_SUFFIXES = {"before": "_before", "during": "", "after": "_after"}
"""Suffix of the columns of each moment."""


def episode_images(steps: Callable[[], Iterable[Step]], fingers: int, labels: Sequence[str] | None = None) -> Images:
    """Return the images of an episode's grasp by column, each as a function that reads it.

    The episode is read once, on first use of any image. These functions raise ImporterError for an episode without a
    usable touch.

    Args:
        steps: Reads the steps in order of time.
        fingers: Gel images per step.
        labels: Moment of each step; None without labels.
    """
    moments = labels or ("before", "during")

    @cache
    def read() -> dict[str, Picture]:
        if labels:
            found = {moment: _copy_step(step) for moment, step in zip(labels, steps(), strict=False)}
            if len(found) < len(labels):
                raise ImporterError(f"its episode has only {len(found)} of {len(labels)} steps")
        else:
            found = _peak_contact_steps(iter(steps()))
        touches = {
            f"touch_{finger}{MOMENT_SUFFIXES[moment]}": touch
            for moment, (_, gels) in found.items()
            for finger, touch in zip(ascii_lowercase, gels, strict=False)
        }
        return {"photo": next(iter(found.values()))[0], **touches}

    columns = [f"touch_{finger}{MOMENT_SUFFIXES[moment]}" for finger in ascii_lowercase[:fingers] for moment in moments]
    return {column: partial(lambda name: read()[name], column) for column in ("photo", *columns)}


def _peak_contact_steps(steps: Iterator[Step]) -> dict[str, Step]:
    first = next(steps, None)
    if first is None:
        raise ImporterError("its episode is empty")
    first = _copy_step(first)
    no_contact = [touch.astype(np.int16) for touch in first[1]]
    strongest, largest_change = first, 0.0
    for step in steps:
        if [touch.shape for touch in step[1]] != [frame.shape for frame in no_contact]:
            raise ImporterError("the gel images of its episode differ in size")
        change = sum(float(np.abs(touch - frame).mean()) for touch, frame in zip(step[1], no_contact, strict=True))
        if change > largest_change:
            strongest, largest_change = _copy_step(step), change
    if not largest_change:
        raise ImporterError("no gel image of its episode differs from the first")
    return {"before": first, "during": strongest}


def _copy_step(step: Step) -> Step:
    """Copy a step, so that the block of steps that it was read with can be freed."""
    return step[0].copy(), [touch.copy() for touch in step[1]]
