"""Rows of the table: a method on towers that stand still."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

from retrieval.data.dataset import Grasp, finger_count
from retrieval.errors import DatasetError
from retrieval.methods.late_fusion import frozen_matcher
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.config import Config
from retrieval.model.fusion import Matcher
from retrieval.training.features import Features, encode_recording


@dataclass(frozen=True, eq=False)
class Towers:
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
    def of_config(cls, grasps: list[Grasp], config: Config, cache: Path, quiet: bool) -> "Towers":
        """The frozen towers of a configuration."""
        matcher = dataclasses.replace(config.matcher, fingers=finger_count(grasps))
        config = dataclasses.replace(config, matcher=matcher)
        return cls(grasps, config, frozen_matcher(config), None, cache, quiet)

    @classmethod
    def of_model(cls, grasps: list[Grasp], model: Path, cache: Path, quiet: bool) -> "Towers":
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

    def features(self, variant: str = "touch", shown: str = "photo") -> Features:
        """The features of all grasps, of this variant of the touch and of what is shown of the photo."""
        if (variant, shown) not in self._made:
            base = None if (variant, shown) == ("touch", "photo") else self.features()
            made = encode_recording(
                self.grasps,
                self.matcher,
                self.config,
                self.cache,
                variant=variant,
                shown=shown,
                photos_of=base if shown == "photo" else None,
                quiet=self.quiet,
            )
            self._made[variant, shown] = made
        return self._made[variant, shown]


@dataclass(frozen=True, eq=False)
class Row:
    """A line of the table: a method, the towers under it, and what it is called there."""

    name: str
    method: str
    towers: Towers
