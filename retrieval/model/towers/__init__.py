"""Towers: one encoder per modality.

A new backbone is one file and one row of `TOWERS`, or a class in a user's own package. A tower is named by its row or
by "module:Class". Names joined by `TOWER_SEPARATOR` are concatenated backbones (`ConcatenatedTowers`). Their initial
weights are joined in the same way: tower "mobilenet_v2+mobilenet_v2", init "relief.safetensors+imagenet".
"""

from typing import Any

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

TOWERS: Registry[Any] = Registry(
    "tower",
    "towers",
    {
        "mobilenet_v2": "retrieval.model.towers.mobilenet:MobileNetV2",
        "mobilenet_v2_stride16": "retrieval.model.towers.mobilenet:MobileNetV2Stride16",
        "none": "retrieval.model.towers.none:NoTower",
        "resnet18": "retrieval.model.towers.resnet:ResNet18",
        "resnet50": "retrieval.model.towers.resnet:ResNet50",
        "small": "retrieval.model.towers.small:SmallTower",
    },
    error=ConfigError,
    base="retrieval.model.towers.tower:Tower",
)
TOWER_SEPARATOR = "+"
NO_TOWER = "none"
"""Photo tower of a model that is fitted to touches only, and compares no photos."""


def tower_name(choice: str | type) -> str:
    """Return the name of one tower or several, given by name or class. Raises ConfigError for an unknown one."""
    if not isinstance(choice, str):
        return TOWERS.name_of(choice)
    for part in choice.split(TOWER_SEPARATOR):
        TOWERS.name_of(part)
    return choice
