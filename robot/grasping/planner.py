"""Grasp planners: choose the grasp of the object in the camera's picture.

A planner is a subclass of GraspPlanner. A rig's file names it, or gives `module:Class`; the other keys of the table
are the keyword arguments of the planner:

    [planner]
    name = "cylinder"
    search_margin_mm = 100

In Python: `Rig(..., planner=MyPlanner())`.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from _touch_retrieval.documents import NonNegative
from _touch_retrieval.registry import Registry
from robot.errors import PlanError, RobotConfigError, UnknownName
from robot.grasping.settings import GraspSettings
from robot.readings import RGBD, Pose, Region
from robot.settings import build_named
from robot.sight.cylinder import CylinderFit, fit_cylinder

if TYPE_CHECKING:
    from robot.rig import Rig

PLANNERS: "Registry[type[GraspPlanner]]" = Registry(
    "[planner]: name",
    "planners",
    {"cylinder": "robot.grasping.planner:CylinderPlanner", "mesh": "robot.sim.mesh_planner:MeshPlanner"},
    error=UnknownName,
    base="robot.grasping.planner:GraspPlanner",
)
"""Grasp planners by name, imported on first use. The keys of a planner's table are the keyword arguments of its
constructor."""


@dataclass(frozen=True)
class GraspPlan:
    """One planned grasp.

    Attributes:
        pose: Pose in which the jaws close.
        above: Pose after the lift.
        opening_mm: Opening before the grasp.
        force_n: Force on each finger.
        approach: Poses on the way to `pose`; at the last one, the hand is clear of the object. If empty: `above`.
        fit: Description of the object, for the attempt log.

    >>> pose, above = robot.Pose(0.0, 0.0, 60.0, yaw_rad=1.0), robot.Pose(0.0, 0.0, 240.0, yaw_rad=1.0)
    >>> robot.GraspPlan(pose, above, opening_mm=110.0, force_n=10.0).approach
    ()
    """

    pose: Pose
    above: Pose
    opening_mm: float
    force_n: float
    approach: tuple[Pose, ...] = ()
    fit: Mapping[str, Any] = field(default_factory=dict)


class GraspPlanner(ABC):
    """Plans one grasp from one picture.

    Attributes:
        needs_depth: Whether the picture must have depth; if not, depth is read only to be recorded.

    >>> class OnTheMark(robot.GraspPlanner):
    ...     needs_depth = False
    ...
    ...     def plan(self, rig, image, settings, rng):
    ...         yaw_rad = rng.uniform(0.0, 3.14)
    ...         pose, above = (robot.Pose(0.0, 0.0, z_mm, yaw_rad) for z_mm in (60.0, 240.0))
    ...         return robot.GraspPlan(pose, above, opening_mm=rig.gripper.stroke_mm, force_n=10.0)
    """

    needs_depth: bool = True

    def check(self, rig: "Rig") -> None:
        """Raise RobotConfigError if this planner cannot plan for `rig`."""
        if self.needs_depth and rig.object_fit is None and not rig.camera.has_depth:
            raise RobotConfigError(
                f"{rig.camera.name} has no depth: give the position and size of every object in [object]"
            )

    @abstractmethod
    def plan(self, rig: "Rig", image: RGBD, settings: GraspSettings, rng: np.random.Generator) -> GraspPlan:
        """Draw one grasp of the object in `image`, taken by the rig's camera.

        Args:
            rig: The rig, connected.
            image: The picture; with depth if `needs_depth`.
            settings: Settings of the random grasps.
            rng: Source of all random choices.

        Raises:
            UngraspableError: No attempt at this object can succeed.
            PlanError: This attempt is impossible.
        """


class CylinderPlanner(GraspPlanner):
    """The planner of the paper: fit a cylinder to the depth picture and pinch it from above (`plan_grasp`).

    If the rig has an `object_fit`, it replaces the fit.

    Args:
        search_margin_mm: Width of the border around the workspace that is searched for objects too.
    """

    def __init__(self, *, search_margin_mm: NonNegative = 150.0) -> None:
        self.search_margin_mm = search_margin_mm

    def plan(self, rig: "Rig", image: RGBD, settings: GraspSettings, rng: np.random.Generator) -> GraspPlan:
        """Fit the cylinder and draw one grasp of it; raise PlanError if this is impossible."""
        workspace = rig.arm.workspace
        lower, upper = workspace.lower, workspace.upper
        margin = self.search_margin_mm
        region = Region((lower[0] - margin, lower[1] - margin, -1.0), (upper[0] + margin, upper[1] + margin, upper[2]))
        fit = rig.object_fit or fit_cylinder(image, rig.camera.extrinsics, region)
        plan = plan_grasp(fit, settings, workspace, rig.gripper.stroke_mm, rng)
        return replace(plan, fit=fit.to_dict())


def load_planner(table: Mapping[str, Any], default: str = "cylinder") -> GraspPlanner:
    """Return the planner that the table [planner] of a rig's file names.

    Args:
        table: `name`, and the planner's settings.
        default: Planner to use if the table has no name.

    Raises:
        UnknownName: No planner has this name; the message lists the known ones.
        RobotConfigError: A setting is unknown, missing, or of another type.
    """
    return build_named(PLANNERS, table, "name", where="[planner]", default=default)


def plan_grasp(
    fit: CylinderFit, settings: GraspSettings, workspace: Region, stroke_mm: float, rng: np.random.Generator
) -> GraspPlan:
    """Draw one grasp: a random top-down pinch of the fitted cylinder.

    The point between the fingertips lies on the cylinder's axis plus a jitter, at a random height within the object.
    The closing direction is uniform over half a turn, and the force is uniform over its range. All numbers are drawn
    before the first check. So a plan that fails uses as many random numbers as one that succeeds, and later plans from
    the same `rng` do not change.

    Args:
        fit: The cylinder.
        settings: Settings of the random grasps.
        workspace: Limits of the point between the fingertips.
        stroke_mm: Largest opening of the jaws.
        rng: Source of the random choices.

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
    return GraspPlan(pose, _above(pose, fit, settings, workspace), stroke_mm, force)


def _above(pose: Pose, fit: CylinderFit, settings: GraspSettings, workspace: Region) -> Pose:
    """Return the start of the descent, inside the workspace and clear of the object; raise PlanError otherwise."""
    above = Pose(pose.x_mm, pose.y_mm, min(pose.z_mm + settings.lift_mm, workspace.upper[2]), pose.yaw_rad)
    if not (workspace.contains(pose) and workspace.contains(above)):
        raise PlanError(f"the grasp is out of the workspace {workspace.lower} to {workspace.upper}: {pose}")
    if above.z_mm < fit.height_mm + settings.floor_mm:
        raise PlanError(
            f"the object is too high: it is {fit.height_mm:.0f} mm high, and the fingertips rise to "
            f"{above.z_mm:.0f} mm, but they must rise to {settings.floor_mm:g} mm above it"
        )
    return above
