"""Plan one grasp: a random top-down pinch about the middle of the fitted cylinder, or the reason why there is none.

As in the paper: the point between the fingertips lies at the cylinder's axis but for a jitter, at a random height
within the object, the jaws close in a direction that is truly uniform over the half turn that tells closing directions
apart, and with a uniformly drawn force. All numbers are drawn before any is checked: what one plan draws never depends
on how another one fared.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robot.errors import PlanError
from robot.grasping.settings import GraspSettings
from robot.readings import Pose, Region
from robot.sight.cylinder import CylinderFit


@dataclass(frozen=True)
class GraspPlan:
    """Where to close, where to lift to, how far to open before, and how hard to close.

    approach: poses to pass on the way there, the last one clear of the object; `above` where none are given. fit: what
    the attempt's log says of the object as it was seen.
    """

    pose: Pose
    above: Pose
    opening_mm: float
    force_n: float
    approach: tuple[Pose, ...] = ()
    fit: Mapping[str, Any] = field(default_factory=dict)


def plan_grasp(
    fit: CylinderFit, settings: GraspSettings, workspace: Region, stroke_mm: float, rng: np.random.Generator
) -> GraspPlan:
    """Draw one grasp. Raises PlanError, with the reason, for one that this rig cannot do."""
    dx, dy = rng.uniform(-settings.jitter_mm, settings.jitter_mm, 2)
    share, yaw = float(rng.uniform()), float(rng.uniform(0.0, math.pi))
    force = round(float(rng.uniform(*settings.force_n)), 3)
    floor = max(settings.floor_mm, workspace.lower[2])
    if fit.height_mm < floor:
        raise PlanError(
            f"the object is {fit.height_mm:.0f} mm high, and the fingers reach no lower than {floor:.0f} mm"
        )
    low = max(floor, fit.height_mm - settings.reach_mm)
    high = max(low, fit.height_mm - settings.top_margin_mm)
    # To a micrometre and a microradian: the last bits of a fit may depend on how many threads computed it.
    x, y, z = fit.x_mm + float(dx), fit.y_mm + float(dy), low + share * (high - low)
    pose = Pose(round(x, 3), round(y, 3), round(z, 3), math.floor(yaw * 1e6) / 1e6)
    width = fit.width_mm(yaw, settings.finger_mm) + 2 * settings.clearance_mm
    if width > stroke_mm:
        raise PlanError(
            f"the object is wider than the stroke: jaws closing at {math.degrees(yaw):.0f} degrees must open "
            f"{width:.0f} mm, and they open {stroke_mm:.0f} mm"
        )
    return GraspPlan(pose, _above(pose, fit, settings, workspace), stroke_mm, force)


def _above(pose: Pose, fit: CylinderFit, settings: GraspSettings, workspace: Region) -> Pose:
    """Where the descent begins: inside the workspace, and the fingers clear of the object."""
    above = Pose(pose.x_mm, pose.y_mm, min(pose.z_mm + settings.lift_mm, workspace.upper[2]), pose.yaw_rad)
    if not (workspace.contains(pose) and workspace.contains(above)):
        raise PlanError(f"the grasp is out of the workspace {workspace.lower} to {workspace.upper}: {pose}")
    if above.z_mm < fit.height_mm + settings.floor_mm:
        raise PlanError(f"the object is too high: {fit.height_mm:.0f} mm, and the arm rises to {above.z_mm:.0f} mm")
    return above
