"""What objects are made of: stiffness and grip for touch, gloss and roughness for the photo.

Numbers are typical room-temperature values of the class; each object draws its own around them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from robot.errors import UnknownName
from robot.settings import check_range


@dataclass(frozen=True)
class Material:
    """Isotropic linear elasticity, density, friction against gel, and two numbers for shading (0 to 1)."""

    name: str
    modulus_mpa: float
    poisson: float
    density_kg_m3: float
    friction: float
    gloss: float
    roughness: float

    def __post_init__(self) -> None:
        limits = {
            "modulus_mpa": (1e-3, 1e6),
            "poisson": (-1.0, 0.5),
            "density_kg_m3": (1.0, 25000.0),
            "friction": (0.0, 5.0),
            "gloss": (0.0, 1.0),
            "roughness": (0.0, 1.0),
        }
        for field, (low, high) in limits.items():
            check_range(field, getattr(self, field), low, high)


_TABLE = (
    #        name              MPa   Poisson kg/m3 friction gloss roughness
    Material("silicone-foam", 0.015, 0.30, 250, 1.00, 0.02, 0.95),
    Material("soft-rubber", 0.8, 0.48, 1050, 1.10, 0.10, 0.80),
    Material("hard-rubber", 8.0, 0.47, 1200, 0.95, 0.20, 0.65),
    Material("cork", 20.0, 0.05, 200, 0.80, 0.04, 0.92),
    Material("cardboard", 150.0, 0.20, 650, 0.60, 0.06, 0.90),
    Material("leather", 80.0, 0.40, 900, 0.75, 0.25, 0.60),
    Material("wood", 9e3, 0.35, 650, 0.55, 0.15, 0.75),
    Material("polyethylene", 900.0, 0.44, 950, 0.45, 0.40, 0.45),
    Material("abs", 2.2e3, 0.37, 1050, 0.55, 0.55, 0.35),
    Material("ceramic", 7e4, 0.23, 2300, 0.60, 0.80, 0.15),
    Material("glass", 7e4, 0.22, 2500, 0.50, 0.95, 0.05),
    Material("aluminium", 7e4, 0.33, 2700, 0.50, 0.75, 0.30),
    Material("steel", 2e5, 0.29, 7850, 0.45, 0.85, 0.20),
)
MATERIALS: Mapping[str, Material] = MappingProxyType({material.name: material for material in _TABLE})


def draw_material(rng: np.random.Generator, name: str | None = None) -> Material:
    """One of the table (or the one named), its numbers jittered. Raises UnknownName."""
    chosen = str(rng.choice(list(MATERIALS))) if name is None else name
    if chosen not in MATERIALS:
        raise UnknownName(f"material must be one of {', '.join(MATERIALS)}; got {chosen!r}")
    typical = MATERIALS[chosen]
    spread, shift = np.exp(rng.normal(0, [0.25, 0.08])), rng.normal(0, [0.08, 0.08, 0.08])
    return replace(
        typical,
        modulus_mpa=float(np.clip(typical.modulus_mpa * spread[0], 0.01, 2.2e5)),
        density_kg_m3=float(typical.density_kg_m3 * spread[1]),
        friction=float(np.clip(typical.friction + shift[0], 0.3, 1.2)),
        gloss=float(np.clip(typical.gloss + shift[1], 0, 1)),
        roughness=float(np.clip(typical.roughness + shift[2], 0, 1)),
    )
