"""Conditions of the benchmark: a method on frozen towers, with touches and photos or their control inputs."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retrieval.data.dataset import Grasp, finger_count
from retrieval.errors import DatasetError
from retrieval.methods import METHODS
from retrieval.methods.cca import Cca
from retrieval.methods.late_fusion import frozen_matcher
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.config import Config
from retrieval.model.fusion import Matcher
from retrieval.training.features import Features, encode_recording


class ControlCca(Cca):
    """Method of the controls: it accepts features of any width, and principal components make it fast."""

    max_directions = 96


CONTROL_METHOD = METHODS.name_of(ControlCca)
CONTROLS = {
    "permuted": "touches are randomly assigned to other objects before fitting, so there is nothing to learn",
    "no_contact": "no-contact frames replace the touches, in fitting and in scoring",
    "order": "the input is the position of the touch in the order of capture, not its image: an upper bound on the "
    "information in sensor "
    "drift",
    "background": "only the margin of each photo is used, an eighth of each side, in fitting and in scoring",
}
_BUMPS = (4, 16, 64)


def clock_features(count: int) -> NDArray[np.float32]:
    """Encode the places 0..count-1 of an order as Gaussian bumps of three widths.

    Near places have similar features, and a linear method can distinguish distant ones.

    Returns:
        (count, F) float32.
    """
    place = np.linspace(0, 1, count)[:, None]
    bumps = [np.exp(-0.5 * ((place - np.linspace(0, 1, number)) * number) ** 2) for number in _BUMPS]
    return np.concatenate(bumps, axis=1).astype(np.float32)


def with_clock_touches(features: Features) -> Features:
    """Return the features with the order of capture in place of the touch."""
    return dataclasses.replace(features, touch=clock_features(len(features))[:, None])


def missing_no_contact_reason(grasps: Sequence[Grasp]) -> str | None:
    """Return why no-contact frames cannot replace touches; None if they can."""
    if not all(len(grasp.backgrounds) == len(grasp.touches) for grasp in grasps):
        return "the recording lacks no-contact frames"
    if len({grasp.backgrounds for grasp in grasps}) == 1:
        return "all touches share one no-contact frame, so it contains no information about the object"
    return None


@dataclass(frozen=True, eq=False)
class TowerEncoder:
    """Towers that encode a recording; each variant of touches and photos is encoded once.

    Attributes:
        grasps: The grasps of the recording.
        config: Configuration of towers and heads.
        matcher: Matcher with the towers.
        checkpoint: The model of the towers, which scores as it is; None if methods are fitted on the features.
        cache: Folder of encoded features.
        quiet: No progress on stderr.
    """

    grasps: list[Grasp]
    config: Config
    matcher: Matcher
    checkpoint: Checkpoint | None
    cache: Path
    quiet: bool
    _encoded: dict[tuple[str, str], Features] = field(default_factory=dict)

    @classmethod
    def of_config(cls, grasps: list[Grasp], config: Config, cache: Path, quiet: bool) -> "TowerEncoder":
        """Return the frozen towers of a configuration."""
        matcher = dataclasses.replace(config.matcher, fingers=finger_count(grasps))
        config = dataclasses.replace(config, matcher=matcher)
        return cls(grasps, config, frozen_matcher(config), None, cache, quiet)

    @classmethod
    def of_model(cls, grasps: list[Grasp], model: Path, cache: Path, quiet: bool) -> "TowerEncoder":
        """Return the towers of a checkpoint.

        If the model has two fingers and the recording one, both fingers get the same touch.

        Args:
            grasps: The grasps of the recording.
            model: The checkpoint.
            cache: Folder of encoded features.
            quiet: No progress on stderr.

        Raises:
            CheckpointError: The model cannot be read.
            DatasetError: The recording has more fingers than the model.
        """
        checkpoint = load_checkpoint(model)
        fingers, recorded = checkpoint.config.matcher.fingers, finger_count(grasps)
        if recorded not in (1, fingers):
            raise DatasetError(f"{model} needs {fingers} finger(s), but the recording has {recorded}.")
        if recorded < fingers:
            grasps = [
                dataclasses.replace(one, touches=one.touches * fingers, backgrounds=one.backgrounds * fingers)
                for one in grasps
            ]
        return cls(grasps, checkpoint.config, checkpoint.matcher, checkpoint, cache, quiet)

    def features(self, touch_variant: str = "touch", photo_variant: str = "photo") -> Features:
        """Return the features of all grasps, for a variant of the touches and one of the photos."""
        if (touch_variant, photo_variant) not in self._encoded:
            base = None if (touch_variant, photo_variant) == ("touch", "photo") else self.features()
            encoded = encode_recording(
                self.grasps,
                self.matcher,
                self.config,
                self.cache,
                touch_variant=touch_variant,
                photo_variant=photo_variant,
                photo_features_from=base if photo_variant == "photo" else None,
                quiet=self.quiet,
            )
            self._encoded[touch_variant, photo_variant] = encoded
        return self._encoded[touch_variant, photo_variant]


@dataclass(frozen=True, eq=False)
class BenchmarkRow:
    """A row of the result table: its name, a method, and the towers under it."""

    name: str
    method: str
    towers: TowerEncoder


@dataclass(frozen=True, eq=False)
class Condition:
    """One row with its touches and photos, or with control inputs; fitted and scored in every fold.

    Attributes:
        row: The row of the table.
        kind: "touch", "low_pass" or one of `CONTROLS`.
    """

    row: BenchmarkRow
    kind: str

    @property
    def method(self) -> str:
        """The method to fit."""
        return CONTROL_METHOD if self.kind in CONTROLS else self.row.method

    @property
    def key(self) -> str:
        """The name of its files."""
        return self.kind if self.kind in CONTROLS else f"{self.row.name}-{self.kind}"

    def features(self) -> Features:
        """Return the features to fit and score on."""
        if self.kind == "order":
            return with_clock_touches(self._tower_features())
        if self.kind == "background":
            return self._tower_features(photo_variant="margin")
        return self._tower_features({"low_pass": "low_pass", "no_contact": "no_contact"}.get(self.kind, "touch"))

    def _tower_features(self, touch_variant: str = "touch", photo_variant: str = "photo") -> Features:
        """Return the features of the towers as the method takes them: without cells, or with them."""
        towers = self.row.towers
        features = towers.features(touch_variant, photo_variant)
        return features if METHODS.load(self.method).uses_cells else features.pooled(towers.matcher)
