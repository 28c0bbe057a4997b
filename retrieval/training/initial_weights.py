"""The initial weights of a matcher: random, published, from a file, or of a checkpoint."""

from functools import partial
from pathlib import Path

from torch import Tensor, nn

from retrieval.errors import CheckpointError
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.config import Config
from retrieval.model.fusion import Matcher
from retrieval.model.shipped import shipped_model

TOWER_WEIGHTS = ("touch_tower.", "photo_tower.")
"""Prefixes of the names of the towers' weights in a matcher."""


def build_matcher(config: Config) -> Matcher:
    """Return a matcher with the configured initial weights in both towers."""
    settings, matcher = config.training, Matcher(config.matcher, len(config.preprocessing.views))
    if settings.start:
        _start_from(matcher, Path(settings.start))
    else:
        for tower, init, side in (
            (matcher.touch_tower, settings.init_touch, "touch_tower"),
            (matcher.photo_tower, settings.init_photo, "photo_tower"),
        ):
            shipped = partial(_shipped_tower, config.matcher.fingers, side)
            tower.initialise(settings.tower_init(init), shipped)
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
    if missing := [name for name in ours if name.startswith(TOWER_WEIGHTS) and name not in theirs]:
        raise CheckpointError(
            f"{path} cannot start this training: it has no {missing[0]}; use its configuration, whose towers are of "
            "the same kind, or another checkpoint"
        )
    shared = {name: tensor for name, tensor in theirs.items() if name in ours}
    for name, tensor in shared.items():
        if tensor.shape != ours[name].shape:
            raise CheckpointError(
                f"{path} cannot start this training: {name} is {tuple(tensor.shape)}, must be "
                f"{tuple(ours[name].shape)}; "
                "use the configuration of that checkpoint, or another checkpoint"
            )
    matcher.load_state_dict(shared, strict=False)


def _shipped_tower(fingers: int, side: str) -> dict[str, Tensor]:
    checkpoint = load_checkpoint(shipped_model(min(fingers, 2)))
    tower: nn.Module = getattr(checkpoint.matcher, side)
    return tower.state_dict()
