"""The checkpoints of the package, trained on the simulated rig."""

from importlib import resources
from pathlib import Path

from retrieval.errors import BadInput

SHIPPED = {2: "simulated-mobilenet.safetensors", 1: "simulated-mobilenet-one-finger.safetensors"}
"""Shipped checkpoints by the number of gel images of a touch."""
SHIPPED_NAMES = {"shipped": 2, "shipped-one-finger": 1}
"""Names of the shipped checkpoints in options that take a checkpoint."""


def shipped_model(fingers: int = 2) -> Path:
    """Return the path of a shipped checkpoint, trained on the simulated rig, to try out the program.

    Args:
        fingers: Number of gel images of a touch.

    Raises:
        BadInput: No shipped checkpoint takes this number.

    >>> retrieval.shipped_model().name
    'simulated-mobilenet.safetensors'
    """
    if fingers not in SHIPPED:
        raise BadInput(f"the shipped models take touches of 1 or 2 gel images; got {fingers}")
    return Path(str(resources.files("retrieval") / "shipped" / SHIPPED[fingers]))


def is_shipped(path: Path) -> bool:
    """Whether this is a shipped checkpoint, after following links."""
    return path.resolve() in [shipped_model(fingers).resolve() for fingers in SHIPPED]
