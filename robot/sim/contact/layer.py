"""Frictionless normal contact between a height map and an elastic layer on a rigid base, for small strains.

Find p >= 0 and the approach d with   s = u(p) + gap - d >= 0,   p s = 0,   and either sum p dA = force or d = depth.

p is the pressure, and s the gap that remains between object and deformed gel. u is the inward displacement of the gel,
a layer with plane-strain modulus E* = E / (1 - nu^2) (robot.sim.contact.kernels). An elastic object adds the
displacement of a half-space with its own modulus E* = E / (1 - nu^2). The problem is solved for unit load (force or
depth), with the pixel as unit of length and the gel's E* as unit of pressure, and the result is scaled back. So any
consistent units work, such as mm, N and MPa.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from robot.errors import SceneError
from robot.sim.contact.constrained_cg import Solution
from robot.sim.contact.kernels import Floats
from robot.sim.contact.scaled_problem import ElasticSurface, ScaledProblem

STRAIN_LIMIT = 0.5  # linear elasticity holds below this: displacement over thickness, and slope
SINGLE_PRECISION_TOLERANCE = 5e-3  # the error of float32 products is thousands of times smaller
_SCALED_RANGE = (1e-100, 1e100)  # of force / (E* pixel^2) and depth / pixel, with the gel's E*


@dataclass(frozen=True)
class Layer:
    """Elastic gel bonded to a rigid base; a half-space if its thickness is infinite."""

    modulus_mpa: float
    poisson: float = 0.48
    thickness_mm: float = math.inf

    @property
    def plane_modulus_mpa(self) -> float:
        """Plane-strain modulus of the gel, E* = E / (1 - nu^2)."""
        return self.modulus_mpa / (1.0 - self.poisson**2)


@dataclass(frozen=True)
class Contact:
    """A solved press. Check `flags` before you trust it; an empty tuple means no problem.

    Attributes:
        pressure_mpa: (rows, cols) >= 0.
        displacement_mm: (rows, cols) inward displacement of the gel, without the object's own deformation.
        approach_mm: approach of the undeformed object, from gap = 0.
        force_n: total force.
        area_mm2: contact area.
        iterations: number of solver steps.
        residual: as in robot.sim.contact.constrained_cg.Solution; at most the tolerance if converged.
        converged: whether the solver reached the tolerance.
        flags: names from the list below.

    Flags:

        no_contact        there is no contact; `converged` is False if force_n > 0
        unresolved        the contact is less than three pixels wide: pressure and depth are inaccurate, force and
                          position are not
        at_border         the contact reaches the border of the map; the part beyond it is missing
        large_strain      a displacement exceeds half the thickness: linear elasticity does not hold
        steep             a slope exceeds one half: linear elasticity does not hold
        iteration_cap     the solver stopped before it reached the tolerance; `converged` is False
    """

    pressure_mpa: Floats
    displacement_mm: Floats
    approach_mm: float
    force_n: float
    area_mm2: float
    iterations: int
    residual: float
    converged: bool
    flags: tuple[str, ...]


def press(
    gap_mm: npt.ArrayLike,
    pixel_mm: float,
    layer: Layer,
    *,
    force_n: float | None = None,
    depth_mm: float | None = None,
    object_modulus_mpa: float = math.inf,
    object_poisson: float = 0.3,
    tolerance: float = 1e-3,
    max_iterations: int = 1000,
) -> Contact:
    """Press an object into the gel with a force or to a depth.

    Args:
        gap_mm: (rows, cols) distance of the undeformed object from the flat gel, +inf where there is no object.
        pixel_mm: side of a pixel.
        layer: the gel.
        force_n: total force; exclusive with `depth_mm`.
        depth_mm: approach of the undeformed object, from gap = 0.
        object_modulus_mpa: Young's modulus of the object; infinite for a rigid one.
        object_poisson: Poisson's ratio of the object.
        tolerance: upper bound on the solver's residual.
        max_iterations: maximum number of solver steps.

    Raises:
        SceneError: The gap is not a number or +inf in each pixel, or force or depth is not computable.
    """
    gap = np.asarray(gap_mm, np.float64)
    if np.isnan(gap).any() or (gap == -np.inf).any():
        raise SceneError(
            "a gap must be a number or +inf in each pixel, got NaN or -inf; give +inf where there is no object"
        )
    lowest = float(gap.min())
    if math.isinf(lowest) or force_n == 0.0 or (depth_mm is not None and depth_mm <= lowest):
        approach = depth_mm if depth_mm is not None else 0.0 if math.isinf(lowest) else lowest
        nothing = np.zeros(gap.shape)
        return Contact(nothing, nothing.copy(), approach, 0.0, 0.0, 0, 0.0, not force_n, ("no_contact",))
    softness = layer.plane_modulus_mpa * (1.0 - object_poisson**2) / object_modulus_mpa
    single_precision = tolerance >= SINGLE_PRECISION_TOLERANCE
    surface = ElasticSurface(layer.thickness_mm / pixel_mm, layer.poisson, softness, single_precision)
    # Load or depth in units of pixels and the gel's E*.
    depth = 0.0 if depth_mm is None else (depth_mm - lowest) / pixel_mm
    scale = depth if force_n is None else force_n / layer.plane_modulus_mpa / pixel_mm / pixel_mm
    if not _SCALED_RANGE[0] < scale < _SCALED_RANGE[1]:
        raise SceneError(
            f"force / (E* pixel^2), with E* = E / (1 - nu^2) of the gel, or depth / pixel must be between "
            f"{_SCALED_RANGE[0]} and {_SCALED_RANGE[1]}, got {scale}; give force, modulus and lengths in "
            "consistent units"
        )
    with np.errstate(over="ignore"):  # surfaces at such a distance never touch
        scaled = (gap - lowest) / pixel_mm / scale
        scaled[scaled > _SCALED_RANGE[1]] = math.inf
    load = None if force_n is None else 1.0
    solution = ScaledProblem(surface, scaled, load, 1.0, tolerance, max_iterations).solve()
    return _contact(solution, surface, layer, pixel_mm, scale, lowest)


def _contact(
    solution: Solution, surface: ElasticSurface, layer: Layer, pixel_mm: float, scale: float, lowest_mm: float
) -> Contact:
    """Convert the solution to the caller's units and set the flags."""
    pressure, displacement = solution.pressure, solution.displacement
    if surface.softness > 0.0:
        displacement = surface.gel_operator(pressure.shape, pressure.shape)(pressure)
    touching = pressure > 0.0
    padded = np.pad(touching, 1, mode="edge")
    around = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    displacement_mm = displacement * (scale * pixel_mm)
    flags = {
        "no_contact": not touching.any(),
        "unresolved": touching.any() and not (touching & around).any(),
        "at_border": bool(touching[[0, -1]].any() or touching[:, [0, -1]].any()),
        "large_strain": float(displacement_mm.max()) > STRAIN_LIMIT * layer.thickness_mm,
        "steep": _max_slope(displacement * scale) > STRAIN_LIMIT,
        "iteration_cap": not solution.converged,
    }
    return Contact(
        pressure_mpa=pressure * (scale * layer.plane_modulus_mpa),
        displacement_mm=displacement_mm,
        approach_mm=solution.approach * scale * pixel_mm + lowest_mm,
        force_n=float(pressure.sum()) * scale * layer.plane_modulus_mpa * pixel_mm * pixel_mm,
        area_mm2=int(touching.sum()) * pixel_mm * pixel_mm,
        iterations=solution.iterations,
        residual=solution.residual,
        converged=solution.converged,
        flags=tuple(name for name, raised in flags.items() if raised),
    )


def _max_slope(height: Floats) -> float:
    """Return the largest slope by central differences; heights and distances are in pixels."""
    slopes = [np.gradient(height, axis=axis) for axis in (0, 1) if height.shape[axis] > 1]
    return float(np.sqrt(sum((slope**2 for slope in slopes), np.zeros(1))).max())
