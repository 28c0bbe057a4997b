"""The grid of sky occlusion in photos of the simulated rig."""

from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np

from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff
from retrieval.frontier.sample import Sample
from robot.sim.camera import SKY_STEPS, PinholeCamera, Placement, cast_camera_rays, sky_occlusion
from robot.sim.objects.draw import draw_object

_SKY_FRACTION = 0.45 * 0.25 / 0.5
"""Approximate fraction of a table's light that comes from the sky and that an object can block."""


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
