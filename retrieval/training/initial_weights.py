"""Initial weights of a matcher (random, published, from a file, or of a checkpoint), and the licences of their data."""

import dataclasses
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from retrieval.data.dataset import (
    LICENCES,
    DataLicence,
    Grasp,
    data_digest,
    recording_licence,
    recording_source,
)
from retrieval.errors import CheckpointError
from retrieval.model.card import SHIPPED_DATA, checkpoint_licences
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.checkpoint_info import read_checkpoint_info
from retrieval.model.config import Config, TrainingConfig
from retrieval.model.fusion import Matcher
from retrieval.model.shipped import shipped_model
from retrieval.model.towers import TOWER_SEPARATOR
from retrieval.model.towers.weights import GEL, SHIPPED

TOWER_WEIGHTS = ("touch_tower.", "photo_tower.")
"""Prefixes of the names of the towers' weights in a matcher."""


def build_matcher(config: Config) -> Matcher:
    """Return a matcher with the configured initial weights in both towers."""
    settings, matcher = config.training, Matcher(config.matcher, len(config.preprocessing.views))
    if settings.start:
        _start_from(matcher, Path(settings.start))
    else:
        for side, init in (("touch_tower", settings.init_touch), ("photo_tower", settings.init_photo)):
            shipped = partial(_shipped_tower, config.matcher.fingers, side)
            getattr(matcher, side).initialise(settings.tower_init(init), shipped)
    for tower in (matcher.touch_tower, matcher.photo_tower):
        tower.requires_grad_(not settings.freeze_towers)
        if settings.freeze_stem:
            tower.stem_layers().requires_grad_(False)
    return matcher


def _start_from(matcher: Matcher, path: Path) -> None:
    """Copy the weights of a checkpoint into a matcher.

    Layers outside the towers that only one of the two has keep their initial weights: the candidate encoder, the gel
    head, the layers of cells.

    Raises:
        CheckpointError: The checkpoint cannot be read, has other towers, or one of its layers has another size.
    """
    ours, theirs = matcher.state_dict(), load_checkpoint(path).matcher.state_dict()
    shared = {name: tensor for name, tensor in theirs.items() if name in ours}
    for name, tensor in ours.items():
        if shared.get(name, tensor).shape != tensor.shape or (name.startswith(TOWER_WEIGHTS) and name not in shared):
            raise CheckpointError(
                f"{path} cannot start this training: it has no {name} of shape {tuple(tensor.shape)}; use its "
                "configuration, or another checkpoint"
            )
    matcher.load_state_dict(shared, strict=False)


def _shipped_tower(fingers: int, side: str) -> dict[str, Tensor]:
    weights: dict[str, Tensor] = getattr(load_checkpoint(shipped_model(min(fingers, 2))).matcher, side).state_dict()
    return weights


def training_licences(recording: Path, settings: TrainingConfig) -> list[DataLicence]:
    """Return the licences of all data that a training with these settings uses.

    Published weights (`init = "imagenet"`) are not data of a recording and are left out.

    Raises:
        CheckpointError: The checkpoint `start` cannot be read.
    """
    found = [recording_licence(recording)]
    if settings.start:  # replaces the initial weights, which are not read
        found += checkpoint_licences(read_checkpoint_info(Path(settings.start)))
    else:
        inits = {settings.tower_init(init) for init in (settings.init_touch, settings.init_photo)}
        for name in sorted({part for init in inits for part in init.split(TOWER_SEPARATOR)} - {"random", "imagenet"}):
            found.append(SHIPPED_DATA if name in (SHIPPED, GEL) else DataLicence(name))
    return list(dict.fromkeys(found))


def made_from(recording: Path, grasps: Iterable[Grasp], licences: Iterable[DataLicence]) -> dict[str, Any]:
    """Return the entries of a model's provenance that name its data."""
    return {
        "source": recording_source(recording),
        LICENCES: [dataclasses.asdict(licence) for licence in dict.fromkeys(licences)],
        "data_digest": data_digest(grasps),
    }
