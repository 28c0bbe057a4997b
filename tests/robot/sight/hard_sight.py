"""Extreme inputs of object localisation, depth conversion and the gate."""

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from robot.grasping.attempt import depth_in_mm
from robot.grasping.gates import ContactAreaGate, GraspFrames
from robot.readings import RGBD
from robot.sight.cloud import Rays, find_table
from robot.sight.cylinder import fit_cylinder
from robot.sight.solids import fit_circle
from tests import views
from tests.hard_case import HardCase, error_of

Array = npt.NDArray[np.float64]
_CYLINDER, _DEPTH = "cylinder fit", "depth"
_RADIUS, _HEIGHT = 33.0, 120.0
POSE = views.camera_pose()


def hard_cases() -> Iterator[HardCase]:
    """Yield the cases of the rig, in a few seconds."""
    yield _outliers()
    yield _short_arc()
    yield _straight_line()
    yield _unknown_depth()
    yield _nothing_but_nan()
    yield _crowded_table()
    yield _depth_as_millimetres()
    yield _gel_of_another_shade()


def _can(noise_mm: float = 0.0, outliers: float = 0.0) -> RGBD:
    """Return the picture of a can at the origin, from the side and above."""
    return views.view(views.UprightCylinder(_RADIUS, _HEIGHT), noise_mm=noise_mm, outliers=outliers)


def _picture(depth_mm: Array) -> RGBD:
    grey = np.full((*views.KINECT_PX, 3), 128, np.uint8)
    return RGBD(grey, (depth_mm / 1000.0).astype(np.float32), views.KINECT, 0.0)


def _points(image: RGBD, pose: Array) -> Array:
    """Return the (N, 3) points of all pixels with finite depth."""
    assert image.depth_m is not None
    rows, columns = np.nonzero(np.isfinite(image.depth_m))
    return Rays.from_image(image, pose).points(image.depth_m * np.float32(1000), rows, columns)


def naive_circle(plan: Array) -> tuple[float, float, float]:
    """Return x, y, radius of the circle through points (N, 2) by least squares on x^2 + y^2 (Kasa 1976)."""
    x, y = plan.T
    design = np.c_[2.0 * x, 2.0 * y, np.ones(len(plan))]
    a, b, c = np.linalg.lstsq(design, x**2 + y**2, rcond=None)[0]
    return float(a), float(b), float(np.sqrt(c + a**2 + b**2))


def _outliers() -> HardCase:
    """Noise of 3 mm, and 10 % of the pixels with errors of up to 200 mm."""
    image = _can(noise_mm=3.0, outliers=0.1)
    points = _points(image, POSE)
    x, y, _ = naive_circle(points[points[:, 2] > 20.0, :2])
    fit = fit_cylinder(image, POSE)
    off = [math.hypot(x, y), math.hypot(fit.x_mm, fit.y_mm)]
    naive, ours = (f"centre off by {error:.1f} mm" for error in off)
    return HardCase(_CYLINDER, "10 % outliers", "centre within 3 mm", naive, ours, off[1] < 3, off[0] < 3)


def _short_arc() -> HardCase:
    """A side of 90 degrees with 3 mm of noise: linear least squares gives too small a circle."""
    rng = np.random.default_rng([32])
    angle = rng.uniform(-0.75 * math.pi, -0.25 * math.pi, 400)
    plan = _RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1) + rng.normal(0, 3, (400, 2))
    circle = fit_circle(plan, 3.0, np.array([0.0, 1.0]), 150.0)
    off = [naive_circle(plan)[2] - _RADIUS, (math.nan if circle is None else circle.radius) - _RADIUS]
    naive, ours = (f"radius off by {error:+.1f} mm" for error in off)
    case, required = "an arc of 90 degrees, 3 mm of noise", "radius within 2.5 mm"
    return HardCase(_CYLINDER, case, required, naive, ours, abs(off[1]) < 2.5, abs(off[0]) < 2.5)


def _straight_line() -> HardCase:
    """Points on the face of a box, where no circle of its size exists."""
    plan = np.stack([np.linspace(-40, 40, 81), np.zeros(81)], axis=1)
    radius = naive_circle(plan)[2]
    circle = fit_circle(plan, 1.0, np.array([0.0, 1.0]), 150.0)
    ours = "none" if circle is None else f"radius {circle.radius:g} mm"
    required = "no circle"
    return HardCase(
        _CYLINDER, "points in a line", required, f"radius {radius:.3g} mm", ours, circle is None, not radius < 150
    )


def _unknown_depth() -> HardCase:
    """Unknown depth written as 0, as sensors do, for one pixel in ten: the position of the camera."""
    image = _can()
    assert image.depth_m is not None
    image.depth_m[np.random.default_rng([33]).random(image.depth_m.shape) < 0.1] = 0.0
    naive, ours = float(_points(image, POSE)[:, 2].max()), fit_cylinder(image, POSE).height_mm
    right = [abs(height - _HEIGHT) < 2 for height in (naive, ours)]
    naive_text, text = (f"{height:.0f} mm high" for height in (naive, ours))
    required = f"{_HEIGHT:.0f} mm high"
    return HardCase(_CYLINDER, "unknown depth written as 0", required, naive_text, text, right[1], right[0])


def _nothing_but_nan() -> HardCase:
    image = _picture(np.full(views.KINECT_PX, np.nan))
    naive = float(np.median(image.depth_m if image.depth_m is not None else math.nan))
    ours, holds = error_of(lambda: fit_cylinder(image, POSE))
    return HardCase(_CYLINDER, "no depth at all", "refused", f"median depth {naive}", ours, holds, math.isfinite(naive))


def _crowded_table() -> HardCase:
    """A plate 30 mm high covers two fifths of the picture, on one side of a level table."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 900.0
    depth = 900.0 + np.random.default_rng([34]).normal(0, 1, views.KINECT_PX)
    depth[:, : 2 * depth.shape[1] // 5] -= 30.0
    image = _picture(depth)
    points = _points(image, pose)
    naive = np.linalg.lstsq(np.c_[points[:, :2], np.ones(len(points))], points[:, 2], rcond=None)[0]
    table = find_table(depth.astype(np.float32), Rays.from_image(image, pose))
    slopes = [math.degrees(math.hypot(*plane)) for plane in (naive[:2], (table.a, table.b))]
    naive_text, text = (f"{slope:.2f} degrees steep" for slope in slopes)
    case, required = "a plate over 2/5 of the table", "level to 0.1 degrees"
    return HardCase("table fit", case, required, naive_text, text, slopes[1] < 0.1, slopes[0] < 0.1)


def _depth_as_millimetres() -> HardCase:
    """NaN, infinity, behind the camera, 70 m, and half a metre: only the last is a valid 16-bit depth."""
    depth = np.array([[np.nan, np.inf, -1.0, 70.0, 0.5]], np.float32)
    with np.errstate(invalid="ignore"):
        naive = (depth * 1000).astype(np.int64).astype(np.uint16)[0].tolist()
    ours, expected = depth_in_mm(depth)[0].tolist(), [0, 0, 0, 0, 500]
    case = "NaN, infinity, -1 m, 70 m, 0.5 m as uint16"
    return HardCase(_DEPTH, case, str(expected), str(naive), str(ours), ours == expected, naive == expected)


def _gel_of_another_shade() -> HardCase:
    """A gel without contact, one grey level darker as lamps warm up."""
    before, after = np.full((24, 32, 3), 101, np.uint8), np.full((24, 32, 3), 100, np.uint8)
    gate = ContactAreaGate()
    naive = float(((after - before) > gate.noise_levels).any(axis=2).mean())
    ours = gate.changed_fraction(GraspFrames(before, after))
    naive_text, text = (f"{100 * fraction:.0f} % of the gel" for fraction in (naive, ours))
    return HardCase("contact gate", "one grey level darker", "0 % of the gel", naive_text, text, ours == 0, naive == 0)
