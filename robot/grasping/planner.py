"""Grasp planners: where a rig closes its jaws on what stands before its camera.

A new planner is a subclass of GraspPlanner. A rig's file chooses one by name, or by `module:Class`; the other keys of
the table are the planner's keywords:

    [planner]
    name = "cylinder"
    search_margin_mm = 100

In Python a rig is given one: `Rig(..., planner=MyPlanner())`.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from _touch_retrieval.registry import Registry
from robot.errors import PlanError, RobotConfigError, UnknownName
from robot.grasping.settings import GraspSettings
from robot.readings import RGBD, Pose, Region
from robot.settings import build_named, check_range
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
"""Grasp planners by name, imported when used. The keywords of a planner are the keys of its table."""


@dataclass(frozen=True)
class GraspPlan:
    """Where to close, where to lift to, how far to open before, and how hard to close.

    approach: poses to pass on the way there, the last one clear of the object; `above` where none are given. fit: what
    the attempt's log says of the object as it was seen.

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

    needs_depth: whether the picture must have depth. Where it need not, none is taken for the plan's sake.

    >>> class OnTheMark(robot.GraspPlanner):
    ...     needs_depth = False
    ...
    ...     def plan(self, rig, image, settings, rng):
    ...         yaw_rad = rng.uniform(0.0, 3.14)
    ...         pose, above = (robot.Pose(0.0, 0.0, z_mm, yaw_rad) for z_mm in (60.0, 240.0))
    ...         return robot.GraspPlan(pose, above, opening_mm=rig.gripper.stroke_mm, force_n=10.0)
    """

    needs_depth: ClassVar[bool] = True

    def check(self, rig: "Rig") -> None:
        """Raise RobotConfigError where this planner cannot plan for `rig`."""
        if self.needs_depth and rig.object_fit is None and not rig.camera.has_depth:
            raise RobotConfigError(
                f"{rig.camera.name} has no depth: say where every object stands and how large it is, in [object]"
            )

    @abstractmethod
    def plan(self, rig: "Rig", image: RGBD, settings: GraspSettings, rng: np.random.Generator) -> GraspPlan:
        """Draw one grasp of the object in `image`, taken by the rig's camera.

        Raises:
            UngraspableError: where no other attempt at this object can do better.
            PlanError: where this one cannot be made.
        """


class CylinderPlanner(GraspPlanner):
    """As in the paper: fit a cylinder to the depth picture, or take the one that the rig was given, and pinch it from
    above about its axis (`plan_grasp`).

    search_margin_mm: an object may stand so far outside the workspace and still be found.
    """

    def __init__(self, *, search_margin_mm: float = 150.0) -> None:
        check_range("search_margin_mm", search_margin_mm, 0, 1e6, "mm")
        self.search_margin_mm = search_margin_mm

    def plan(self, rig: "Rig", image: RGBD, settings: GraspSettings, rng: np.random.Generator) -> GraspPlan:
        workspace = rig.arm.workspace
        lower, upper = workspace.lower, workspace.upper
        beyond = self.search_margin_mm
        sight = Region((lower[0] - beyond, lower[1] - beyond, -1.0), (upper[0] + beyond, upper[1] + beyond, upper[2]))
        fit = rig.object_fit or fit_cylinder(image, rig.camera.extrinsics, sight)
        plan = plan_grasp(fit, settings, workspace, rig.gripper.stroke_mm, rng)
        return replace(plan, fit=fit.to_dict())


def load_planner(table: Mapping[str, Any], default: str = "cylinder") -> GraspPlanner:
    """Return the planner that the table [planner] of a rig's file names.

    Args:
        table: `name`, and the planner's settings.
        default: The name, where the table has none.

    Raises:
        UnknownName: No planner has this name; lists the known ones.
        RobotConfigError: A setting is unknown, missing, or of another type.
    """
    return build_named(PLANNERS, table, "name", where="[planner]", default=default)


def plan_grasp(
    fit: CylinderFit, settings: GraspSettings, workspace: Region, stroke_mm: float, rng: np.random.Generator
) -> GraspPlan:
    """Draw one grasp: a random top-down pinch about the middle of the fitted cylinder.

    The point between the fingertips lies at the cylinder's axis but for a jitter, at a random height within the object.
    The jaws close in a direction that is uniform over the half turn that tells closing directions apart, with a
    uniformly drawn force. All numbers are drawn before any is checked: what one plan draws never depends on how another
    one fared. Raises PlanError, with the reason, for a grasp that this rig cannot do.
    """
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
