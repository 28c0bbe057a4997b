"""Optics fitted to real presses: the change of colour is a low-order polynomial of the normal and the position.

    I_c(p) = backdrop_c(p) + sum_k sum_j  w_kjc  place_j(p)  feature_k(p)

Features are the products nx^i ny^j with 1 <= i + j <= degree, and for each reach the displacement smoothed over that
reach and its two slopes: scattered light and soft shadows come from the wider neighbourhood. Place terms are 1, x, y,
xy, x^2, y^2 (x, y from -1 to 1 over the field), or the first of them. A flat gel has no feature, so it shows the
backdrop: a polynomial in x and y.

A polynomial diverges outside the range of the fitted presses (steeper normals, deeper neighbourhoods, places without
presses), so every quantity is clipped to the limits of the fit.
"""

import json
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Any

import cv2
import numpy as np

from _touch_retrieval.documents import typed
from robot.sim.gel.surface import Array, Field, Surface, resized


@dataclass(frozen=True)
class FittedLimits:
    """Ranges of the fitted presses; every input is clipped to them.

    Attributes:
        steepest: greatest |n|, the sine of the tilt.
        left, right, top, bottom: extent of the presses in x and y.
        lowest, highest: least and greatest value of each smoothed map.
    """

    steepest: float
    left: float
    right: float
    top: float
    bottom: float
    lowest: tuple[float, ...]
    highest: tuple[float, ...]


@dataclass(frozen=True)
class FittedOptics:
    """Optics of a fitted sensor.

    Attributes:
        degree: degree of the polynomial in the normal.
        places: number of place terms.
        reaches_mm: smoothing lengths of the neighbourhood features.
        weights: (features x places, 3), row by row.
        flat_degree: degree of the backdrop.
        flat: (terms, 3) coefficients of the backdrop.
        limits: ranges of the fitted presses.
    """

    degree: int
    places: int
    reaches_mm: tuple[float, ...]
    weights: tuple[tuple[float, ...], ...]
    flat_degree: int
    flat: tuple[tuple[float, ...], ...]
    limits: FittedLimits

    def colours(self, surface: Surface, slopes: tuple[Array, Array]) -> Array:
        """Return the backdrop plus the weighted features (rows, cols, 3)."""
        backdrop, weights = _maps(self, surface.field)
        features = normal_features(*self._tilts(slopes), self.degree)
        if self.reaches_mm and surface.displacement_mm.any():
            features += self._neighbourhood(surface)
        out = backdrop.copy()
        part = np.empty_like(features[0])
        for channel in range(3):
            total = np.zeros_like(part)
            for feature, weight in zip(features, weights, strict=False):
                np.multiply(feature, weight[channel], out=part)
                total += part
            out[..., channel] += total
        return out

    def _tilts(self, slopes: tuple[Array, Array]) -> tuple[Array, Array]:
        """Return nx and ny, limited to the steepest fitted tilt."""
        slope_x, slope_y = slopes
        square = slope_x * slope_x + slope_y * slope_y
        steepest = np.float32(min(self.limits.steepest, 1))
        shrink = steepest / np.maximum(np.sqrt(square / (1 + square)), steepest)
        shrink /= -np.sqrt(1 + square)
        return slope_x * shrink, slope_y * shrink

    def _neighbourhood(self, surface: Surface) -> list[Array]:
        """Return the smoothed displacement and its slopes at the pixels, for each reach."""
        field = surface.field
        heights = surface.coarse(4)  # the shortest reach is many pixels
        steps = [size / count for size, count in zip(field.size_mm, heights.shape, strict=True)]
        maps = []
        for reach in self.reaches_mm:
            smooth = cv2.GaussianBlur(heights, (0, 0), reach / steps[1], sigmaY=reach / steps[0])
            slopes = (np.gradient(smooth, np.float32(steps[axis]), axis=axis) for axis in (1, 0))
            maps += [smooth, *(slope.astype(np.float32) for slope in slopes)]
        limits = zip(maps, self.limits.lowest, self.limits.highest, strict=True)
        return [resized(np.clip(values, low, high), (field.rows, field.cols)) for values, low, high in limits]


def normal_features(nx: Any, ny: Any, degree: int) -> list[Any]:
    """Return nx^i ny^j for i + j = 1, 2, ... degree."""
    powers_x, powers_y = [np.ones_like(nx)], [np.ones_like(ny)]
    for _ in range(degree):
        powers_x.append(powers_x[-1] * nx)
        powers_y.append(powers_y[-1] * ny)
    return [powers_x[total - j] * powers_y[j] for total in range(1, degree + 1) for j in range(total + 1)]


def place_powers(degree: int) -> list[tuple[int, int]]:
    """Return powers of x and y up to a total degree: for degree 2, in order, 1, x, y, x^2, xy, y^2."""
    return [(total - j, j) for total in range(degree + 1) for j in range(total + 1)]


def place_terms(x: Any, y: Any, count: int) -> list[Any]:
    """Return the first `count` of 1, x, y, xy, x^2, y^2."""
    return [np.ones_like(x * y), x, y, x * y, x * x, y * y][:count]


@lru_cache(maxsize=4)
def _maps(optics: FittedOptics, field: Field) -> tuple[Array, list[Array]]:
    """Return the backdrop, and the weight (3, rows, cols) of each feature at every pixel; cached per sensor."""
    x, y = field.unit_positions()
    flat = np.array(optics.flat, np.float32)
    powers = place_powers(optics.flat_degree)
    backdrop = sum(x[..., None] ** i * y[..., None] ** j * row for (i, j), row in zip(powers, flat, strict=True))
    limits = optics.limits
    clipped = np.clip(x, limits.left, limits.right), np.clip(y, limits.top, limits.bottom)
    places = [np.broadcast_to(term, (field.rows, field.cols)) for term in place_terms(*clipped, optics.places)]
    weights = np.array(optics.weights, np.float32).reshape(-1, optics.places, 3)
    maps = [np.tensordot(row.T, np.stack(places), axes=1) for row in weights]
    return np.maximum(np.asarray(backdrop, np.float32), 1), maps


# Files -----------------------------------------------------------------------------------------------------


FITTED = "gelsight", "gelsight_mini"
"""Sensors with a shipped fit."""


def fitted_document(name: str) -> dict[str, Any]:
    """Return the shipped file of a sensor of `FITTED`: source, settings, held-out results, model."""
    path = resources.files("robot.sim.gel") / "fitted" / f"{name}.json"
    return json.loads(path.read_text())  # type: ignore[no-any-return]


@lru_cache(maxsize=8)
def load_fitted(name: str) -> FittedOptics:
    """Load the shipped fit of a sensor of `FITTED`."""
    return typed(fitted_document(name)["model"], FittedOptics, "model")
