"""The grasp planner of the paper: a cylinder pinched from above."""

import math
from dataclasses import replace

import numpy as np

from _touch_retrieval.documents import NonNegative
from robot.errors import PlanError
from robot.grasping.settings import GraspSettings
from robot.readings import RGBD, Pose, Region
from robot.rig import GraspPlan, GraspPlanner, Rig
from robot.sight.cylinder import CylinderFit, fit_cylinder


class CylinderPlanner(GraspPlanner):
    """The planner of the paper: fit a cylinder to the depth picture and pinch it from above (`plan_grasp`).

    The rig's `object_fit` replaces the fit. A border of `search_margin_mm` around the workspace is searched too.
    """

    def __init__(self, *, search_margin_mm: NonNegative = 150.0) -> None:
        self.search_margin_mm = search_margin_mm

    def plan(self, rig: Rig, image: RGBD, settings: GraspSettings, rng: np.random.Generator) -> GraspPlan:
        """Fit the cylinder and draw one grasp of it."""
        workspace, margin = rig.arm.workspace, self.search_margin_mm
        (left, front, _), (right, back, top) = workspace.lower, workspace.upper
        region = Region((left - margin, front - margin, -1.0), (right + margin, back + margin, top))
        fit = rig.object_fit or fit_cylinder(image, rig.camera.extrinsics, region)
        return replace(plan_grasp(fit, settings, workspace, rig.gripper.stroke_mm, rng), fit=fit.to_dict())


def plan_grasp(
    fit: CylinderFit, settings: GraspSettings, workspace: Region, stroke_mm: float, rng: np.random.Generator
) -> GraspPlan:
    """Draw one grasp: a random top-down pinch of the fitted cylinder.

    The point between the fingertips lies on the cylinder's axis plus a jitter, at a random height within the object.
    The closing direction is uniform over half a turn, and the force is uniform over its range. All numbers are drawn
    before the first check, so later plans from the same `rng` do not depend on whether this one fails.

    Raises:
        PlanError: The rig cannot make this grasp; the message gives the reason.
    """
    dx, dy = rng.uniform(-settings.jitter_mm, settings.jitter_mm, 2)
    fraction, yaw = float(rng.uniform()), float(rng.uniform(0.0, math.pi))
    force = round(float(rng.uniform(*settings.force_n)), 3)
    floor = max(settings.floor_mm, workspace.lower[2])
    if fit.height_mm < floor:
        raise PlanError(
            f"the object is {fit.height_mm:.0f} mm high, but the lowest height of the fingers is {floor:.0f} mm"
        )
    low = max(floor, fit.height_mm - settings.reach_mm)
    high = max(low, fit.height_mm - settings.top_margin_mm)
    # Rounded to a micrometre and a microradian: the last bits of a fit may depend on the number of threads.
    x, y, z = fit.x_mm + float(dx), fit.y_mm + float(dy), low + fraction * (high - low)
    pose = Pose(round(x, 3), round(y, 3), round(z, 3), math.floor(yaw * 1e6) / 1e6)
    width = fit.width_mm(yaw, settings.finger_mm) + 2 * settings.clearance_mm
    if width > stroke_mm:
        raise PlanError(
            f"the object is wider than the stroke: at {math.degrees(yaw):.0f} degrees the jaws must open "
            f"{width:.0f} mm, but they open only {stroke_mm:.0f} mm"
        )
    above = replace(pose, z_mm=min(pose.z_mm + settings.lift_mm, workspace.upper[2]))
    if not (workspace.contains(pose) and workspace.contains(above)):
        raise PlanError(f"the grasp is out of the workspace {workspace.lower} to {workspace.upper}: {pose}")
    if above.z_mm < fit.height_mm + settings.floor_mm:
        raise PlanError(
            f"the object is too high: it is {fit.height_mm:.0f} mm high, and the fingertips rise to "
            f"{above.z_mm:.0f} mm, but they must rise to {settings.floor_mm:g} mm above it"
        )
    return GraspPlan(pose, above, stroke_mm, force)
