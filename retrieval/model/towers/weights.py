"""Initial weights of a tower: random, from a file, or published ones."""

import logging
from collections.abc import Callable
from importlib import resources
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
"""Value of init for the weights of the checkpoint in the package."""
GEL = "gel"
"""Value of init for the touch tower of the package that was trained for real gels (`gel_tower`)."""
log = logging.getLogger(__name__)


def initialise_tower(tower: "Tower", init: str, shipped: Callable[[], State] | None = None) -> None:
    """Give `tower` its initial weights.

    Args:
        tower: A tower, or concatenated ones.
        init: "random" leaves it as built. "imagenet" loads the published weights (`Tower.published_weights`), "shipped"
            those of `shipped`, "gel" the file `gel_tower`. Anything else is the path of a .pth, .pt or .safetensors
            state dict with the tower's key names, which for our own towers are torchvision's. Concatenated towers take
            one value for all, or one each, joined by `TOWER_SEPARATOR`.
        shipped: Returns the state dict for "shipped".

    Raises:
        CheckpointError: A file is missing, damaged or of another architecture.
    """
    from retrieval.model.towers.concatenated import ConcatenatedTowers  # a tower, which imports this module

    if init == "random":
        return
    if isinstance(tower, ConcatenatedTowers):
        inits, count = init.split(TOWER_SEPARATOR), len(tower.parts)
        if len(inits) not in (1, count):
            raise CheckpointError(
                f"{count} concatenated towers need initial weights each, joined by {TOWER_SEPARATOR!r}; got {init!r}"
            )
        for part, part_init in zip(tower.parts, inits * (count // len(inits)), strict=True):
            initialise_tower(part, part_init, shipped)  # type: ignore[arg-type]
        return
    if init == SHIPPED and shipped is not None:
        load_tower_state(tower, shipped(), "the shipped checkpoint")
        return
    if init == GEL:
        load_tower_state(tower, read_state(gel_tower()), "the gel tower of the package")
        return
    state = tower.published_weights() if init == "imagenet" else read_state(Path(init))
    load_tower_state(tower, state, f"the published {type(tower).__name__}" if init == "imagenet" else init)


def gel_tower() -> Path:
    """Return the file of the package's touch tower for real gels: MobileNetV2 with the output "stages".

    It was trained on simulated presses of random surfaces by gel sensors of any make
    (`python -m models.gel_tower`).
    """
    return Path(str(resources.files("retrieval") / "shipped" / "gel-tower.safetensors"))


def load_tower_state(tower: "Tower", state: State, source: str) -> None:
    """Load `state` into `tower`. Every layer must fit; either side may lack an optional one."""
    state = tower.rename_state(state)
    own = tower.state_dict()
    optional, classes = tower.optional_prefixes, tower.optional_prefixes[:1]
    unknown = [key for key in state if key not in own and not key.startswith(optional)]
    missing = [key for key in own if key not in state and not key.startswith(classes)]
    if unknown or missing:
        problem = f"lacks {missing[0]}" if missing else f"has an unknown {unknown[0]}"
        raise CheckpointError(f"{source} does not fit {type(tower).__name__}: it {problem}; name the tower it is for")
    shapes = [key for key in own if key in state and state[key].shape != own[key].shape]
    if shapes:
        got, expected = tuple(state[shapes[0]].shape), tuple(own[shapes[0]].shape)
        raise CheckpointError(f"{source} does not fit {type(tower).__name__}: {shapes[0]} is {got}, must be {expected}")
    if bad := [key for key in own if key in state and not bool(torch.isfinite(state[key]).all())]:
        raise CheckpointError(f"{source} contains a NaN or infinite weight in {bad[0]}; give another file")
    if any(key.startswith(classes) and key not in state for key in own):
        log.warning("%s has no 1000-way layer: this layer is initialised randomly", source)
    tower.load_state_dict({key: state.get(key, value) for key, value in own.items()})


def read_state(path: Path) -> State:
    """Read a state dict without unpickling anything but tensors."""
    if not path.is_file():
        raise CheckpointError(f"initial weights must be a file; there is none at {path}")
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # third-party loaders raise a dozen kinds; all mean the same to the user
        # PyTorch's message is long, and advises the user to unpickle the file.
        raise CheckpointError(f"{path} is not a readable state dict ({type(error).__name__})") from error
    if not isinstance(state, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in state.items()
    ):
        raise CheckpointError(f"{path} must contain a plain state dict (name -> tensor); got {type(state).__name__}")
    return dict(state)


def download(url: str) -> State:
    """Read a published state dict, downloaded once into PyTorch's cache.

    The eight digits in its name begin its SHA-256; the download is checked against them.

    Raises:
        CheckpointError: The download fails or is damaged.
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
    except RuntimeError as error:  # torch's error for a wrong hash
        raise CheckpointError(f"the download of {url} is damaged ({error}); try again") from error
    return read_state(path)
