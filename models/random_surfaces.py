"""Random surfaces, and their presses into simulated gel sensors: training data of the gel tower.

A surface is one or two random textures of any scale on a random body. Its presses are at random places and forces, so
two presses of a surface share its relief, but no pixel.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot.sim.contact.layer import press
from robot.sim.gel.sensor import GelSensor, Picture
from robot.sim.objects.relief import RELIEFS, Relief, Sheet

Floats = NDArray[np.float32]
Places = NDArray[np.float64]
Rng = np.random.Generator

SIDE_MM, NODES = 48.0, 480
"""Side of a texture, which repeats, and its number of nodes."""
NODE_MM = SIDE_MM / NODES
GRID = (120, 160)
"""Rows and columns of the contact solver, over the camera's view."""
PIXELS = 2
"""Pixels of a picture along each side of a cell of GRID."""
MEAN_DISPLACEMENT_MM, MAX_DISPLACEMENT_MM = 0.012, 2.2
"""A press with less than this mean or more than this largest displacement is not used."""
BODIES = {"whole": 0.45, "edge": 0.12, "disc": 0.1, "ring": 0.08, "bar": 0.1, "box": 0.08, "corner": 0.07}
"""Probability of each outline of a body."""


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def turned(x: Places, y: Places, angle_rad: float) -> tuple[Places, Places]:
    """Return the coordinates of places along and across an axis at an angle to x."""
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return cosine * x + sine * y, cosine * y - sine * x


# Textures: height maps (NODES, NODES) of about 0..1 -----------------------------------------------------------


def noise(rng: Rng) -> Floats:
    """Draw noise of a random spectrum, isotropic or stretched, as it is, folded, or cut."""
    frequency = np.fft.fftfreq(NODES, NODE_MM)
    x, y = np.meshgrid(frequency, frequency)
    angle, stretch = rng.uniform(0, math.pi), math.exp(rng.uniform(0, 1.4)) if rng.random() < 0.5 else 1.0
    along, across = turned(x, y, angle)
    waves = np.hypot(along * stretch, across / stretch) * log_uniform(rng, 0.4, 8.0)
    if rng.random() < 0.5:
        spectrum = np.exp(-0.5 * ((waves - 1) / rng.uniform(0.1, 0.6)) ** 2)
    else:
        spectrum = (1 + waves**2) ** -rng.uniform(0.8, 2.2)
    heights = np.fft.ifft2(np.fft.fft2(rng.standard_normal((NODES, NODES))) * spectrum).real
    heights = (heights - heights.mean()) / heights.std()
    changed = (
        heights,
        np.abs(heights),
        -np.abs(heights),
        np.tanh(rng.uniform(1, 5) * (heights - rng.uniform(-1, 1))),
        np.maximum(heights, rng.uniform(-0.5, 0.8)),
    )[rng.integers(5)]
    low, high = np.percentile(changed, [1, 99])
    return np.asarray(np.clip((changed - low) / max(high - low, 1e-6), -0.1, 1.1), np.float32)


def family(rng: Rng) -> Floats:
    """Draw a relief of one of the simulator's families, with a pitch of 0.6 to 9 mm, raised or engraved."""
    name = str(rng.choice([each for each in RELIEFS if each != "smooth"]))
    angle = float(rng.choice([0, math.pi / 2, rng.uniform(-math.pi / 2, math.pi / 2)]))
    aspect = 1.0 if rng.random() < 0.4 else float(rng.uniform(1, 2.2))
    pitch_mm = log_uniform(rng, 2, 14)  # a relief has at least 1 mm, so the sheet is scaled instead
    relief = Relief(name, 0.5, pitch_mm, angle, aspect, float(rng.uniform(0, 0.9)), False, int(rng.integers(2**31)))
    scale = pitch_mm / log_uniform(rng, 0.6, 9)
    sheet = Sheet(SIDE_MM * scale, SIDE_MM * scale, NODES, NODES)
    heights = np.clip(RELIEFS[name](relief, sheet, rng), 0, 1).astype(np.float32)
    return 1 - heights if rng.random() < 0.3 else heights


def strokes(rng: Rng) -> Floats:
    """Draw curved strokes, parallel or in all directions, as ridges or grooves."""
    canvas = np.zeros((NODES, NODES), np.uint8)
    thickness, direction, spread = int(rng.integers(1, 9)), rng.uniform(0, math.pi), rng.choice([0.1, 0.4, 3.0])
    for _ in range(round(log_uniform(rng, 15, 400))):
        turn = direction + rng.normal(0, spread) + rng.normal(0, 0.6) * np.linspace(0, 1, 8)
        steps = np.stack([np.cos(turn), np.sin(turn)], 1) * rng.uniform(10, 160) / 8
        path = rng.uniform(0, NODES, 2) + np.cumsum(steps, 0)
        points = np.rint(16 * path).astype(np.int32)[:, None]
        cv2.polylines(canvas, [points], False, int(rng.integers(120, 256)), thickness, cv2.LINE_AA, 4)
    heights = cv2.GaussianBlur(canvas, (0, 0), rng.uniform(0.7, 3)).astype(np.float32)
    heights /= max(float(heights.max()), 1e-6)
    return np.asarray(1 - heights if rng.random() < 0.4 else heights, np.float32)


def patches(rng: Rng) -> Floats:
    """Draw discs, ovals, rings or polygons of similar sizes, raised or engraved."""
    canvas = np.zeros((NODES, NODES), np.float32)
    radius, kind, aspect = log_uniform(rng, 3, 30), rng.integers(4), rng.uniform(1, 3)
    variation, angle, turn = rng.uniform(0, 0.6), rng.uniform(0, 180), rng.choice([5.0, 180.0])
    for _ in range(round(log_uniform(rng, 20, 500))):
        place, height = rng.uniform(0, NODES, 2), float(rng.uniform(0.5, 1))
        size = radius * math.exp(variation * rng.standard_normal())
        if kind == 3:
            corners = np.sort(rng.uniform(0, 2 * math.pi, rng.integers(3, 7)))
            path = place + size * np.stack([np.cos(corners), np.sin(corners)], 1)
            cv2.fillPoly(canvas, [np.rint(16 * path).astype(np.int32)], height, cv2.LINE_8, 4)
        else:
            oval = tuple(place.tolist()), (2 * size, 2 * size / aspect), angle + rng.uniform(-turn, turn)
            cv2.ellipse(canvas, oval, height, -1 if kind < 2 else max(1, int(size / 4)), cv2.LINE_8)
    heights = cv2.GaussianBlur(canvas, (0, 0), max(0.7, radius * rng.uniform(0.05, 0.5)))
    heights /= max(float(heights.max()), 1e-6)
    return np.asarray(1 - heights if rng.random() < 0.25 else heights, np.float32)


def texture(rng: Rng) -> Floats:
    """Draw a texture of any kind."""
    return (noise, family, strokes, patches)[rng.choice(4, p=[0.25, 0.45, 0.15, 0.15])](rng)


# Surfaces ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RandomSurface:
    """A texture on a body.

    Attributes:
        heights_mm: (NODES, NODES) texture in mm; it repeats.
        curvatures: Curvatures of the body along its two axes, 1/mm.
        angle_rad: Direction of the first axis.
        outline: One of BODIES.
        size_mm: Size of the outline.
        aspect: Ratio of its sides.
        rounding: Roundness of its edge.
        bow_mm: Radius of the pad's curvature, which brings contacts to the middle.
        modulus_mpa: Young's modulus of the body.
        turns: Whether presses come at any turn, or at nearly the same.
    """

    heights_mm: Floats
    curvatures: tuple[float, float]
    angle_rad: float
    outline: str
    size_mm: float
    aspect: float
    rounding: float
    bow_mm: float
    modulus_mpa: float
    turns: bool

    @classmethod
    def draw(cls, seed: int) -> "RandomSurface":
        """Draw the surface of a seed."""
        rng = np.random.default_rng([seed, 0x5F])
        amplitude_mm = log_uniform(rng, 0.03, 1.2)
        heights = amplitude_mm * texture(rng)
        if rng.random() < 0.45:
            heights += amplitude_mm * math.exp(rng.uniform(-2.5, -0.3)) * texture(rng)
        if rng.random() < 0.06:
            heights = np.zeros_like(heights)
        return cls(
            heights,
            (_curvature(rng), _curvature(rng)),
            float(rng.uniform(0, math.pi)),
            str(rng.choice(list(BODIES), p=list(BODIES.values()))),
            log_uniform(rng, 1.2, 8),
            float(rng.uniform(1, 3)),
            float(rng.uniform(0.2, 2)),
            log_uniform(rng, 25, 200),
            log_uniform(rng, 0.2, 50) if rng.random() < 0.3 else math.inf,
            bool(rng.random() < 0.5),
        )

    def gap_mm(self, rng: Rng, pixel_mm: float) -> Places:
        """Return the gap (GRID) below the surface at a random place and turn, 0 at its highest point.

        Args:
            rng: Draws the place.
            pixel_mm: Side of a cell of GRID.
        """
        x, y = np.meshgrid(*((np.arange(count) - (count - 1) / 2) * pixel_mm for count in GRID[::-1]))
        turn = rng.uniform(0, 2 * math.pi) if self.turns else rng.normal(0, 0.15)
        across, down = rng.normal(0, 2.5 if self.outline == "whole" else 1.5, 2)
        u, v = turned(x - across, y - down, turn)
        starts = rng.uniform(0, NODES, 2)
        columns, rows = (
            np.mod(along / NODE_MM + start, NODES).astype(np.float32)
            for along, start in zip((u, v), starts, strict=True)
        )
        height = cv2.remap(self.heights_mm, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(float)
        p, q = turned(u, v, self.angle_rad)
        height -= 0.5 * (self.curvatures[0] * p**2 + self.curvatures[1] * q**2) + 0.5 * (x**2 + y**2) / self.bow_mm
        outside = np.clip(self._outside_mm(p, q), 0, None)
        height -= outside**1.5 / self.rounding + np.where(outside > 3 * self.rounding, 3.0, 0.0)
        height += math.tan(rng.normal(0, 0.03)) * x + math.tan(rng.normal(0, 0.03)) * y
        return np.asarray(height.max() - height)

    def _outside_mm(self, p: Places, q: Places) -> Places:
        """Return the distance from the outline at places on the body's axes; negative inside."""
        size, aspect = self.size_mm, self.aspect
        match self.outline:
            case "edge":
                return p
            case "disc":
                return np.hypot(p, q * aspect) - size
            case "ring":
                return np.abs(np.hypot(p, q) - size) - 0.3 * size / aspect
            case "bar":
                return np.abs(p) - size / 2
            case "box":
                return np.maximum(np.abs(p) - size, np.abs(q) - size / aspect)
            case "corner":
                return np.maximum(p, q)
        return np.full_like(p, -1.0)


def _curvature(rng: Rng) -> float:
    if rng.random() < 0.35:
        return 0.0
    return float(rng.choice([1, 1, 1, -1])) / log_uniform(rng, 5, 120)


def presses(surface: RandomSurface, sensor: GelSensor, rng: Rng, tries: int) -> Iterator[Picture]:
    """Yield the pictures of the useful ones of some presses.

    Args:
        surface: The surface.
        sensor: The gel sensor.
        rng: Draws places and forces.
        tries: Number of presses.
    """
    pixel_mm = PIXELS * sensor.field.pixel_mm
    elastic: dict[str, Any] = {}
    if math.isfinite(surface.modulus_mpa):
        elastic = {"object_modulus_mpa": surface.modulus_mpa, "object_poisson": 0.4}
    for _ in range(tries):
        gap, force_n = surface.gap_mm(rng, pixel_mm), log_uniform(rng, 1.5, 25)
        contact = press(gap, pixel_mm, sensor.layer, force_n=force_n, tolerance=2e-2, max_iterations=60, **elastic)
        depth = contact.displacement_mm
        if depth.mean() >= MEAN_DISPLACEMENT_MM and depth.max() <= MAX_DISPLACEMENT_MM:
            yield sensor.render(depth, int(rng.integers(2**31)))
