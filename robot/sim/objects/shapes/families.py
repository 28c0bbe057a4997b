"""Shape families and the ranges of their sizes: 8 to 95 mm in the narrow direction, 25 to 200 mm high."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from robot.sim.objects.shapes.extrusion import Extrusion, Polygon, RoundedRectangle
from robot.sim.objects.shapes.revolution import Ball, Cone, Drum, FlutedCylinder, Revolution, ThreadedRod
from robot.sim.objects.shapes.shape import Shape
from robot.sim.objects.shapes.solids import Blobs, Brick, Bricks, Brush, Comb, Mug, Ring, Superquadric

Rng = np.random.Generator


def _between(rng: Rng, low: float, high: float) -> float:
    return float(rng.uniform(low, high))


def _skewed(rng: Rng, low: float, high: float) -> float:
    """Draw from a log-uniform distribution."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def box(rng: Rng) -> Shape:
    """A carton or block with rounded upright edges."""
    x, y = _between(rng, 14, 44), _between(rng, 10, 38)
    corner = _skewed(rng, 1.5, 0.8 * min(x, y))
    return Extrusion(RoundedRectangle(x, y, corner), _between(rng, 35, 160), rim_mm=min(corner, _between(rng, 0.8, 5)))


def slab(rng: Rng) -> Shape:
    """A thin upright object: a book, a phone, a tile."""
    x, y = _between(rng, 22, 50), _between(rng, 4.5, 10)
    return Extrusion(RoundedRectangle(x, y, _between(rng, 1.5, 0.9 * y)), _between(rng, 50, 150), rim_mm=1.2)


def oval(rng: Rng) -> Shape:
    """A flask with an oval outline."""
    y = _between(rng, 9, 26)
    outline = RoundedRectangle(y + _between(rng, 5, 24), y, y)
    return Extrusion(outline, _between(rng, 40, 170), rim_mm=_between(rng, 1, 0.4 * y), taper=_between(rng, 0, 0.25))


def prism(rng: Rng) -> Shape:
    """A straight prism of three to eight sides."""
    sides, apothem = int(rng.integers(3, 9)), _between(rng, 10, 36)
    apothem = min(apothem, 44 * float(np.cos(np.pi / sides)))
    return Extrusion(Polygon(sides, apothem, _skewed(rng, 1.2, 8)), _between(rng, 35, 150), rim_mm=_between(rng, 1, 4))


def twist(rng: Rng) -> Shape:
    """A twisted prism."""
    sides, apothem, height = int(rng.integers(3, 7)), _between(rng, 11, 28), _between(rng, 50, 140)
    turn = float(rng.choice([-1, 1])) * _between(rng, 0.5, 1.8)
    apothem = min(apothem, 40 * float(np.cos(np.pi / sides)))
    return Extrusion(Polygon(sides, apothem, _between(rng, 2, 6)), height, rim_mm=1.5, twist_rad=turn)


def pyramid(rng: Rng) -> Shape:
    """A block that narrows upwards."""
    x, y, height = _between(rng, 16, 42), _between(rng, 14, 38), _between(rng, 40, 130)
    outline = RoundedRectangle(x, y, _skewed(rng, 1.5, 0.7 * min(x, y)))
    return Extrusion(outline, height, rim_mm=_between(rng, 0.8, 3), taper=_between(rng, 0.25, 0.6))


def cylinder(rng: Rng) -> Shape:
    """A can or a rod."""
    radius, height = _skewed(rng, 6, 42), _between(rng, 35, 170)
    return Revolution((Drum(radius, 0, height, rim_mm=_between(rng, 0.6, min(6, 0.5 * radius))),), height)


def tin(rng: Rng) -> Shape:
    """A jar with a protruding lid or rims."""
    radius, height = _between(rng, 14, 40), _between(rng, 35, 120)
    lid, out = height * _between(rng, 0.62, 0.85), _between(rng, 1, 4)
    parts = (Drum(radius, 0, height, rim_mm=2), Drum(radius + out, lid, height, rim_mm=_between(rng, 0.6, 2)))
    return Revolution(parts, height, blend_mm=0.8)


def bottle(rng: Rng) -> Shape:
    """Body, shoulder, neck and cap."""
    radius, height = _between(rng, 14, 38), _between(rng, 90, 190)
    neck, shoulder = radius * _between(rng, 0.3, 0.55), height * _between(rng, 0.5, 0.75)
    slope = min(height - 22, shoulder + _between(rng, 0.6, 1.8) * (radius - neck))
    parts = (
        Drum(radius, 0, shoulder, rim_mm=_between(rng, 2, 0.4 * radius)),
        Cone(radius * 0.9, neck, shoulder - 4, slope, rim_mm=2),
        Drum(neck, shoulder, height - 2, rim_mm=1.5),
        Drum(neck + _between(rng, 1, 4), height - _between(rng, 11, 18), height, rim_mm=1.5),
    )
    return Revolution(parts, height, blend_mm=_between(rng, 1.5, 5))


def vase(rng: Rng) -> Shape:
    """Balls in a row, blended into a curved outline."""
    height, count = _between(rng, 60, 170), int(rng.integers(2, 5))
    places = np.linspace(0.12, 0.92, count) * height
    sizes = rng.uniform(11, min(38, 0.75 * height / count + 8), count)
    balls = tuple(Ball(float(size), float(place)) for size, place in zip(sizes, places, strict=True))
    core = Drum(_between(rng, 6, 10), 0, height, rim_mm=1.5)
    return Revolution((core, *balls), height, blend_mm=_between(rng, 10, 26))


def cone(rng: Rng) -> Shape:
    """An upside-down cup, or a funnel that stands on its narrow end."""
    wide, height = _between(rng, 16, 42), _between(rng, 40, 140)
    ends = (wide, wide * _between(rng, 0.3, 0.75))
    base, head = ends if rng.random() < 0.6 else ends[::-1]
    return Revolution((Cone(base, head, 0, height, rim_mm=_between(rng, 1, 4)),), height)


def spool(rng: Rng) -> Shape:
    """A core between two flanges."""
    radius, height = _between(rng, 15, 40), _between(rng, 35, 110)
    core, flange, rim = radius * _between(rng, 0.45, 0.8), height * _between(rng, 0.1, 0.25), _between(rng, 0.6, 2)
    parts = (
        Drum(core, 0, height, rim_mm=rim),
        Drum(radius, 0, flange, rim_mm=rim),
        Drum(radius * _between(rng, 0.8, 1), height - flange, height, rim_mm=rim),
    )
    return Revolution(parts, height, blend_mm=_between(rng, 0.5, 8))


def pawn(rng: Rng) -> Shape:
    """A foot, a stem and a head, as of a chess piece or a goblet."""
    height, foot = _between(rng, 55, 150), _between(rng, 15, 32)
    head = min(_between(rng, 10, 28), 0.3 * height)
    parts = (
        Drum(foot, 0, _between(rng, 6, 14), rim_mm=2),
        Cone(foot * 0.7, _between(rng, 5, 9), 2, height - head, rim_mm=1.5),
        Ball(head, height - head),
        Ball(2.5, height - 1.9 * head, ring_mm=_between(rng, 7, 12)),
    )
    return Revolution(parts, height, blend_mm=_between(rng, 3, 12))


def dumbbell(rng: Rng) -> Shape:
    """Two knobs on a grip, upright."""
    ball, grip, height = _between(rng, 13, 30), _between(rng, 6, 12), _between(rng, 80, 180)
    top = ball * _between(rng, 0.6, 1)
    parts = (Drum(grip, 0, height - 2, rim_mm=2), Ball(ball, 0.85 * ball), Ball(top, height - top))
    return Revolution(parts, height, blend_mm=_between(rng, 2, 14))


def tube(rng: Rng) -> Shape:
    """A pipe, open at the top."""
    radius, height = _between(rng, 12, 40), _between(rng, 30, 140)
    wall = _between(rng, 2.5, min(8, radius / 2.5))
    hollow = Drum(radius - wall, _between(rng, 4, 8), height + 20, rim_mm=1)
    return Revolution((Drum(radius, 0, height, rim_mm=min(1.2, wall / 2.2)),), height, hollow=hollow)


def knob(rng: Rng) -> Shape:
    """A fluted grip: lobes around a cylinder."""
    radius, height = _between(rng, 12, 38), _between(rng, 30, 130)
    count = int(np.clip(round(2 * np.pi * radius / _skewed(rng, 7, 24)), 3, 24))
    depth = min(6.0, 0.22 * 2 * np.pi * radius / count, 0.25 * radius) * _between(rng, 0.5, 1)
    turns = float(rng.choice([0.0, _between(rng, -1.5, 1.5)]))
    drum = Drum(radius, 0, height, rim_mm=_between(rng, 1, 4))
    return FlutedCylinder(drum, count=count, depth_mm=depth, turns=turns, sharpness=_between(rng, 0.6, 2))


def screw(rng: Rng) -> Shape:
    """A threaded rod on its head."""
    radius, height, pitch = _between(rng, 6, 20), _between(rng, 50, 150), _skewed(rng, 2.5, 10)
    depth = min(0.45 * pitch, 0.3 * radius, 4.5)
    foot = Drum(radius * _between(rng, 1.3, 2), 0, _between(rng, 6, 14), rim_mm=1.2)
    return ThreadedRod(radius, height, pitch_mm=pitch, depth_mm=depth, starts=int(rng.integers(1, 4)), foot=foot)


def egg(rng: Rng) -> Shape:
    """An ellipsoid on a flat foot."""
    y = _between(rng, 12, 40)
    return Superquadric((y * _between(rng, 1, 1.35), y, max(13.5, y * _between(rng, 0.9, 2.1))))


def superquadric(rng: Rng) -> Shape:
    """Between ellipsoid and box: soap, pebbles, cushions."""
    half = _between(rng, 14, 44), _between(rng, 12, 36), _between(rng, 20, 65)
    return Superquadric(half, round_power=_skewed(rng, 2, 7), upright_power=_skewed(rng, 2.2, 8))


def blob(rng: Rng) -> Shape:
    """Blended balls: a potato, a root, a figurine."""
    count, radius = int(rng.integers(3, 7)), _between(rng, 10, 24)
    balls, place = [], np.array([0.0, 0.0, 0.8 * radius])
    for _ in range(count):
        balls.append((*place, radius * rng.uniform(0.7, 1.1)))
        place = place + radius * rng.uniform([-0.9, -0.6, 0.3], [0.9, 0.6, 1.0])
    array = np.array(balls)
    array[:, :2] -= (array[:, :2].max(axis=0) + array[:, :2].min(axis=0)) / 2
    array[:, 2] -= (array[:, 2] - array[:, 3]).min() + 0.12 * radius  # sink it into the table for a flat foot
    return Blobs(tuple((float(x), float(y), float(z), float(r)) for x, y, z, r in array), blend_mm=_between(rng, 6, 16))


def ring(rng: Rng) -> Shape:
    """A standing ring or a chain link."""
    tube, stretch = _between(rng, 5, 14), float(rng.choice([0.0, _between(rng, 10, 60)]))
    return Ring(tube + _between(rng, 8, 50 - 2 * tube), tube, stretch_mm=stretch)


def mug(rng: Rng) -> Shape:
    """A cup with a handle."""
    radius, height = _between(rng, 22, 36), _between(rng, 60, 110)
    inside = Drum(radius - _between(rng, 2.8, 5), _between(rng, 4, 8), height + 20, rim_mm=4)
    handle = height * _between(rng, 0.22, 0.32), _between(rng, 3.5, 6)
    return Mug(Drum(radius, 0, height, rim_mm=1.2), inside, handle)


def bracket(rng: Rng) -> Shape:
    """An angle, a T or a channel, standing on end."""
    x, y, wall = _between(rng, 16, 45), _between(rng, 10, 30), _between(rng, 4, 10)
    height, rim = _between(rng, 35, 120), _between(rng, 0.6, 1.6)
    web = Brick((0, y - wall / 2), (x, wall / 2), 0, height, rim)
    places = ((x - wall / 2,), (0.0,), (wall / 2 - x, x - wall / 2))[int(rng.integers(3))]
    return Bricks(
        (web, *(Brick((place, 0), (wall / 2, y), 0, height * _between(rng, 0.6, 1), rim) for place in places))
    )


def steps(rng: Rng) -> Shape:
    """Stacked blocks of decreasing size."""
    count, height = int(rng.integers(2, 5)), _between(rng, 40, 130)
    tops = height * np.cumsum(rng.dirichlet(np.full(count, 4.0)))
    sizes = np.sort(rng.uniform(0.35, 1, count))[::-1] / 1.0
    x, y, rim = _between(rng, 20, 44), _between(rng, 16, 40), _between(rng, 0.8, 2.5)
    bars = [
        Brick((0, 0), (x * s / sizes[0], y * s / sizes[0]), 0, float(t), rim) for s, t in zip(sizes, tops, strict=True)
    ]
    return Bricks(tuple(bars))


def comb(rng: Rng) -> Shape:
    """A slab with slots: a comb, a grate, a heat sink."""
    height, thick, pitch = _between(rng, 50, 120), _between(rng, 4.5, 14), _skewed(rng, 4, 13)
    slab_ = Brick((0, 0), (_between(rng, 24, 50), thick), 0, height, _between(rng, 0.6, 1.5))
    lying = bool(rng.random() < 0.4)
    slot = -slab_.half_mm[0] * _between(rng, -0.2, 0.6) if lying else height * _between(rng, -0.35, 0.0)
    return Comb(slab_, pitch_mm=pitch, gap_mm=pitch * _between(rng, 0.35, 0.6), slot_mm=slot, lying=lying)


def brush(rng: Rng) -> Shape:
    """Bristles or pins on a block."""
    pitch, top = _skewed(rng, 4, 10), _between(rng, 60, 130)
    block = Brick((0, 0), (_between(rng, 18, 46), _between(rng, 9, 28)), 0, top * _between(rng, 0.2, 0.5), 1.5)
    return Brush(block, bristle_mm=pitch * _between(rng, 0.26, 0.4), pitch_mm=pitch, top_mm=top)


SHAPES: Mapping[str, Callable[[Rng], Shape]] = MappingProxyType(
    {
        maker.__name__: maker
        for maker in (
            *(box, slab, oval, prism, twist, pyramid),
            *(cylinder, tin, bottle, vase, cone, spool, pawn, dumbbell, tube, knob, screw),
            *(egg, superquadric, blob, ring, mug, bracket, steps, comb, brush),
        )
    }
)
