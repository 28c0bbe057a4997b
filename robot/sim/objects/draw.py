"""Objects of the simulated rig: `draw_object(seed, index)` always returns the same object.

Four separate random streams draw the shape, the relief, the material and the appearance, so that neither colour nor
paint carries information about tactile properties. Families and reliefs are permuted: in each round of as many objects
as there are families, each family occurs once, in a random order.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from robot.errors import RobotConfigError, UnknownName
from robot.sim.objects.appearance import Appearance, draw_appearance
from robot.sim.objects.body import Body, SdfBody
from robot.sim.objects.materials import ObjectMaterial, draw_material
from robot.sim.objects.relief import RELIEFS, Relief, draw_relief
from robot.sim.objects.shapes import SHAPES

STROKE_MM = 110.0  # stroke of the simulated gripper; every object fits into it
# Random streams. A new purpose takes a new number, so that existing objects do not change.
_SHAPE, _RELIEF, _MATERIAL, _APPEARANCE, _FAMILY_ORDER, _RELIEF_ORDER = range(6)


@dataclass(frozen=True)
class SimObject:
    """An object on the table. `relief.amplitude_mm` is 0 for a smooth one."""

    object_id: str
    family: str
    relief: Relief
    material: ObjectMaterial
    appearance: Appearance
    body: Body = field(repr=False)

    @cached_property
    def mass_kg(self) -> float:
        """Mass: solid if at most 0.6 kg, otherwise hollow with a wall of 3 mm, as for bottles and castings."""
        solid, shell = (volume * 1e-9 * self.material.density_kg_m3 for volume in self.body.volumes_mm3(3.0))
        return solid if solid <= 0.6 else min(solid, shell)

    def labels(self) -> dict[str, float | bool | str]:
        """Return shape and relief as plain values, the properties that both touch and photo can show."""
        relief = self.relief
        return {
            "shape": self.family,
            "relief": relief.name,
            "pitch_mm": relief.pitch_mm,
            "amplitude_mm": relief.amplitude_mm,
            "angle_rad": relief.angle_rad,
            "aspect": relief.aspect,
            "sharpness": relief.sharpness,
            "engraved": relief.engraved,
        }


def draw_object(seed: int, index: int, *, family: str | None = None, relief: str | None = None) -> SimObject:
    """Draw object `index` of the object set `seed`.

    The result depends on the arguments only. Expensive work starts when the body is used.

    Args:
        seed: number of the object set.
        index: number of the object in it.
        family: shape family; drawn if None.
        relief: relief family; drawn if None.

    Raises:
        UnknownName: There is no such family or relief.
        RobotConfigError: `seed` or `index` is not a whole number from 0.

    >>> robot.draw_object(seed=0, index=0).object_id.endswith("-0000-00000")
    True
    """
    for name, value in (("seed", seed), ("index", index)):
        if not isinstance(value, int | np.integer) or value < 0:
            raise RobotConfigError(f"{name} must be a whole number from 0, got {value!r}")
    chosen = _choose_name(SHAPES, family, "family", seed, index, _FAMILY_ORDER)
    relief_name = _choose_name(RELIEFS, relief, "relief", seed, index, _RELIEF_ORDER)
    shape = SHAPES[chosen](np.random.default_rng([seed, index, _SHAPE]))
    pattern = draw_relief(relief_name, np.random.default_rng([seed, index, _RELIEF]), shape.relief_limit_mm)
    return SimObject(
        object_id=f"{chosen}-{relief_name}-{seed:04d}-{index:05d}",
        family=chosen,
        relief=pattern,
        material=draw_material(np.random.default_rng([seed, index, _MATERIAL])),
        appearance=draw_appearance(np.random.default_rng([seed, index, _APPEARANCE])),
        body=SdfBody(shape, pattern),
    )


def _choose_name(table: Mapping[str, Any], name: str | None, what: str, seed: int, index: int, stream: int) -> str:
    """Return the given name, or the next one of the random permutation."""
    if name is None:
        round_number, place = divmod(index, len(table))
        return list(table)[int(np.random.default_rng([seed, round_number, stream]).permutation(len(table))[place])]
    if name not in table:
        raise UnknownName(f"{what} must be one of {', '.join(table)}; got {name!r}")
    return name
