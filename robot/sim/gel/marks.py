"""Marks on a gel: specks of dust, hairs, scratches, grains under the skin, and printed markers."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot.sim.gel.surface import Array, Field, Surface

_SUBPIXEL = 4  # cv2 draws at 1/16 of a pixel


@dataclass(frozen=True)
class Flaws:
    """Flaws of one gel, placed and sized by `seed`: dark specks, hairs and scratches, grains (bumps) under the skin.

    `texture` is the rms slope of the skin's roughness.
    """

    seed: int
    specks: int = 14
    hairs: int = 3
    grains: int = 25
    texture: float = 0.012


@lru_cache(maxsize=32)
def flaw_maps(flaws: Flaws, field: Field) -> tuple[Array, Array, Array]:
    """Return the effect of flaws on a picture, (rows, cols) each; their places do not depend on the image's size.

    Returns:
        A factor of the picture, and additions to the gel's slope to the right and downwards.
    """
    rng = np.random.default_rng([flaws.seed, 0x6E1])
    darkening = _specks(rng, flaws.specks, field) * _hairs(rng, flaws.hairs, field)
    down, right = np.gradient(_grains(rng, flaws.grains, field), field.pixel_mm)
    rough = rng.standard_normal((2, field.rows, field.cols), dtype=np.float32)
    # Skin is rough at many scales; a camera still resolves grains of two pixels.
    rough = np.stack([cv2.GaussianBlur(noise, (0, 0), 1.4) * np.float32(5.0 * flaws.texture) for noise in rough])
    return darkening, (right + rough[0]).astype(np.float32), (down + rough[1]).astype(np.float32)


def _places(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    return rng.uniform(-0.5, 0.5, (count, 2))


def _specks(rng: np.random.Generator, count: int, field: Field) -> Array:
    """Draw dark dots of 0.03 to 0.12 mm; each transmits 50 to 90 % of the light."""
    out = np.ones((field.rows, field.cols), np.float32)
    radii, values = rng.uniform(0.03, 0.12, count), rng.uniform(0.5, 0.9, count)
    for place, radius, value in zip(_places(rng, count), radii, values, strict=True):
        _draw_dot(out, place, radius, float(value), field)
    return np.asarray(cv2.GaussianBlur(out, (0, 0), 0.7))


def _draw_dot(image: Array, place: NDArray[Any], radius_mm: float, value: float, field: Field) -> None:
    scale = 1 << _SUBPIXEL
    x = round(((place[0] + 0.5) * field.cols - 0.5) * scale)
    y = round(((place[1] + 0.5) * field.rows - 0.5) * scale)
    radius = max(1, round(radius_mm / field.pixel_mm * scale))
    cv2.circle(image, (x, y), radius, value, -1, cv2.LINE_8, _SUBPIXEL)


def _hairs(rng: np.random.Generator, count: int, field: Field) -> Array:
    """Draw thin dark arcs of 0.5 to 2.5 mm: hairs on the gel and scratches in it."""
    out = np.ones((field.rows, field.cols), np.float32)
    for place in _places(rng, count):
        length, bend, angle = rng.uniform(0.5, 2.5), rng.uniform(-1.5, 1.5), rng.uniform(0, 2 * math.pi)
        along = np.linspace(-0.5, 0.5, 9)
        turn = angle + bend * along
        path = np.cumsum(np.stack([np.cos(turn), np.sin(turn)], axis=1), axis=0) * length / 9 / field.pixel_mm
        path += (place + 0.5) * (field.cols, field.rows)
        points = np.rint(path * (1 << _SUBPIXEL)).astype(np.int32)[:, None]
        cv2.polylines(out, [points], False, float(rng.uniform(0.7, 0.9)), 1, cv2.LINE_8, _SUBPIXEL)
    return np.asarray(cv2.GaussianBlur(out, (0, 0), 0.6))


def _grains(rng: np.random.Generator, count: int, field: Field) -> Array:
    """Return heights in mm of little bumps (grit under the skin, 0.05 to 0.15 mm wide)."""
    x, y = field.positions()
    height, width = field.size_mm
    out = np.zeros((field.rows, field.cols), np.float32)
    places, radii, slopes = _places(rng, count), rng.uniform(0.05, 0.15, count), rng.uniform(0.05, 0.3, count)
    for place, radius, slope in zip(places, radii, slopes, strict=True):
        across = np.exp(-(((x - place[0] * width) / radius) ** 2))
        out += np.float32(slope * radius) * across * np.exp(-(((y - place[1] * height) / radius) ** 2))
    return out


# Markers ---------------------------------------------------------------------------------------------------

_SPREAD, _REACH_MM = 0.5, 1.0  # factor and smoothing length of the shift


@dataclass(frozen=True)
class Markers:
    """Black dots printed on the gel that move with its surface.

    A press spreads them: the shift is _SPREAD times sum u (x - x_i) exp(-|x - x_i|^2 / (2 _REACH_MM^2)), normalised,
    which is -_SPREAD * _REACH_MM * the slope of the smoothed displacement (the form of FOTS, RA-L 2024).

    `darkness` is the fraction of the light that a dot absorbs.
    """

    pitch_mm: float = 1.5
    radius_mm: float = 0.2
    darkness: float = 0.75


def marker_positions(markers: Markers, surface: Surface) -> Array:
    """Return x, y (count, 2) of the displaced dots in mm from the middle of the field."""
    at_rest = _rest_positions(markers, surface.field)
    heights = surface.coarse(4)
    height, width = surface.field.size_mm
    steps = np.array([width / heights.shape[1], height / heights.shape[0]])
    smooth = cv2.GaussianBlur(heights, (0, 0), *(_REACH_MM / steps))
    pixels = ((at_rest / (width, height) + 0.5) * heights.shape[::-1] - 0.5).astype(np.float32)
    out = at_rest.copy()
    for axis, step in enumerate(steps):
        slope = np.gradient(smooth, axis=1 - axis) / np.float32(step)
        at_dots = cv2.remap(slope, pixels[:, :1], pixels[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        out[:, axis] -= np.clip(at_dots[:, 0] * _SPREAD * _REACH_MM, -width, width)
    return out


def _rest_positions(markers: Markers, field: Field) -> Array:
    height, width = field.size_mm
    axes = [(np.arange(int(size / markers.pitch_mm)) + 0.5) * markers.pitch_mm for size in (width, height)]
    middles = [axis - axis.mean() if axis.size else np.zeros(1) for axis in axes]
    return np.stack([axis.ravel() for axis in np.meshgrid(*middles)], axis=1).astype(np.float32)


def marker_darkening(markers: Markers, surface: Surface) -> Array:
    """Return factors (rows, cols): 1, and 1 - darkness at a marker."""
    field = surface.field
    out = np.ones((field.rows, field.cols), np.float32)
    height, width = field.size_mm
    for place in marker_positions(markers, surface) / np.array([width, height], np.float32):
        _draw_dot(out, place, markers.radius_mm, 1 - markers.darkness, field)
    return np.asarray(cv2.GaussianBlur(out, (0, 0), 0.8))
