"""Grasps from episodes: data sets for robot learning contain videos of contact, without labels for grasps.

An episode becomes one grasp. Its first step shows the gel without contact and the scene; the step whose gel images
differ most from the first ones is the touch. First steps that a camera delivers black, dim or in another colour are
left out and counted. If the steps are labelled (`moments`: before, during, after, as `retrieve export-recording` writes
them), the labels decide instead. Steps are read one by one; only the first step and the step of strongest contact so
far stay in memory.
"""

import itertools
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from string import ascii_lowercase
from typing import Any

import cv2
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

_CELLS, _NOISE_LEVELS, _DARK_LEVELS = 8, 8, 10
_UNLIKE_SHARE = 0.5
_MAX_LEFT_OUT = 30


def thumbnail(picture: Picture) -> Picture:
    """Return the means of 8 x 8 cells of a picture, (8, 8, 3), for `first_usable`."""
    return np.asarray(cv2.resize(picture, (_CELLS, _CELLS), interpolation=cv2.INTER_AREA), np.uint8)


def first_usable(thumbnails: Sequence[Picture]) -> int | None:
    """Return the number of a camera's first usable frame, which shows its gel without contact; None without one.

    Many cameras deliver black, dim or blue frames first. Such a frame differs over half of its area from nearly all
    later ones, while the gel without contact is seen again; and its colours are those of another frame with a gain and
    an offset, which contact does not do. Left out are black frames, and such ones among the first tenth of the frames,
    at most 30.
    """
    frames = np.array(thumbnails, np.int16)
    is_dark = frames.max((1, 2, 3)) < _DARK_LEVELS
    dark = int(np.argmin(is_dark))
    if is_dark[dark:].mean() > 1 / 8:  # its gel is that dark
        dark = 0
    frames = frames[dark:]
    if len(frames) < 4:
        return dark
    leading = max(1, min(_MAX_LEFT_OUT, len(frames) // 10)) + 1
    later = frames[leading :: 1 + len(frames) // 1000]
    changed = ((np.abs(later - frame).max(-1) > _NOISE_LEVELS).mean((1, 2)) for frame in frames[:leading])
    unlike = np.sort(list(changed))  # (first frame, later frame), the most similar ones first
    if unlike[0, len(later) // 20] < _UNLIKE_SHARE:
        return dark
    common = unlike[:, len(later) // 8]  # more of the later frames than those that follow a slow change at once
    usable = int(np.argmax(common <= common.min() + 0.01))
    if common.min() >= _UNLIKE_SHARE:
        return None if _is_relit(frames[0], np.median(later, axis=0)) else dark
    return dark + usable if all(_is_relit(frame, frames[usable]) for frame in frames[:usable]) else dark


def _is_relit(frame: NDArray[Any], other: NDArray[Any]) -> bool:
    """Whether a gain and an offset of each colour convert those cells of the other frame that differ to `frame`'s."""
    unlike = np.abs(frame - other).max(-1) > _NOISE_LEVELS
    for cells, others in zip(frame[unlike].T, other[unlike].T, strict=True):
        gain, offset = np.linalg.lstsq(np.stack([others, np.ones(len(others))], 1), cells, rcond=None)[0]
        if np.abs(gain * others + offset - cells).mean() > _NOISE_LEVELS / 4:
            return False
    return True


NO_USABLE_FRAME = "its first gel images are unlike all later ones, so none of them can be the no-contact frame"


def episode_images(
    steps: Callable[[], Iterable[Step]],
    fingers: int,
    labels: Sequence[str] | None = None,
    left_out: Callable[[int], object] = lambda number: None,
) -> Images:
    """Return the images of an episode's grasp by column, each as a function that reads it.

    The episode is read once, on first use of any image. These functions raise ImporterError for an episode without a
    usable touch.

    Args:
        steps: Reads the steps in order of time.
        fingers: Gel images per step.
        labels: Moment of each step; None without labels.
        left_out: Called with the number of first steps that were left out, if any were.
    """
    moments = labels or ("before", "during")

    @cache
    def read() -> dict[str, Picture]:
        if labels:
            found = {moment: _copy_step(step) for moment, step in zip(labels, steps(), strict=False)}
            if len(found) < len(labels):
                raise ImporterError(f"its episode has only {len(found)} of {len(labels)} steps")
        else:
            start, found = _peak_contact_steps(steps(), 0)
            if start:
                left_out(start)
                _, found = _peak_contact_steps(steps(), start)
        touches = {
            f"touch_{finger}{MOMENT_SUFFIXES[moment]}": touch
            for moment, (_, gels) in found.items()
            for finger, touch in zip(ascii_lowercase, gels, strict=False)
        }
        return {"photo": next(iter(found.values()))[0], **touches}

    columns = [f"touch_{finger}{MOMENT_SUFFIXES[moment]}" for finger in ascii_lowercase[:fingers] for moment in moments]
    return {column: partial(lambda name: read()[name], column) for column in ("photo", *columns)}


def _peak_contact_steps(steps: Iterable[Step], start: int) -> tuple[int, dict[str, Step]]:
    """Return the number of the first usable step, and the moments of the steps from `start` on."""
    remaining = itertools.islice(steps, start, None)
    first = next(remaining, None)
    if first is None:
        raise ImporterError("its episode is empty")
    first = _copy_step(first)
    no_contact = [touch.astype(np.int16) for touch in first[1]]
    strongest, largest_change = first, 0.0
    thumbnails = [[thumbnail(picture)] for picture in (first[0], *first[1])]
    for step in remaining:
        if [touch.shape for touch in step[1]] != [frame.shape for frame in no_contact]:
            raise ImporterError("the gel images of its episode differ in size")
        for of_camera, picture in zip(thumbnails, (step[0], *step[1]), strict=True):
            of_camera.append(thumbnail(picture))
        change = sum(float(np.abs(touch - frame).mean()) for touch, frame in zip(step[1], no_contact, strict=True))
        if change > largest_change:
            strongest, largest_change = _copy_step(step), change
    if not largest_change:
        raise ImporterError("no gel image of its episode differs from the first")
    photo, *gels = map(first_usable, thumbnails)
    if None in gels:
        raise ImporterError(NO_USABLE_FRAME)
    # A camera that moves may see nothing twice.
    return max(photo or 0, *(number or 0 for number in gels)), {"before": first, "during": strongest}


def _copy_step(step: Step) -> Step:
    """Copy a step, so that the block of steps that it was read with can be freed."""
    return step[0].copy(), [touch.copy() for touch in step[1]]
