"""Materials of objects: stiffness and friction for touch, gloss and roughness for the photo.

Values are typical of the class at room temperature; each object draws its own around them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np


@dataclass(frozen=True)
class ObjectMaterial:
    """Isotropic linear elasticity, density, friction against gel, and gloss and roughness for shading (0 to 1)."""

    name: str
    modulus_mpa: float
    poisson: float
    density_kg_m3: float
    friction: float
    gloss: float
    roughness: float


_TABLE = (
    #        name              MPa   Poisson kg/m3 friction gloss roughness
    ObjectMaterial("silicone-foam", 0.015, 0.30, 250, 1.00, 0.02, 0.95),
    ObjectMaterial("soft-rubber", 0.8, 0.48, 1050, 1.10, 0.10, 0.80),
    ObjectMaterial("hard-rubber", 8.0, 0.47, 1200, 0.95, 0.20, 0.65),
    ObjectMaterial("cork", 20.0, 0.05, 200, 0.80, 0.04, 0.92),
    ObjectMaterial("cardboard", 150.0, 0.20, 650, 0.60, 0.06, 0.90),
    ObjectMaterial("leather", 80.0, 0.40, 900, 0.75, 0.25, 0.60),
    ObjectMaterial("wood", 9e3, 0.35, 650, 0.55, 0.15, 0.75),
    ObjectMaterial("polyethylene", 900.0, 0.44, 950, 0.45, 0.40, 0.45),
    ObjectMaterial("abs", 2.2e3, 0.37, 1050, 0.55, 0.55, 0.35),
    ObjectMaterial("ceramic", 7e4, 0.23, 2300, 0.60, 0.80, 0.15),
    ObjectMaterial("glass", 7e4, 0.22, 2500, 0.50, 0.95, 0.05),
    ObjectMaterial("aluminium", 7e4, 0.33, 2700, 0.50, 0.75, 0.30),
    ObjectMaterial("steel", 2e5, 0.29, 7850, 0.45, 0.85, 0.20),
)
MATERIALS: Mapping[str, ObjectMaterial] = MappingProxyType({material.name: material for material in _TABLE})


def draw_material(rng: np.random.Generator) -> ObjectMaterial:
    """Draw a material of the table, with jittered values."""
    typical = MATERIALS[str(rng.choice(list(MATERIALS)))]
    spread, shift = np.exp(rng.normal(0, [0.25, 0.08])), rng.normal(0, [0.08, 0.08, 0.08])
    return replace(
        typical,
        modulus_mpa=float(np.clip(typical.modulus_mpa * spread[0], 0.01, 2.2e5)),
        density_kg_m3=float(typical.density_kg_m3 * spread[1]),
        friction=float(np.clip(typical.friction + shift[0], 0.3, 1.2)),
        gloss=float(np.clip(typical.gloss + shift[1], 0, 1)),
        roughness=float(np.clip(typical.roughness + shift[2], 0, 1)),
    )
