"""Grasp planners: where a rig closes its jaws on what stands before its camera.

A new planner is a subclass of GraspPlanner, given to the rig: `Rig(..., planner=MyPlanner())`, or `rig.planner = ...`.
"""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from robot.grasping.plan import GraspPlan, plan_grasp
from robot.grasping.settings import GraspSettings
from robot.readings import RGBD, Region
from robot.sight.cylinder import fit_cylinder

if TYPE_CHECKING:
    from robot.rig import Rig

_SIGHT_MM = 150.0
"""An object may stand so far outside the workspace and still be looked for."""


class GraspPlanner(ABC):
    """Plans one grasp from one picture.

    needs_depth: whether the picture must have depth. Where it need not, none is taken for the plan's sake.
    """

    needs_depth: ClassVar[bool] = True

    @abstractmethod
    def plan(self, rig: "Rig", image: RGBD, settings: GraspSettings, rng: np.random.Generator) -> GraspPlan:
        """Draw one grasp of the object in `image`, taken by the rig's camera.

        Raises:
            UngraspableError: where no other attempt at this object can do better.
            PlanError: where this one cannot be made.
        """


class CylinderPlanner(GraspPlanner):
    """As in the paper: fit a cylinder to the depth picture, or take the one that the rig was given, and pinch it from
    above about its axis (`robot.grasping.plan`)."""

    def plan(self, rig: "Rig", image: RGBD, settings: GraspSettings, rng: np.random.Generator) -> GraspPlan:
        workspace = rig.arm.workspace
        lower, upper = workspace.lower, workspace.upper
        sight = Region(
            (lower[0] - _SIGHT_MM, lower[1] - _SIGHT_MM, -1.0), (upper[0] + _SIGHT_MM, upper[1] + _SIGHT_MM, upper[2])
        )
        fit = rig.given or fit_cylinder(image, rig.camera.extrinsics, sight)
        plan = plan_grasp(fit, settings, workspace, rig.gripper.stroke_mm, rng)
        return replace(plan, fit=fit.to_dict())
