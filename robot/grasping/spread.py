"""A planner that spreads the grasps of an object over its height."""

from collections.abc import Sequence

import numpy as np

from _touch_retrieval.documents import Count, typed
from robot.errors import PlanError, RobotConfigError, UngraspableError
from robot.grasping.planner import GraspPlan, GraspPlanner
from robot.grasping.settings import GraspSettings
from robot.readings import RGBD
from robot.rig import Rig


class SpreadPlanner(GraspPlanner):
    """Draws several grasps from another planner; plans the one whose height differs most from those of earlier grasps.

    No gain over random grasps was shown for recognition (docs/answers.md).

    Args:
        planner: Draws the grasps.
        heights_mm: Heights of the earlier grasps of the object. The caller adds each new one.
        draws: Grasps to choose from.

    >>> heights_mm = []
    >>> with robot.load_rig("sim", seed=0) as rig:
    ...     rig.planner = robot.SpreadPlanner(rig.planner, heights_mm)
    """

    def __init__(self, planner: GraspPlanner, heights_mm: Sequence[float], *, draws: int = 8) -> None:
        typed(draws, Count, "draws", error=RobotConfigError)
        self.planner, self.heights_mm, self.draws = planner, heights_mm, draws
        self.needs_depth = planner.needs_depth

    def check(self, rig: Rig) -> None:
        """Raise RobotConfigError if the other planner cannot plan for `rig`."""
        self.planner.check(rig)

    def plan(self, rig: Rig, image: RGBD, settings: GraspSettings, rng: np.random.Generator) -> GraspPlan:
        """Plan the grasp that is farthest from the earlier ones; the first grasp is the first draw.

        Raises:
            UngraspableError: No attempt at this object can succeed.
            PlanError: All drawn grasps are impossible; the message is that of the last one.
        """
        plans: list[GraspPlan] = []
        for _ in range(self.draws if self.heights_mm else 1):
            try:
                plans.append(self.planner.plan(rig, image, settings, rng))
            except UngraspableError:
                raise
            except PlanError as error:
                failed = error
        if not plans:
            raise failed
        return max(plans, key=self._distance_mm)

    def _distance_mm(self, plan: GraspPlan) -> float:
        """Return the difference to the nearest earlier height."""
        return min((abs(plan.pose.z_mm - height) for height in self.heights_mm), default=0.0)
