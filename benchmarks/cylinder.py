"""Cylinders fitted to one-sided depth images: error of the centre and time, compared with a naive recipe."""

import math
import time
from collections import Counter
from collections.abc import Iterator

import cv2
import numpy as np

from benchmarks.common import ResultLine
from robot.errors import PlanError
from robot.sight.cylinder import fit_cylinder
from tests import views
from tests.robot.sight.test_cylinder import naive_fit
from tests.views import DepthBall, DepthBlock, LyingCylinder, UprightCylinder

X, Y = 12.0, -7.0
_CLEAN, _OUTLIERS, _NOISY = {"noise_mm": 1.5}, {"outliers": 0.1}, {"noise_mm": 3.0, "outliers": 0.1}
CASES = {
    "R33 h120": (UprightCylinder(33, 120, X, Y), _CLEAN),
    "R33 h120, 3 mm noise, 10 % outliers": (UprightCylinder(33, 120, X, Y), _NOISY),
    "R50 h200": (UprightCylinder(50, 200, X, Y), _CLEAN),
    "R15 h100, 3 mm noise, 10 % outliers": (UprightCylinder(15, 100, X, Y), _NOISY),
    "R33 h20 (tuna can)": (UprightCylinder(33, 20, X, Y), _CLEAN),
    "R33 h20, 3 mm noise, 10 % outliers": (UprightCylinder(33, 20, X, Y), _NOISY),
    "packet 180 x 50 x 220, 10 % outliers": (DepthBlock(180, 50, 220, X, Y, 0.2), _OUTLIERS),
    "box 90 x 50 x 60, 10 % outliers": (DepthBlock(90, 50, 60, X, Y, 0.5), _OUTLIERS),
    "cylinder R25 on its side, 10 % outliers": (LyingCylinder(25, 120, X, Y, 0.7), _OUTLIERS),
    "ball R35": (DepthBall(35, X, Y), _CLEAN),
    "R25 h8 (lid)": (UprightCylinder(25, 8, X, Y), _CLEAN),
}


def measure(count: int = 20) -> Iterator[ResultLine]:
    """Yield a line for each case, over `count` views of 512 x 424 pixels from 0.9 m and 35 degrees above."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for name, (solid, noise) in CASES.items():
            yield _line(name, solid, noise, count)
        yield _glass(count)
    finally:
        cv2.setNumThreads(threads)


def _line(name: str, solid: views.UprightCylinder, noise: dict[str, float], count: int) -> ResultLine:
    pose, errors, naive, claimed, seconds, methods = views.camera_pose(), [], [], [], [], Counter()
    for seed in range(count):
        image = views.view(solid, seed=seed, **noise)
        start = time.perf_counter()
        fit = fit_cylinder(image, pose)
        seconds.append(time.perf_counter() - start)
        errors.append(math.hypot(fit.x_mm - X, fit.y_mm - Y))
        claimed.append(fit.error_mm)
        methods[fit.method] += 1
        naive_centre = naive_fit(image, pose)
        naive.append(math.hypot(naive_centre[0] - X, naive_centre[1] - Y))
    figures = {
        "centre_mm": float(np.mean(errors)),
        "worst_mm": float(np.max(errors)),
        "claimed_mm": float(np.mean(claimed)),
        "seconds": float(np.median(seconds)),
    }
    naive_text = "finds nothing"
    if np.isfinite(naive).all():
        figures["naive_mm"] = float(np.mean(naive))
        naive_text = f"{figures['naive_mm']:.1f} mm"
    method_counts = ", ".join(f"{method} {number}" for method, number in methods.most_common())
    text = (
        f"centre {figures['centre_mm']:.2f} mm off, at most {figures['worst_mm']:.2f}; estimated error "
        f"{figures['claimed_mm']:.2f}; naive {naive_text}; {1e3 * figures['seconds']:.1f} ms ({method_counts})"
    )
    return ResultLine("cylinder", name, text, figures)


def _glass(count: int) -> ResultLine:
    """Fit an object that only has an outline in the colour image."""
    errors = []
    for seed in range(count):
        try:
            fit = fit_cylinder(views.view(missing=[UprightCylinder(33, 120, X, Y)], seed=seed), views.camera_pose())
            errors.append(math.hypot(fit.x_mm - X, fit.y_mm - Y))
        except PlanError:
            errors.append(math.inf)
    mean, worst = float(np.mean(errors)), float(np.max(errors))
    text = f"centre {mean:.2f} mm off, at most {worst:.2f} (silhouette)"
    return ResultLine("cylinder", "R33 h120 of glass", text, {"centre_mm": mean, "worst_mm": worst})
