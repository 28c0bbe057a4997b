"""Towers: one encoder per modality. A new backbone is one file and one row of `TOWERS`, or a class in a user's own
package.

A tower is named by its row, by "module:Class", or by a family and a model: "transformers:facebook/dinov2-small". Names
joined by `TOWER_SEPARATOR` are backbones side by side (`retrieval.model.towers.concatenated`), and so are their first weights:
tower "mobilenet_v2+mobilenet_v2", init "relief.safetensors+imagenet".
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
        "resnet34": "retrieval.model.towers.resnet:ResNet34",
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
        "timm": "retrieval.model.towers.timm_models:TimmTower",
        "transformers": "retrieval.model.towers.transformers_models:TransformersTower",
    },
    error=ConfigError,
    base="retrieval.model.towers.tower:TowerFamily",
)
"""Other libraries of backbones; what they build is named "family:model"."""

TOWER_SEPARATOR = "+"
OUTPUTS = ("classes", "pooled", "stages")


def build_tower(name: str, output: str = "pooled", architectures: Mapping[str, Any] | None = None) -> "Tower":
    """Build the tower `name`, or several side by side, with random weights.

    Args:
        name: A row of `TOWERS`, "module:Class" of an imported module, or "family:model".
        output: "pooled" gives the globally averaged features of the last stage; "classes" keeps the 1000-way linear
        layer
            that ImageNet checkpoints carry, whose outputs the paper concatenates; "stages" gives mean, deviation and
            maximum over the maps of several stages, from edges to parts.
        architectures: What `architectures_of` found of the models of families.

    Raises:
        ConfigError: For an unknown name or output, or a model whose architecture is not given.
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
            f"the architecture of {name} must be known; name it by load_config or Config.using(tower={name!r})"
        )
    return FAMILIES.load(family)(output, name.partition(":")[2], (architectures or {})[name])


def tower_name(choice: "str | type[Tower]") -> str:
    """Return the name of a tower, or of several, that a user gives. Raises ConfigError for an unknown one."""
    if not isinstance(choice, str):
        return TOWERS.name_of(choice)
    for part in choice.split(TOWER_SEPARATOR):
        if _family_of(part) is None:
            TOWERS.name_of(part)
    return choice


def architectures_of(name: str) -> dict[str, Any]:
    """Return what a checkpoint keeps of the models of families, by their names: enough to build them again elsewhere.

    Raises ConfigError for a model that its family does not know.
    """
    families = {part: _family_of(part) for part in name.split(TOWER_SEPARATOR)}
    return {
        part: FAMILIES.load(family).architecture(part.partition(":")[2]) for part, family in families.items() if family
    }


def _family_of(name: str) -> str | None:
    """The family of a "family:model"; None for the name of a tower."""
    family, colon, _ = name.partition(":")
    return family if colon and family in FAMILIES.names() else None
