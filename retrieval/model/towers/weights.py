"""Where a tower's first weights come from: random, a file, or what is published for it."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.error import URLError

import torch
from torch import Tensor

from retrieval.errors import CheckpointError
from retrieval.model.towers import TOWER_SEPARATOR

if TYPE_CHECKING:
    from retrieval.model.towers.tower import Tower

State = dict[str, Tensor]
SHIPPED = "shipped"
"""In place of first weights: those of the checkpoint that comes with the package."""
log = logging.getLogger(__name__)


def initialise_tower(tower: "Tower", init: str, shipped: Callable[[], State] | None = None) -> None:
    """Give `tower` its first weights.

    init: "random" leaves it as built, "imagenet" takes the weights that are published for it (`Tower.published_weights`),
    "shipped" is what the caller knows as that, anything else is the path of a .pth, .pt or .safetensors state dict with
    the tower's key names, which are torchvision's for our own. Towers side by side take one for all of them, or as
    many, joined alike. Raises CheckpointError where a file is missing, damaged or of another architecture.
    """
    from retrieval.model.towers.concatenated import ConcatenatedTowers  # a tower, which imports this module

    if init == "random":
        return
    if isinstance(tower, ConcatenatedTowers):
        inits, count = init.split(TOWER_SEPARATOR), len(tower.parts)
        if len(inits) not in (1, count):
            raise CheckpointError(
                f"{count} towers side by side take first weights for each, joined by {TOWER_SEPARATOR!r}; got {init!r}"
            )
        for part, its_init in zip(tower.parts, inits * (count // len(inits)), strict=True):
            initialise_tower(part, its_init, shipped)  # type: ignore[arg-type]
        return
    if init == SHIPPED and shipped is not None:
        load_tower_state(tower, shipped(), "the shipped checkpoint")
        return
    state = tower.published_weights() if init == "imagenet" else read_state(Path(init))
    load_tower_state(tower, state, f"the published {type(tower).__name__}" if init == "imagenet" else init)


def load_tower_state(tower: "Tower", state: State, source: str) -> None:
    """Load `state` into `tower`: every layer must fit, save that either side may lack an optional one."""
    state = tower.rename_state(state)
    wanted = tower.state_dict()
    optional, classes = tower.optional_prefixes, tower.optional_prefixes[:1]
    unknown = [key for key in state if key not in wanted and not key.startswith(optional)]
    missing = [key for key in wanted if key not in state and not key.startswith(classes)]
    if unknown or missing:
        what = f"lacks {missing[0]}" if missing else f"has an unknown {unknown[0]}"
        raise CheckpointError(f"{source} does not fit {type(tower).__name__}: it {what}; name the tower it is for")
    shapes = [key for key in wanted if key in state and state[key].shape != wanted[key].shape]
    if shapes:
        got, want = tuple(state[shapes[0]].shape), tuple(wanted[shapes[0]].shape)
        raise CheckpointError(f"{source} does not fit {type(tower).__name__}: {shapes[0]} is {got}, must be {want}")
    if bad := [key for key in wanted if key in state and not bool(torch.isfinite(state[key]).all())]:
        raise CheckpointError(f"{source} holds a NaN or infinite weight in {bad[0]}; give another file")
    if any(key.startswith(classes) and key not in state for key in wanted):
        log.warning("%s has no 1000-way layer; that layer starts random", source)
    tower.load_state_dict({key: state.get(key, value) for key, value in wanted.items()})


def read_state(path: Path) -> State:
    """Read a state dict without unpickling anything but tensors."""
    if not path.is_file():
        raise CheckpointError(f"initial weights must be a file; there is none at {path}")
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # third-party loaders raise a dozen kinds; each means the same to the user
        # What PyTorch says is long, and advises to unpickle the file after all.
        raise CheckpointError(f"{path} is not a readable state dict ({type(error).__name__})") from error
    if not isinstance(state, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in state.items()
    ):
        raise CheckpointError(f"{path} must hold a plain state dict (name -> tensor); got {type(state).__name__}")
    return dict(state)


def download(url: str) -> State:
    """Read a published state dict, fetched once into PyTorch's cache. The eight digits in its name begin its SHA-256,
    and the download is checked against them. Raises CheckpointError.
    """
    path = Path(torch.hub.get_dir()) / "checkpoints" / url.rsplit("/", 1)[1]
    if path.is_file():
        return read_state(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    log.warning("downloading %s to %s", url, path)
    try:
        torch.hub.download_url_to_file(url, str(path), hash_prefix=path.stem.rsplit("-", 1)[1], progress=True)
    except (URLError, OSError) as error:
        raise CheckpointError(
            f"ImageNet weights could not be downloaded ({error}); fetch {url} elsewhere and put it at {path}"
        ) from error
    except RuntimeError as error:  # torch reports a wrong hash so
        raise CheckpointError(f"the download of {url} is damaged ({error}); try again") from error
    return read_state(path)
