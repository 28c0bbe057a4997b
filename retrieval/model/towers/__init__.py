"""Towers: one encoder per modality. A new backbone is one file, one row of `TOWERS` and one test parameter.

Names joined by `TOGETHER` are backbones side by side (`retrieval.model.towers.side_by_side`), and so are their first
weights: tower "mobilenet_v2+mobilenet_v2", init "relief.safetensors+imagenet".
"""

from importlib import import_module
from typing import TYPE_CHECKING

from retrieval.errors import ConfigError

if TYPE_CHECKING:
    from retrieval.model.towers.base import Tower

TOWERS = {
    "mobilenet_v2": "retrieval.model.towers.mobilenet:mobilenet_v2",
    "resnet18": "retrieval.model.towers.resnet:resnet18",
    "resnet34": "retrieval.model.towers.resnet:resnet34",
    "resnet50": "retrieval.model.towers.resnet:resnet50",
    "small": "retrieval.model.towers.small:small",
}

TOGETHER = "+"
OUTPUTS = ("classes", "pooled", "stages")


def build_tower(name: str, output: str = "pooled") -> "Tower":
    """Build the tower `name`, or several side by side, with random weights.

    output: "pooled" gives the globally averaged features of the last stage; "classes" keeps the 1000-way
    linear layer that ImageNet checkpoints carry, whose outputs the paper concatenates; "stages" gives mean, deviation
    and maximum over the maps of several stages, from edges to parts.
    Raises ConfigError for an unknown name or output.
    """
    if TOGETHER in name:
        from retrieval.model.towers.side_by_side import SideBySide

        return SideBySide([build_tower(part, output) for part in name.split(TOGETHER)])
    if name not in TOWERS:
        raise ConfigError(f"tower must be one of {', '.join(sorted(TOWERS))}; got {name!r}")
    if output not in OUTPUTS:
        raise ConfigError(f"tower output must be one of {', '.join(OUTPUTS)}; got {output!r}")
    module, function = TOWERS[name].split(":")
    tower: Tower = getattr(import_module(module), function)(output)
    return tower
