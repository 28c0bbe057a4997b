"""Colour and paint, drawn from a separate random stream: they are independent of all tactile properties."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Colours = NDArray[np.float32]


@dataclass(frozen=True)
class Paint:
    """A second colour (linear RGB, 0 to 1) where a field of random waves is above `threshold`.

    `edge` is the width of the edge in units of the field.
    """

    colour: tuple[float, float, float]
    waves_per_mm: tuple[tuple[float, float, float], ...]
    phases: tuple[float, ...]
    threshold: float
    edge: float

    def cover(self, points: NDArray[np.floating]) -> Colours:
        """Return the opacity (N,) from 0 to 1 at points (N, 3) in mm."""
        field = np.zeros(len(points), np.float32)
        for wave, phase in zip(self.waves_per_mm, self.phases, strict=True):
            field += np.sin(points @ np.array(wave, np.float32) + np.float32(phase))
        field *= np.float32(np.sqrt(2 / len(self.phases)))
        return np.asarray(np.clip((field - np.float32(self.threshold)) / np.float32(self.edge) + np.float32(0.5), 0, 1))


@dataclass(frozen=True)
class Label:
    """A printed rectangle at a height and an angle, with lines in another colour."""

    colour: tuple[float, float, float]
    ink: tuple[float, float, float]
    angle_rad: float
    half_angle_rad: float
    bottom_mm: float
    top_mm: float
    line_mm: float


@dataclass(frozen=True)
class Appearance:
    """Base colour (linear RGB, 0 to 1), grain, paint and label."""

    colour: tuple[float, float, float]
    grain: float = 0.0
    paint: Paint | None = None
    label: Label | None = None

    def albedo(self, points: NDArray[np.floating]) -> Colours:
        """Return the reflectance (N, 3) in 0..1 at points (N, 3) of the object's frame, mm."""
        place = np.asarray(points, np.float32)
        colour = np.broadcast_to(np.array(self.colour, np.float32), (len(place), 3))
        if self.paint is not None:
            colour = _over(colour, self.paint.colour, self.paint.cover(place))
        if self.label is not None:
            colour = _labelled(colour, self.label, place)
        if self.grain:
            colour = colour * (1 + np.float32(self.grain) * _speckle(place)[:, None])
        return np.clip(colour, 0, 1).astype(np.float32)


def _speckle(place: Colours) -> Colours:
    """Return a pattern of specks of about 4 mm, -1 to 1; finer ones would flicker between a camera's pixels."""
    waves = np.array([[1.1, 0.5, 0.9], [-0.4, 1.0, 0.6], [0.7, -0.8, 1.2]], np.float32)
    return np.asarray(np.prod([np.sin(place @ wave) for wave in waves], axis=0))


def _over(below: Colours, above: tuple[float, float, float], opacity: Colours) -> Colours:
    return below + opacity[:, None] * (np.array(above, np.float32) - below)


def _labelled(colour: Colours, label: Label, place: Colours) -> Colours:
    angle = np.arctan2(place[:, 0], -place[:, 1]) - np.float32(label.angle_rad)
    angle = np.abs(angle - np.float32(2 * np.pi) * np.rint(angle / np.float32(2 * np.pi)))
    z = place[:, 2]
    inside = (angle < label.half_angle_rad) & (z > label.bottom_mm) & (z < label.top_mm)
    row = (z - np.float32(label.bottom_mm)) / np.float32(label.line_mm)
    line_length = 0.35 + 0.5 * np.abs(np.sin(np.floor(row) * 12.9898))
    inked = inside & (row - np.floor(row) < 0.45) & (angle < line_length * label.half_angle_rad)
    colour = _over(colour, label.colour, inside.astype(np.float32))
    return _over(colour, label.ink, inked.astype(np.float32))


def draw_appearance(rng: np.random.Generator) -> Appearance:
    """Draw uniform hue and lightness; half of the objects are painted, a quarter are labelled."""
    colour = _draw_colour(rng)
    paint = _draw_paint(rng) if rng.random() < 0.5 else None
    label = _draw_label(rng) if rng.random() < 0.25 else None
    return Appearance(colour, float(rng.uniform(0, 0.08)), paint, label)


def _draw_colour(rng: np.random.Generator) -> tuple[float, float, float]:
    """Draw uniform hue, saturation and lightness; convert by HSL with f(n) = l - a max(-1, min(k-3, 9-k, 1))."""
    hue, saturation, lightness = rng.uniform(0, 12), rng.uniform(0, 0.9), rng.uniform(0.15, 0.85)
    k = (np.array([0, 8, 4]) + hue) % 12
    mix = np.clip(np.minimum(k - 3, 9 - k), -1, 1)
    red, green, blue = lightness - saturation * min(lightness, 1 - lightness) * mix
    return float(red), float(green), float(blue)


def _draw_paint(rng: np.random.Generator) -> Paint:
    """Draw blotches of 8 to 60 mm, or stripes, where all waves have one direction."""
    scale = np.exp(rng.uniform(np.log(8), np.log(60)))
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    waves = rng.standard_normal((8, 3)) * 2.2 / scale
    if rng.random() < 0.4:
        waves = np.outer(rng.choice([1, 2, 3], 2), axis) * 2 * np.pi / (2 * scale)
    return Paint(
        _draw_colour(rng),
        tuple((float(x), float(y), float(z)) for x, y, z in waves),
        tuple(float(phase) for phase in rng.uniform(0, 2 * np.pi, len(waves))),
        float(rng.uniform(-0.5, 1)),
        float(np.exp(rng.uniform(np.log(0.05), np.log(1)))),
    )


def _draw_label(rng: np.random.Generator) -> Label:
    bottom = rng.uniform(8, 50)
    return Label(
        _draw_colour(rng),
        _draw_colour(rng),
        float(rng.uniform(-np.pi, np.pi)),
        float(rng.uniform(0.3, 1.2)),
        float(bottom),
        float(bottom + rng.uniform(15, 60)),
        float(rng.uniform(4, 10)),
    )
