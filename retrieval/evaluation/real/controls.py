"""Controls of a protocol: features that hold no touch, or no object, in place of those that do."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from retrieval.data.dataset import Grasp
from retrieval.training.features import Features

CONTROL_METHOD = "cca_pca"
"""By which controls are asked; it takes features of any length."""
CONTROLS = {
    "dealt": "touches are dealt to other objects before fitting, so that there is nothing to learn",
    "untouched": "the frames of the untouched gel stand in for the touch, in fitting and in judging",
    "order": "the place of the touch in the order of capture stands in for it: what a perfect clock could tell, and so "
    "the most that drift of the sensor could",
    "background": "of each photo its margin alone is shown, an eighth of each side, in fitting and in judging",
}
_BUMPS = (4, 16, 64)


def clock(count: int) -> NDArray[np.float32]:
    """(count, F): the place of each of so many grasps in their order, as bumps of three widths along it, so that near
    places are alike and a linear method can tell far ones."""
    place = np.linspace(0, 1, count)[:, None]
    bumps = [np.exp(-0.5 * ((place - np.linspace(0, 1, number)) * number) ** 2) for number in _BUMPS]
    return np.concatenate(bumps, axis=1).astype(np.float32)


def by_clock(features: Features) -> Features:
    """The features with the order of capture in place of the touch."""
    return dataclasses.replace(features, touch=clock(len(features))[:, None])


def why_not_untouched(grasps: Sequence[Grasp]) -> str | None:
    """Why the untouched frames of a recording cannot stand in for touches; None where they can."""
    if not all(len(grasp.backgrounds) == len(grasp.touches) for grasp in grasps):
        return "the recording lacks untouched frames"
    if len({grasp.backgrounds for grasp in grasps}) == 1:
        return "one untouched frame serves all touches; it is the same for each, and so says nothing of any"
    return None
