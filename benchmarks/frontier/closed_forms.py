"""The contact solver compared with closed forms: exact solutions without a grid, and the error of the grid.

Formulae: Johnson, Contact Mechanics (1985), chapters 3 to 5; thin bonded layers from the long-wave limits of
robot.sim.contact.kernels (compressible: springs of M/h; incompressible: u = -h^3 lap p / (3 G)).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robot.sim.contact.kernels import Floats
from robot.sim.contact.layer import Contact, Layer, press

HALF_SPACE = Layer(0.26 * (1.0 - 0.48**2), 0.48)  # E* = .26 MPa
FIELD_MM = (14.4, 19.2)
BALL_MM = 4.0


@dataclass(frozen=True)
class Check:
    """Error of the solver in one case.

    Most limits are the errors of an earlier prototype of 60 lines, as printed, plus half of the last digit.

    Attributes:
        case: the problem.
        quantity: the compared quantity.
        grid: the grid of the solver.
        error: the error in `unit`.
        limit: the maximum error.
        unit: unit of error and limit.
    """

    case: str
    quantity: str
    grid: str
    error: float
    limit: float
    unit: str = "%"

    @property
    def holds(self) -> bool:
        """Whether the error is within the limit."""
        return abs(self.error) <= self.limit


@dataclass(frozen=True)
class Grid:
    """`rows` x `cols` square pixels over FIELD_MM, or over a square of `side_mm`."""

    rows: int
    cols: int
    pixel_mm: float

    @classmethod
    def of_field(cls, rows: int) -> "Grid":
        return cls(rows, rows * 4 // 3, FIELD_MM[0] / rows)

    @classmethod
    def of_square(cls, rows: int, side_mm: float) -> "Grid":
        return cls(rows, rows, side_mm / rows)

    def axes(self) -> tuple[Floats, Floats]:
        """Return y (rows, 1) and x (1, cols) of the pixel centres in mm, 0 in the middle."""
        y, x = (self.pixel_mm * (np.arange(float(n)) - (n - 1) / 2.0) for n in (self.rows, self.cols))
        return np.asarray(y[:, None]), np.asarray(x[None, :])

    def radius(self) -> Floats:
        """Return the distance (rows, cols) of the pixel centres from the middle in mm."""
        return np.hypot(*self.axes())

    def __str__(self) -> str:
        return f"{self.rows}x{self.cols}"


def closed_form_table() -> tuple[Check, ...]:
    """Check every closed form, in about two seconds."""
    sources = (_hertz(), _punch(), _cone(), _thin_compressible(), _thin_incompressible())
    return tuple(check for source in (*sources, _identities()) for check in source)


def percent(value: float, exact: float) -> float:
    """Return the relative error in per cent."""
    return 100.0 * (value / exact - 1.0)


# Hertz -----------------------------------------------------------------------------------------------------


def hertz(force_n: float, radius_mm: float, modulus_mpa: float) -> tuple[float, float, float]:
    """Return contact radius a, approach a^2/R and peak pressure 3F/(2 pi a^2) of a paraboloid; `modulus_mpa` is E*."""
    a = (0.75 * force_n * radius_mm / modulus_mpa) ** (1.0 / 3.0)
    return a, a * a / radius_mm, 1.5 * force_n / (math.pi * a * a)


def pressed_ball(grid: Grid, layer: Layer, force_n: float, tolerance: float) -> Contact:
    """Press a paraboloid of BALL_MM into the middle of the field."""
    return press(_ball(grid), grid.pixel_mm, layer, force_n=force_n, tolerance=tolerance)


def _ball(grid: Grid) -> Floats:
    return np.asarray(grid.radius() ** 2 / (2.0 * BALL_MM))


# Rows, force, and the limits: depth %, peak pressure %, pressure in L2 %. (The prototype's first L2 was 7.4; ours is
# 7.53 for the same discretisation, whose other errors agree to every digit, so 7.4 was a different measure.)
_HERTZ = (
    (60, 0.02, 0.285, 2.75, 7.55),
    (60, 0.5, 0.045, 0.335, 2.55),
    (60, 2.0, 0.035, 0.165, 1.25),
    (120, 0.02, 0.195, 0.85, 3.35),
    (120, 0.5, 0.025, 0.15, 1.05),
    (120, 2.0, 0.015, 0.045, 0.75),
    (240, 0.02, 0.055, 0.25, 1.45),
    (240, 0.5, 0.0065, 0.025, 0.545),
    (240, 2.0, 0.0015, 0.005, 0.405),
)


def _hertz() -> Iterator[Check]:
    for rows, force, depth_limit, peak_limit, pressure_limit in _HERTZ:
        grid = Grid.of_field(rows)
        contact = pressed_ball(grid, HALF_SPACE, force, 1e-6)
        a, depth, peak = hertz(force, BALL_MM, HALF_SPACE.plane_modulus_mpa)
        exact = peak * np.sqrt(np.maximum(1.0 - (grid.radius() / a) ** 2, 0.0))
        difference = np.linalg.norm(contact.pressure_mpa - exact) / np.linalg.norm(exact)
        case = f"Hertz, {force:g} N"
        yield Check(case, "depth", str(grid), percent(contact.approach_mm, depth), depth_limit)
        # The pixel nearest to the middle is half a diagonal away from the peak.
        nearest = peak * math.sqrt(1.0 - grid.pixel_mm**2 / 2.0 / a**2)
        yield Check(case, "peak pressure", str(grid), percent(float(contact.pressure_mpa.max()), nearest), peak_limit)
        yield Check(case, "pressure, L2", str(grid), 100.0 * float(difference), pressure_limit)


# Punch, cone, line contact ---------------------------------------------------------------------------------


def _punch() -> Iterator[Check]:
    """Check d = F / (2 E* a) and, outside, u = (2 d / pi) asin(a/r). A round punch on square pixels has a stepped rim.

    The limit for the depth with the radius from the area is our own. This error is of first order in pixel / a, because
    the pressure is singular at the rim.
    """
    for rows, nominal, by_area, outside in ((64, 1.55, 0.8, 0.325), (128, 0.645, 0.4, 0.155), (256, 0.295, 0.2, 0.065)):
        grid, a = Grid.of_square(rows, 4.0), 1.0
        r = grid.radius()
        contact = press(np.where(r <= a, 0.0, np.inf), grid.pixel_mm, HALF_SPACE, force_n=0.1, tolerance=1e-6)
        depth = 0.1 / (2.0 * HALF_SPACE.plane_modulus_mpa * a)
        exact = 2.0 * depth / math.pi * np.arcsin(a / r[r > 1.1 * a])
        rms = math.sqrt(float(np.mean((contact.displacement_mm[r > 1.1 * a] / exact - 1.0) ** 2)))
        staircase = depth * a / math.sqrt(contact.area_mm2 / math.pi)
        yield Check("flat punch", "depth", str(grid), percent(contact.approach_mm, depth), nominal)
        area_error = percent(contact.approach_mm, staircase)
        yield Check("flat punch", "depth, radius from area", str(grid), area_error, by_area)
        yield Check("flat punch", "surface outside, rms", str(grid), 100.0 * rms, outside)


def _cone() -> Iterator[Check]:
    """Check d = (pi/2) a tan t, F = (pi/2) E* a^2 tan t."""
    grid, slope, a = Grid.of_square(64, 4.0), 0.2, 1.0
    force = math.pi / 2.0 * HALF_SPACE.plane_modulus_mpa * a * a * slope
    contact = press(slope * grid.radius(), grid.pixel_mm, HALF_SPACE, force_n=force, tolerance=1e-6)
    yield Check("cone", "depth", str(grid), percent(contact.approach_mm, math.pi / 2.0 * a * slope), 0.015)
    yield Check("cone", "radius from area", str(grid), percent(math.sqrt(contact.area_mm2 / math.pi), a), 0.75)


# Thin bonded layers ----------------------------------------------------------------------------------------


def _thin_compressible() -> Iterator[Check]:
    """Check springs of K = M/h: d = a^2/(2R), F = pi K a^4/(4R)."""
    radius, a, h, grid = 50.0, 4.0, 0.05, Grid.of_square(128, 10.0)
    layer = Layer(0.2, 0.3, h)
    stiffness = 0.2 * 0.7 / (1.3 * 0.4) / h
    gap = grid.radius() ** 2 / (2.0 * radius)
    contact = press(gap, grid.pixel_mm, layer, force_n=math.pi * stiffness * a**4 / (4.0 * radius), tolerance=1e-6)
    measured = math.sqrt(contact.area_mm2 / math.pi)
    yield Check("thin compressible layer", "depth", str(grid), percent(contact.approach_mm, a * a / (2 * radius)), 0.05)
    yield Check("thin compressible layer", "radius from area", str(grid), percent(measured, a), 0.45)


def _thin_incompressible() -> Iterator[Check]:
    """Check F = pi G a^6/(32 R h^3), d = a^2/(4R), to order h/a."""
    for slenderness, limit in ((14, 3.15), (20, 1.65), (28, 0.85)):
        grid, a, radius = Grid.of_square(256, 12.0), 4.0, 100.0
        layer = Layer(0.3, 0.5, a / slenderness)
        force = math.pi * 0.1 * a**6 / (32.0 * radius * layer.thickness_mm**3)
        contact = press(grid.radius() ** 2 / (2.0 * radius), grid.pixel_mm, layer, force_n=force, tolerance=1e-6)
        depth = percent(contact.approach_mm, a * a / (4.0 * radius))
        yield Check(f"thin incompressible layer, a/h = {slenderness}", "depth", str(grid), depth, limit)


# Identities ------------------------------------------------------------------------------------------------


def _identities() -> Iterator[Check]:
    grid = Grid.of_field(120)
    for name, layer in (("half-space", HALF_SPACE), ("layer of 2 mm", Layer(HALF_SPACE.modulus_mpa, 0.48, 2.0))):
        contact = pressed_ball(grid, layer, 0.5, 1e-8)
        yield Check(name, "dU/dd = F", str(grid), percent(_work_slope(grid, layer, contact), contact.force_n), 2e-3)
        yield Check(name, "sum p dA = F", str(grid), percent(contact.force_n, 0.5), 1e-9)
        gap = contact.displacement_mm + _ball(grid) - contact.approach_mm
        touching = contact.pressure_mpa > 0.0
        worst = max(float(np.abs(gap[touching]).max()), float(-gap.min())) / contact.approach_mm
        yield Check(name, "contact conditions, of depth", str(grid), 100.0 * worst, 1e-4)


def _work_slope(grid: Grid, layer: Layer, contact: Contact) -> float:
    """Return dU/dd by central differences; U = 1/2 sum p u dA."""
    step = 1e-3 * contact.approach_mm
    gap = _ball(grid)
    works = []
    for depth in (contact.approach_mm + step, contact.approach_mm - step):
        nearby = press(gap, grid.pixel_mm, layer, depth_mm=depth, tolerance=1e-8)
        works.append(0.5 * float(np.vdot(nearby.pressure_mpa, nearby.displacement_mm)) * grid.pixel_mm**2)
    return (works[0] - works[1]) / (2.0 * step)
