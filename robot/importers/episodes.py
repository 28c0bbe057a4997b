"""Grasps out of episodes: data sets for robot learning hold films of touching, and no grasp is marked in them.

Of an episode one grasp is taken: its first step shows the untouched gel and the scene, and the step whose gel images
differ most from those of the first is the touch. An episode whose steps say what they are (`moments`: before, during,
after, as `retrieve export-recording` writes it) is taken at its word. Steps come one after the other; only the first
one and the one that is most pressed so far are held.
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
"""The camera's picture, and one gel image a finger."""

MOMENT_SUFFIXES = {"before": "_before", "during": "", "after": "_after"}
"""What the columns of a moment end in."""


class Episode:
    """The pictures of one episode, read when the first of them is asked for.

    steps: reads them. moments: what each of them is, or None where nobody says. Reading raises ImporterError.
    """

    def __init__(self, steps: Callable[[], Iterable[Step]], fingers: int, moments: Sequence[str] | None) -> None:
        self._steps, self._fingers, self._moments = steps, fingers, moments

    def images(self) -> Images:
        """Columns of the grasp, each made when it is its turn."""
        moments = self._moments or ("before", "during")
        columns = [
            f"touch_{finger}{MOMENT_SUFFIXES[m]}" for finger in ascii_lowercase[: self._fingers] for m in moments
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
        raise ImporterError(f"its episode has {len(found)} steps of {len(moments)}")
    return found


def _peak_contact_steps(steps: Iterator[Step]) -> dict[str, Step]:
    first = next(steps, None)
    if first is None:
        raise ImporterError("its episode is empty")
    first = _copy_step(first)
    rest = [touch.astype(np.int16) for touch in first[1]]
    best, most = first, 0.0
    for step in steps:
        if [touch.shape for touch in step[1]] != [still.shape for still in rest]:
            raise ImporterError("the gel images of its episode differ in size")
        pressed = sum(float(np.abs(touch - still).mean()) for touch, still in zip(step[1], rest, strict=True))
        if pressed > most:
            best, most = _copy_step(step), pressed
    if not most:
        raise ImporterError("no gel image of its episode differs from the first")
    return {"before": first, "during": best}


def _copy_step(step: Step) -> Step:
    """Apart from the block of steps that it was read with."""
    return step[0].copy(), [touch.copy() for touch in step[1]]
