"""Files of weights: a state dict that somebody has, and those that PyTorch's hub publishes."""

import logging
from pathlib import Path
from urllib.error import URLError

import torch
from torch import Tensor

from retrieval.errors import CheckpointError

State = dict[str, Tensor]
log = logging.getLogger(__name__)


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
    and the download is checked against them. Raises CheckpointError."""
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
