"""Lines of the benchmark: a method on frozen towers, and what stands for touch and photo in it."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retrieval.data.dataset import Grasp, finger_count
from retrieval.errors import DatasetError
from retrieval.methods.late_fusion import frozen_matcher
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.config import Config
from retrieval.model.fusion import Matcher
from retrieval.training.features import Features, encode_recording

CONTROL_METHOD = "cca_pca"
"""By which controls are asked; it takes features of any length."""
CONTROLS = {
    "permuted": "touches are dealt to other objects before fitting, so that there is nothing to learn",
    "no_contact": "the frames of the untouched gel stand in for the touch, in fitting and in judging",
    "order": "the place of the touch in the order of capture stands in for it: what a perfect clock could tell, and so "
    "the most that drift of the sensor could",
    "background": "of each photo its margin alone is shown, an eighth of each side, in fitting and in judging",
}
_BUMPS = (4, 16, 64)


def clock_features(count: int) -> NDArray[np.float32]:
    """(count, F): the place of each of so many grasps in their order, as bumps of three widths along it, so that near
    places are alike and a linear method can tell far ones.
    """
    place = np.linspace(0, 1, count)[:, None]
    bumps = [np.exp(-0.5 * ((place - np.linspace(0, 1, number)) * number) ** 2) for number in _BUMPS]
    return np.concatenate(bumps, axis=1).astype(np.float32)


def with_clock_touches(features: Features) -> Features:
    """The features with the order of capture in place of the touch."""
    return dataclasses.replace(features, touch=clock_features(len(features))[:, None])


def missing_no_contact_reason(grasps: Sequence[Grasp]) -> str | None:
    """Why the untouched frames of a recording cannot stand in for touches; None where they can."""
    if not all(len(grasp.backgrounds) == len(grasp.touches) for grasp in grasps):
        return "the recording lacks untouched frames"
    if len({grasp.backgrounds for grasp in grasps}) == 1:
        return "one untouched frame serves all touches; it is the same for each, and so says nothing of any"
    return None


@dataclass(frozen=True, eq=False)
class TowerEncoder:
    """Towers that make the features of a recording, each kind once.

    checkpoint: the model that they are of, which is asked as it is; None where methods are fitted on their features.
    """

    grasps: list[Grasp]
    config: Config
    matcher: Matcher
    checkpoint: Checkpoint | None
    cache: Path
    quiet: bool
    _made: dict[tuple[str, str], Features] = field(default_factory=dict)

    @classmethod
    def of_config(cls, grasps: list[Grasp], config: Config, cache: Path, quiet: bool) -> "TowerEncoder":
        """The frozen towers of a configuration."""
        matcher = dataclasses.replace(config.matcher, fingers=finger_count(grasps))
        config = dataclasses.replace(config, matcher=matcher)
        return cls(grasps, config, frozen_matcher(config), None, cache, quiet)

    @classmethod
    def of_model(cls, grasps: list[Grasp], model: Path, cache: Path, quiet: bool) -> "TowerEncoder":
        """The towers of a checkpoint. Where it has two fingers and the recording one, both are shown that one's touch.

        Raises CheckpointError, and DatasetError where the recording has more fingers.
        """
        checkpoint = load_checkpoint(model)
        wanted, there = checkpoint.config.matcher.fingers, finger_count(grasps)
        if there not in (1, wanted):
            raise DatasetError(f"{model} was made for {wanted} finger(s), and the recording has {there}")
        if there < wanted:
            grasps = [
                dataclasses.replace(one, touches=one.touches * wanted, backgrounds=one.backgrounds * wanted)
                for one in grasps
            ]
        return cls(grasps, checkpoint.config, checkpoint.matcher, checkpoint, cache, quiet)

    def features(self, touch_variant: str = "touch", photo_variant: str = "photo") -> Features:
        """The features of all grasps, of this variant of the touch and of what is shown of the photo."""
        if (touch_variant, photo_variant) not in self._made:
            base = None if (touch_variant, photo_variant) == ("touch", "photo") else self.features()
            made = encode_recording(
                self.grasps,
                self.matcher,
                self.config,
                self.cache,
                touch_variant=touch_variant,
                photo_variant=photo_variant,
                photo_features_from=base if photo_variant == "photo" else None,
                quiet=self.quiet,
            )
            self._made[touch_variant, photo_variant] = made
        return self._made[touch_variant, photo_variant]


@dataclass(frozen=True, eq=False)
class BenchmarkRow:
    """A line of the table: a method, the towers under it, and what it is called there."""

    name: str
    method: str
    towers: TowerEncoder


@dataclass(frozen=True, eq=False)
class Condition:
    """What is fitted and asked in every fold: a row of the table, and what stands for touch and photo in it.

    kind: "touch", "blurred" or one of `CONTROLS`.
    """

    row: BenchmarkRow
    kind: str

    @property
    def method(self) -> str:
        """The method that is fitted."""
        return CONTROL_METHOD if self.kind in CONTROLS else self.row.method

    @property
    def key(self) -> str:
        """What files of it are called."""
        return self.kind if self.kind in CONTROLS else f"{self.row.name}-{self.kind}"

    def features(self) -> Features:
        """What it is fitted on and asked."""
        towers = self.row.towers
        if self.kind == "order":
            return with_clock_touches(towers.features())
        if self.kind == "background":
            return towers.features(photo_variant="margin")
        return towers.features({"low_pass": "low_pass", "no_contact": "no_contact"}.get(self.kind, "touch"))
