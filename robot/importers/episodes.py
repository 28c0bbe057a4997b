"""Grasps from episodes: data sets for robot learning contain videos of contact, without labels for grasps.

An episode becomes one grasp. Its first step shows the gel without contact and the scene; the step whose gel images
differ most from the first ones is the touch. If the steps are labelled (`moments`: before, during, after, as `retrieve
export-recording` writes them), the labels decide instead. Steps are read one by one; only the first step and the step
of strongest contact so far stay in memory.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, partial
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


class Episode:
    """The pictures of one episode, read on first use of any of them."""

    def __init__(self, steps: Callable[[], Iterable[Step]], fingers: int, moments: Sequence[str] | None = None) -> None:
        """Store how to read the episode; nothing is read yet.

        Args:
            steps: Reads the steps in order of time.
            fingers: Gel images per step.
            moments: Label of each step, or None without labels.
        """
        self._steps, self._fingers, self._moments = steps, fingers, moments

    def images(self) -> Images:
        """Return the images of the grasp by column, each as a function that reads it.

        These functions raise ImporterError for an episode without a usable touch.
        """
        moments = self._moments or ("before", "during")
        columns = [
            f"touch_{finger}{MOMENT_SUFFIXES[moment]}"
            for finger in ascii_lowercase[: self._fingers]
            for moment in moments
        ]
        return {column: partial(self._picture, column) for column in ("photo", *columns)}

    def _picture(self, column: str) -> Picture:
        return self._pictures[column]

    @cached_property
    def _pictures(self) -> dict[str, Picture]:
        return dict(self._read())

    def _read(self) -> Iterator[tuple[str, Picture]]:
        steps = iter(self._steps())
        found = _labelled_steps(steps, self._moments) if self._moments else _peak_contact_steps(steps)
        photo = None
        for moment, (camera, touches) in found.items():
            photo = camera if photo is None else photo
            for finger, touch in zip(ascii_lowercase, touches, strict=False):
                yield f"touch_{finger}{MOMENT_SUFFIXES[moment]}", touch
        assert photo is not None
        yield "photo", photo


def _labelled_steps(steps: Iterator[Step], moments: Sequence[str]) -> dict[str, Step]:
    found = {moment: _copy_step(step) for moment, step in zip(moments, steps, strict=False)}
    if len(found) < len(moments):
        raise ImporterError(f"its episode has only {len(found)} of {len(moments)} steps")
    return found


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
