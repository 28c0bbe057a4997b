"""Towers: one encoder per modality.

A new backbone is one file and one row of `TOWERS`, or a class in a user's own package. A tower is named by its row, by
"module:Class", or by a family and a model: "transformers:facebook/dinov2-small". Names joined by `TOWER_SEPARATOR` are
concatenated backbones (`retrieval.model.towers.concatenated`). Their initial weights are joined in the same way: tower
"mobilenet_v2+mobilenet_v2", init "relief.safetensors+imagenet".
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

if TYPE_CHECKING:
    from retrieval.model.towers.tower import Tower, TowerFamily

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
FAMILIES: "Registry[type[TowerFamily]]" = Registry(
    "family of towers",
    "tower_families",
    {
        "transformers": "retrieval.model.towers.transformers_models:TransformersTower",
    },
    error=ConfigError,
    base="retrieval.model.towers.tower:TowerFamily",
)
"""Other libraries of backbones; their models are named "family:model"."""

TOWER_SEPARATOR = "+"
OUTPUTS = ("classes", "pooled", "stages")


def build_tower(name: str, output: str = "pooled", architectures: Mapping[str, Any] | None = None) -> "Tower":
    """Build the tower `name`, or several concatenated ones, with random weights.

    Args:
        name: A row of `TOWERS`, "module:Class" of an imported module, or "family:model".
        output: "pooled" gives the globally averaged features of the last stage; "classes" keeps the 1000-way linear
            layer of ImageNet checkpoints, whose outputs the paper concatenates; "stages" gives mean, deviation and
            maximum over the maps of several stages, from edges to parts.
        architectures: Results of `architectures_of` for the models of families.

    Raises:
        ConfigError: The name or output is unknown, or a model's architecture is missing.
    """
    if TOWER_SEPARATOR in name:
        from retrieval.model.towers.concatenated import ConcatenatedTowers

        return ConcatenatedTowers([build_tower(part, output, architectures) for part in name.split(TOWER_SEPARATOR)])
    if output not in OUTPUTS:
        raise ConfigError(f"tower output must be one of {', '.join(OUTPUTS)}; got {output!r}")
    if (family := _family_of(name)) is None:
        return TOWERS.load(name)(output)
    if name not in (architectures or {}):
        raise ConfigError(
            f"the architecture of {name} is missing; set the tower with load_config or Config.using(tower={name!r})"
        )
    return FAMILIES.load(family)(output, name.partition(":")[2], (architectures or {})[name])


def tower_name(choice: "str | type[Tower]") -> str:
    """Return the name of one tower or several, given by name or class. Raises ConfigError for an unknown one."""
    if not isinstance(choice, str):
        return TOWERS.name_of(choice)
    for part in choice.split(TOWER_SEPARATOR):
        if _family_of(part) is None:
            TOWERS.name_of(part)
    return choice


def architectures_of(name: str) -> dict[str, Any]:
    """Return the architectures of the models of families in `name`, from which a checkpoint builds them elsewhere.

    Raises:
        ConfigError: A family has no such model.
    """
    families = {part: _family_of(part) for part in name.split(TOWER_SEPARATOR)}
    return {
        part: FAMILIES.load(family).architecture(part.partition(":")[2]) for part, family in families.items() if family
    }


def _family_of(name: str) -> str | None:
    """Return the family of a "family:model"; None for the name of a tower."""
    family, colon, _ = name.partition(":")
    return family if colon and family in FAMILIES.names() else None
