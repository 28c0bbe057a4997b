"""Plan one grasp: a random top-down pinch about the middle of the fitted cylinder, or the reason why there is none.

As in the paper: the point between the fingertips lies at the cylinder's axis but for a jitter, at a random height
within the object, the jaws close in a direction that is truly uniform over the half turn that tells closing directions
apart, and with a uniformly drawn force. All numbers are drawn before any is checked: what one plan draws never depends
on how another one fared.
"""

import math
from dataclasses import dataclass

import numpy as np

from robot.devices import Arm, Gripper
from robot.errors import PlanError, RobotConfigError
from robot.readings import Box, Pose
from robot.settings import TypedSettings, limited
from robot.sight.cylinder import CylinderFit


@dataclass(frozen=True)
class GraspSettings(TypedSettings):
    """How grasps are drawn. Lengths in mm, forces in N.

    force_n: range of the clamping force. jitter_mm: the pose strays so far from the axis in x and in y.
    floor_mm: lowest point between the fingertips, above the table. top_margin_mm, reach_mm: that point lies at least
    and at most so far below the object's top. finger_mm: width of a finger. clearance_mm: room on either side of the
    object when the jaws are open. lift_mm: how high an object is lifted, and how far above its grasp a plan begins.
    """

    force_n: tuple[float, float] = (5.0, 25.0)
    jitter_mm: float = limited(0, 1e6, 1.0)
    floor_mm: float = limited(0, 1e6, 10.0)
    top_margin_mm: float = limited(0, 1e6, 15.0)
    reach_mm: float = limited(1, 1e6, 110.0)
    finger_mm: float = limited(1, 1e6, 25.0)
    clearance_mm: float = limited(0, 1e6, 5.0)
    lift_mm: float = limited(1, 1e6, 180.0)

    def __post_init__(self) -> None:
        """Raises RobotConfigError for a setting of the wrong type or out of range."""
        super().__post_init__()
        if not 0 < self.force_n[0] <= self.force_n[1]:
            raise RobotConfigError(f"force_n must be a range of forces above 0, lower first, got {self.force_n}")

    def check(self, arm: Arm, gripper: Gripper) -> None:
        """Raise RobotConfigError where this rig cannot do what is asked."""
        low, high = self.force_n
        if low < gripper.min_force_n or high > gripper.max_force_n:
            raise RobotConfigError(
                f"force_n must be within {gripper.min_force_n:g} to {gripper.max_force_n:g} N, the range of "
                f"{gripper.name}; got {low:g} to {high:g}"
            )
        if self.floor_mm > arm.workspace.upper[2]:
            raise RobotConfigError(f"floor_mm must lie below the workspace's top {arm.workspace.upper[2]:g} mm")


@dataclass(frozen=True)
class GraspPlan:
    """Where to close, from where to come, how far to open before, and how hard to close."""

    pose: Pose
    above: Pose
    opening_mm: float
    force_n: float


def plan_grasp(
    fit: CylinderFit, settings: GraspSettings, workspace: Box, stroke_mm: float, rng: np.random.Generator
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


def _above(pose: Pose, fit: CylinderFit, settings: GraspSettings, workspace: Box) -> Pose:
    """Where the descent begins: inside the workspace, and the fingers clear of the object."""
    above = Pose(pose.x_mm, pose.y_mm, min(pose.z_mm + settings.lift_mm, workspace.upper[2]), pose.yaw_rad)
    if not (workspace.contains(pose) and workspace.contains(above)):
        raise PlanError(f"the grasp is out of the workspace {workspace.lower} to {workspace.upper}: {pose}")
    if above.z_mm < fit.height_mm + settings.floor_mm:
        raise PlanError(f"the object is too high: {fit.height_mm:.0f} mm, and the arm rises to {above.z_mm:.0f} mm")
    return above
