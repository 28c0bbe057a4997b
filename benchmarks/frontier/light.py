"""Light of the simulated rig: the grid of sky occlusion, and float32 in the shading of photos."""

from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff
from retrieval.frontier.sample import Sample
from robot.sim.camera import (
    NOISE,
    SKY_STEPS,
    Lighting,
    PinholeCamera,
    Placement,
    cast_camera_rays,
    shading_inputs,
    sky_occlusion,
)
from robot.sim.light import GAMMA, GBuffer, Lamps, develop, radiance
from robot.sim.objects.draw import draw_object

Array = NDArray[np.float64]
_SKY_FRACTION = 0.45 * 0.25 / 0.5
"""Approximate fraction of a table's light that comes from the sky and that an object can block."""

# Sky -------------------------------------------------------------------------------------------------------


def sky(sample: Sample) -> ApproximationResult:
    """Measure the grid of sky occlusion on the table."""
    text = (
        "Next to an object the table receives less light from the sky. This is the object's mask, blurred on a coarse "
        "grid with this many points over the blur's width, in a photo of 512 px. The error is the largest of the "
        "table's light."
    )
    return ApproximationResult("Sky occlusion: grid", text, (sky_panel(sample.scale.repeats),))


def sky_panel(repeats: int, px: int = 512, steps: Sequence[int] = (1, 2, 4, 8)) -> Panel:
    """Return a point for each number of steps: the largest error of the table's light in per cent."""
    view = cast_camera_rays(draw_object(0, 3), Placement(), PinholeCamera(px=px, focal_px=860 * px / 256))
    mask = view.is_object.reshape(px, px)
    exact = cv2.GaussianBlur(mask.astype(np.float64), (0, 0), 0.03 * px)
    points, works = list[Tradeoff](), [partial(sky_occlusion, mask, count) for count in steps]
    for count, work in zip(steps, works, strict=True):
        error = 100.0 * _SKY_FRACTION * float(np.abs(work() - exact)[~mask].max())
        points.append(Tradeoff("", f"{count} steps", error, is_default=count == SKY_STEPS))
    labels = "sky occlusion", f"a photo of {px} px", "% of light", "the full grid"
    return Panel(*labels, 1.0, time_points(points, works, repeats))


# Arithmetic ------------------------------------------------------------------------------------------------


def light_panel(repeats: int, objects: int = 8, px: int = 256) -> Panel:
    """Return a point for each arithmetic: the largest difference of a grey level in photos of this many objects."""
    scenes = [_shading_inputs(number, px) for number in range(objects)]
    noise = NOISE * np.random.default_rng(0).standard_normal((px, px, 3))
    works = [
        partial(_compiled, scenes, noise),
        partial(_by_arrays, scenes, noise, np.float32),
        partial(_by_arrays, scenes, noise, np.float64),
    ]
    exact, names = works[-1](), ("float32, compiled", "float32, array by array", "float64, array by array")
    points = [
        Tradeoff(name, "", float(np.abs(work().astype(np.int64) - exact).max()), is_default=place == 0)
        for place, (name, work) in enumerate(zip(names, works, strict=True))
    ]
    time, reference = f"shading and developing {objects} photos of {px} px", "float64, array by array"
    timed = time_points(points, works, repeats)
    return Panel("arithmetic of light", time, "grey levels at most", reference, 1.0, timed)


def _shading_inputs(number: int, px: int) -> tuple[GBuffer, Lamps]:
    camera = PinholeCamera(px=px, focal_px=PinholeCamera.focal_px * px / PinholeCamera.px)
    view = cast_camera_rays(draw_object(0, number), Placement(), camera)
    return shading_inputs(view, Lighting.draw(np.random.default_rng(number)))


def _compiled(scenes: Sequence[tuple[GBuffer, Lamps]], noise: Array) -> NDArray[np.uint8]:
    return np.array([develop(radiance(*scene).reshape(noise.shape), noise) for scene in scenes])


def _by_arrays(scenes: Sequence[tuple[GBuffer, Lamps]], noise: Array, kind: type[np.floating]) -> NDArray[np.uint8]:
    pictures = []
    for scene in scenes:
        linear = np.clip(shaded(*scene, kind), 0, 1).reshape(noise.shape)
        grey = kind(255) * linear ** kind(1 / GAMMA) + noise
        pictures.append(np.clip(grey + 0.5, 0, 255).astype(np.uint8))
    return np.array(pictures)


def shaded(surfaces: GBuffer, lamps: Lamps, kind: type[np.floating] = np.float64) -> NDArray[np.floating]:
    """Return the radiance (n, 3) of `robot.sim.light.radiance`, by the same formulas in numpy, in this dtype."""
    rays, normals, is_object, visibility, occlusion, colour = (np.asarray(part, kind) for part in surfaces)
    direction, lamp, sky_colour = (part.astype(kind) for part in (lamps.direction, lamps.lamp, lamps.sky))
    is_object = is_object > 0
    lamp_term = np.maximum(normals @ direction, 0) * visibility
    sky_term = (kind(0.6) + kind(0.4) * normals[:, 2]) * np.where(is_object, 1, 1 - kind(0.45) * occlusion)
    half = direction - rays
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cosine = np.maximum(np.einsum("ij,ij->i", normals, half), 0)
    gloss = np.where(is_object, *(kind(each) for each in lamps.gloss))
    shine = gloss * cosine ** kind(lamps.sharpness) * (lamp_term > 0)
    light = lamp_term[:, None] * lamp + sky_term[:, None] * sky_colour
    return np.asarray(colour * light + shine[:, None] * lamp)
