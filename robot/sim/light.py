"""Shading of each pixel of the camera in one compiled pass.

Reflectance and lamps give radiance; radiance gives grey levels. Powers of float32 are computed as exponentials of
logarithms, with an error below a thousandth of a grey level.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot.sim.jit import jit

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Picture = NDArray[np.uint8]
GAMMA = 2.2


class GBuffer(NamedTuple):
    """Surface at each pixel.

    Attributes:
        rays: (n, 3) unit direction of the ray.
        normals: (n, 3) outward unit normal.
        is_object: (n,) whether the pixel shows the object.
        lamp_visibility: (n,) visible fraction of the lamp, 0..1.
        occlusion: (n,) fraction of the sky that the object hides, 0..1.
        colour: (n, 3) linear reflectance.
    """

    rays: Array
    normals: Floats
    is_object: NDArray[np.bool_]
    lamp_visibility: Floats
    occlusion: Floats
    colour: Floats


class Lamps(NamedTuple):
    """Light: direction (3,) to the lamp; colours (3,) of lamp and sky with the exposure; highlights.

    `gloss` is the strength of the highlight of the object and of the table, `sharpness` its exponent.
    """

    direction: Array
    lamp: Array
    sky: Array
    gloss: tuple[float, float]
    sharpness: float


def radiance(surfaces: GBuffer, lamps: Lamps) -> Floats:
    """Return the radiance (n, 3) from the lamp (Lambert, and Blinn's highlight) and the upper hemisphere of the sky."""
    out = np.empty(surfaces.rays.shape, np.float32)
    _shade(surfaces, lamps, out)
    return out


def develop(linear: Floats, noise: Array) -> Picture:
    """Convert a linear picture (rows, columns, 3) to grey levels with sensor noise (in grey levels)."""
    out = np.empty(linear.shape, np.uint8)
    _develop(linear.reshape(-1), noise.reshape(-1), out.reshape(-1))
    return out


@jit
def _shade(surfaces, lamps, out):  # type: ignore[no-untyped-def]
    x, y, z = np.float32(lamps.direction[0]), np.float32(lamps.direction[1]), np.float32(lamps.direction[2])
    sharpness = np.float32(lamps.sharpness)
    for i in range(len(out)):
        n_x, n_y, n_z = surfaces.normals[i, 0], surfaces.normals[i, 1], surfaces.normals[i, 2]
        is_object = surfaces.is_object[i]
        lit = max(n_x * x + n_y * y + n_z * z, np.float32(0)) * surfaces.lamp_visibility[i]
        above = np.float32(0.6) + np.float32(0.4) * n_z
        if not is_object:
            above *= np.float32(1) - np.float32(0.45) * surfaces.occlusion[i]
        shine = np.float32(0)
        if lit > 0:
            h_x = x - np.float32(surfaces.rays[i, 0])
            h_y = y - np.float32(surfaces.rays[i, 1])
            h_z = z - np.float32(surfaces.rays[i, 2])
            cosine = (n_x * h_x + n_y * h_y + n_z * h_z) / np.sqrt(h_x * h_x + h_y * h_y + h_z * h_z)
            if cosine > 0:
                gloss = np.float32(lamps.gloss[0] if is_object else lamps.gloss[1])
                shine = gloss * np.exp(sharpness * np.log(cosine))
        for channel in range(3):
            colour = surfaces.colour[i, channel]
            lamp, sky = np.float32(lamps.lamp[channel]), np.float32(lamps.sky[channel])
            out[i, channel] = colour * (lit * lamp + above * sky) + shine * lamp


@jit
def _develop(linear, noise, out):  # type: ignore[no-untyped-def]
    power = np.float32(1 / GAMMA)
    for i in range(len(out)):
        light = min(linear[i], np.float32(1))
        grey = np.float32(255) * np.exp(power * np.log(light)) if light > 0 else np.float32(0)
        out[i] = np.uint8(min(max(grey + noise[i] + 0.5, 0.0), 255.0))
