"""Grasp planners: where a rig closes its jaws on what stands before its camera.

A new planner is a subclass of GraspPlanner. A rig's file chooses one by name, or by `module:Class`; the other keys of
the table are the planner's keywords:

    [planner]
    name = "cylinder"
    sight_mm = 100

In Python a rig is given one: `Rig(..., planner=MyPlanner())`.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from _touch_retrieval.registry import Registry
from robot.errors import RobotConfigError, UnknownName
from robot.grasping.plan import GraspPlan, plan_grasp
from robot.grasping.settings import GraspSettings
from robot.readings import RGBD, Region
from robot.settings import build_named, check_range
from robot.sight.cylinder import fit_cylinder

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


class GraspPlanner(ABC):
    """Plans one grasp from one picture.

    needs_depth: whether the picture must have depth. Where it need not, none is taken for the plan's sake.

    >>> class OnTheMark(robot.GraspPlanner):
    ...     needs_depth = False
    ...
    ...     def plan(self, rig, image, settings, rng):
    ...         pose = robot.Pose(0.0, 0.0, 60.0, rng.uniform(0.0, 3.14))
    ...         above = robot.Pose(0.0, 0.0, 240.0, pose.yaw_rad)
    ...         return robot.GraspPlan(pose, above, opening_mm=rig.gripper.stroke_mm, force_n=10.0)
    """

    needs_depth: ClassVar[bool] = True

    def check(self, rig: "Rig") -> None:
        """Raise RobotConfigError where this planner cannot plan for `rig`."""
        if self.needs_depth and rig.given is None and not rig.camera.has_depth:
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
    above about its axis (`robot.grasping.plan`).

    sight_mm: an object may stand so far outside the workspace and still be found.
    """

    def __init__(self, *, sight_mm: float = 150.0) -> None:
        check_range("sight_mm", sight_mm, 0, 1e6, "mm")
        self.sight_mm = sight_mm

    def plan(self, rig: "Rig", image: RGBD, settings: GraspSettings, rng: np.random.Generator) -> GraspPlan:
        workspace = rig.arm.workspace
        lower, upper = workspace.lower, workspace.upper
        beyond = self.sight_mm
        sight = Region((lower[0] - beyond, lower[1] - beyond, -1.0), (upper[0] + beyond, upper[1] + beyond, upper[2]))
        fit = rig.given or fit_cylinder(image, rig.camera.extrinsics, sight)
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
