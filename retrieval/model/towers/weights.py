"""State dicts of towers, from files or published ones."""

import socket
from importlib import resources
from pathlib import Path

import torch
from torch import Tensor

from retrieval.errors import CheckpointError

State = dict[str, Tensor]
SHIPPED = "shipped"
"""Value of init for the weights of the checkpoint in the package."""
GEL = "gel"
"""Value of init for the touch tower of the package that was trained for real gels (`gel_tower`)."""
_TIMEOUT_S = 10.0
"""Longest wait for each address of the server, and for its next bytes; without it a blocked network takes minutes."""


def gel_tower() -> Path:
    """Return the file of the package's touch tower for real gels: MobileNetV2 with the output "stages".

    It was trained on simulated presses of random surfaces by gel sensors of any make
    (`python -m models.gel_tower`).
    """
    return Path(str(resources.files("retrieval") / "shipped" / "gel-tower.safetensors"))


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
    path, timeout = Path(torch.hub.get_dir(), "checkpoints", url.rsplit("/", 1)[1]), socket.getdefaulttimeout()
    socket.setdefaulttimeout(_TIMEOUT_S)  # torch.hub sets none
    try:
        return dict(torch.hub.load_state_dict_from_url(url, map_location="cpu", check_hash=True, weights_only=True))
    except Exception as error:  # of the network, of the file or of its digest
        raise CheckpointError(
            f"ImageNet weights could not be downloaded ({error}); fetch {url} elsewhere, and name the file with "
            f"--init, or put it at {path}"
        ) from error
    finally:
        socket.setdefaulttimeout(timeout)
