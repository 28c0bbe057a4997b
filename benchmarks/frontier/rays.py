"""Rays of the simulated rig: step length of gel and camera rays."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff
from retrieval.frontier.sample import Sample
from robot.sim.camera import NOISE, PinholeCamera
from robot.sim.objects.body import GEL_STEP_MM, SdfBody, Vectors, clip_to_box
from robot.sim.objects.draw import draw_object
from robot.sim.objects.packets import Rays, first_hits, hits
from robot.sim.scene import Scene

_FAMILIES = ("knurl", "bumps", "weave")
_OBJECTS, _PX = 8, 256
_EXACT = 1 / 20
"""Step of the reference, relative to the detail of a photo's ray."""


def rays(sample: Sample) -> ApproximationResult:
    """Measure the steps of gel and photo rays."""
    text = (
        "Rays to a solid with relief: no step is shorter than half the requested detail, and where f changes sign two "
        "secants find the place. A gel requests 0.1 mm; its picture shows heights of some thousandths of a mm. The "
        "camera requests one of its pixels on the object, and two on the way to the lamp. Photos are compared with "
        "photos whose rays go in equal steps of a twentieth of that in plain numpy, over the same relief, which is as "
        "fine as a pixel. Errors below the noise of the camera's sensor are tolerated."
    )
    repeats = sample.scale.repeats
    few, objects, px = (12, 2, 64) if sample.scale.quick else (48, _OBJECTS, _PX)
    panels = gel_panel(repeats, few), photo_panel(repeats, objects, px)
    return ApproximationResult("Rays of the simulated rig", text, panels)


class RayMarcher(SdfBody):
    """A body whose rays take steps `stride` times as long; `casts` repeats the casts so far."""

    def __init__(self, body: SdfBody, stride: float) -> None:
        super().__init__(body.shape, body.relief)
        self.wall = body.wall
        self.stride = stride
        self.casts: list[Callable[[], NDArray[Any]]] = []

    def _cast(self, rays: Rays, step_mm: float) -> Vectors:
        return self._recorded(partial(self._by, first_hits, rays, step_mm))

    def _hit(self, rays: Rays, step_mm: float) -> NDArray[np.bool_]:
        return self._recorded(partial(self._by, hits, rays, step_mm))

    def _recorded(self, cast: Callable[[], NDArray[Any]]) -> NDArray[Any]:
        self.casts.append(cast)
        return cast()

    def _by(self, intersect: Callable[..., NDArray[Any]], rays: Rays, step_mm: float) -> NDArray[Any]:
        return intersect(self.displaced_solid(step_mm), rays, self.stride * step_mm)


class EqualStepMarcher(RayMarcher):
    """The same in equal steps of plain numpy, `stride` times the requested detail, without a limit."""

    def _by(self, intersect: Callable[..., NDArray[Any]], rays: Rays, step_mm: float) -> NDArray[Any]:
        found = by_equal_steps(self, rays, step_mm, self.stride * step_mm)
        return np.isfinite(found) if intersect is hits else found


def by_equal_steps(body: SdfBody, rays: Rays, detail_mm: float, step_mm: float) -> Vectors:
    """Return where the field in plain numpy first changes sign, refined by its chord; inf if it does not."""
    found, before, along = np.full(len(rays.near_mm), np.inf), np.zeros(len(rays.near_mm)), 0.0
    open_ = np.flatnonzero(rays.near_mm <= rays.far_mm)
    while len(open_):
        t = rays.near_mm[open_] + along
        x, y, z = (rays.origins[open_] + t[:, None] * rays.directions[open_]).astype(np.float32).T
        f = body.field(x, y, z, detail_mm).astype(np.float64)
        inside = f <= 0
        hit, fraction = open_[inside], f[inside] / (before[open_[inside]] - f[inside]) if along else 0.0
        found[hit] = t[inside] + step_mm * fraction
        before[open_] = f
        open_, along = open_[~inside & (t <= rays.far_mm[open_])], along + step_mm
    return found


# Gels ------------------------------------------------------------------------------------------------------


def gel_panel(repeats: int, rows: int = 48, steps_mm: Sequence[float] = (1.6, 0.8, 0.4, 0.2, 0.1, 0.05)) -> Panel:
    """Return a point for each step: the rms error of depth over three walls, `rows` by 4/3 `rows` rays each."""
    walls = [(body, *_rays_onto(body, rows)) for body in map(_wall, _FAMILIES)]
    exact = np.concatenate([_exact_depth(*wall) for wall in walls])
    met = np.isfinite(exact)
    points, works = list[Tradeoff](), [partial(_cast, walls, step) for step in steps_mm]
    for step, work in zip(steps_mm, works, strict=True):
        found = work()
        hit_in_both = met & np.isfinite(found)
        error = 1e3 * math.sqrt(float(np.mean((found[hit_in_both] - exact[hit_in_both]) ** 2)))
        points.append(Tradeoff("", f"{step:g} mm", error, is_default=step == GEL_STEP_MM))
    timed = time_points(points, works, repeats)
    reference, time = "equal steps of 0.01 mm", f"{len(exact):,} rays"
    return Panel("step of a gel's rays", time, "um rms of depth", reference, 2.0, timed)


def _wall(relief: str) -> SdfBody:
    body = draw_object(0, 0, family="box", relief=relief).body
    assert isinstance(body, SdfBody)
    return body


def _rays_onto(body: SdfBody, rows: int) -> tuple[Vectors, Vectors]:
    """Return parallel rays from the front, 6 mm away from the box, over 12 x 16 mm of its middle."""
    height, width = 12.0, 16.0
    z = 0.5 * body.upper[2] + height * (np.arange(rows) / rows - 0.5)
    x, up = np.meshgrid(width * (np.arange(rows * 4 // 3) / (rows * 4 // 3) - 0.5), z)
    origins = np.stack([x, np.full_like(x, body.lower[1] - 6.0), up], axis=-1).reshape(-1, 3)
    return origins, np.tile([0.0, 1.0, 0.0], (len(origins), 1))


def _exact_depth(body: SdfBody, origins: Vectors, directions: Vectors) -> Vectors:
    near, far = clip_to_box(origins, directions, body.lower, body.upper)
    return by_equal_steps(body, Rays(origins, directions, near, far), GEL_STEP_MM, 0.01)


def _cast(walls: Sequence[tuple[SdfBody, Vectors, Vectors]], step_mm: float) -> Vectors:
    return np.concatenate([body.cast(origins, directions, step_mm) for body, origins, directions in walls])


# Photos ----------------------------------------------------------------------------------------------------


def photo_panel(
    repeats: int, objects: int = _OBJECTS, px: int = _PX, strides: Sequence[float] = (16, 8, 4, 2, 1, 0.5, 0.25)
) -> Panel:
    """Return a point for each step: the rms error of photos of this many objects, and the time of all of their rays."""
    marchers = [("as the rig casts", RayMarcher, stride) for stride in strides]
    marchers += [("equal steps, plain numpy", EqualStepMarcher, stride) for stride in (1, 0.25, _EXACT)]
    taken = [_photos(marcher, stride, objects, px) for _, marcher, stride in marchers]
    exact = taken[-1][0]
    points = [
        Tradeoff(
            series,
            f"{stride:g} px",
            math.sqrt(float(np.mean((pictures - exact) ** 2))),
            is_default=marcher is RayMarcher and stride == 1,
        )
        for (series, marcher, stride), (pictures, _) in zip(marchers, taken, strict=True)
    ]
    timed = time_points(points, [casts for _, casts in taken], repeats)
    time, reference = f"rays of {objects} photos of {px} px, shadows included", f"equal steps of {_EXACT:g} px"
    return Panel("step of a photo's rays", time, "grey levels rms", reference, NOISE, timed)


def _photos(marcher: type[RayMarcher], stride: float, objects: int, px: int) -> tuple[Vectors, Callable[[], object]]:
    """Return grey levels (objects, px, px, 3), and a function that repeats all of their casts."""
    scenes = [_scene(marcher, stride, number, px) for number in range(objects)]
    pictures = np.array([scene.run()["photo"] for scene, _ in scenes], np.float64)
    casts = [again for _, body in scenes for again in body.casts]
    return pictures, lambda: [again() for again in casts]


def _scene(marcher: type[RayMarcher], stride: float, number: int, px: int) -> tuple[Scene, RayMarcher]:
    """Return a scene and its body; the camera has the rig's field of view."""
    obj = draw_object(0, number)
    assert isinstance(obj.body, SdfBody)
    body = marcher(obj.body, stride)
    camera = PinholeCamera(px=px, focal_px=PinholeCamera.focal_px * px / PinholeCamera.px)
    return Scene(dataclasses.replace(obj, body=body), camera=camera, seed=number, outputs={"photo"}), body
