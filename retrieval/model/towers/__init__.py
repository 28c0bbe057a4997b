"""Towers: one encoder per modality.

A new backbone is one file and one row of `TOWERS`, or a class in a user's own package. A tower is named by its row or
by "module:Class". Names joined by `TOWER_SEPARATOR` are
concatenated backbones (`retrieval.model.towers.concatenated`). Their initial weights are joined in the same way: tower
"mobilenet_v2+mobilenet_v2", init "relief.safetensors+imagenet".
"""

from typing import TYPE_CHECKING

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

if TYPE_CHECKING:
    from retrieval.model.towers.tower import Tower

TOWERS: "Registry[type[Tower]]" = Registry(
    "tower",
    "towers",
    {
        "mobilenet_v2": "retrieval.model.towers.mobilenet:MobileNetV2",
        "resnet18": "retrieval.model.towers.resnet:ResNet18",
        "resnet50": "retrieval.model.towers.resnet:ResNet50",
        "small": "retrieval.model.towers.small:SmallTower",
    },
    error=ConfigError,
    base="retrieval.model.towers.tower:Tower",
)
TOWER_SEPARATOR = "+"
OUTPUTS = ("classes", "pooled", "stages")


def build_tower(name: str, output: str = "pooled") -> "Tower":
    """Build the tower `name`, or several concatenated ones, with random weights.

    Args:
        name: A row of `TOWERS`, or "module:Class" of an imported module.
        output: "pooled" gives the globally averaged features of the last stage; "classes" keeps the 1000-way linear
            layer of ImageNet checkpoints, whose outputs the paper concatenates; "stages" gives mean, deviation and
            maximum over the maps of several stages, from edges to parts.

    Raises:
        ConfigError: The name or output is unknown.
    """
    if TOWER_SEPARATOR in name:
        from retrieval.model.towers.concatenated import ConcatenatedTowers

        return ConcatenatedTowers([build_tower(part, output) for part in name.split(TOWER_SEPARATOR)])
    if output not in OUTPUTS:
        raise ConfigError(f"tower output must be one of {', '.join(OUTPUTS)}; got {output!r}")
    return TOWERS.load(name)(output)


def tower_name(choice: "str | type[Tower]") -> str:
    """Return the name of one tower or several, given by name or class. Raises ConfigError for an unknown one."""
    if not isinstance(choice, str):
        return TOWERS.name_of(choice)
    for part in choice.split(TOWER_SEPARATOR):
        TOWERS.name_of(part)
    return choice
