"""The planner that spreads grasps over the height of an object, with a planner of given heights."""

import numpy as np
import pytest

import robot
from robot.errors import PlanError, RobotConfigError, UngraspableError
from robot.grasping.planner import SpreadPlanner
from robot.sim.mesh_planner import MeshPlanner


class Listed(robot.GraspPlanner):
    """Plans grasps at given heights, one after the other; an exception in their place is raised."""

    needs_depth = False

    def __init__(self, *heights_mm):
        self.left = list(heights_mm)

    def plan(self, rig, image, settings, rng):
        height = self.left.pop(0)
        if isinstance(height, Exception):
            raise height
        pose = robot.Pose(0.0, 0.0, height, yaw_rad=0.0)
        return robot.GraspPlan(pose, pose, opening_mm=50.0, force_n=10.0)


def planned(earlier_mm, *drawn_mm):
    planner = SpreadPlanner(Listed(*drawn_mm), earlier_mm, draws=len(drawn_mm))
    return planner.plan(None, None, None, np.random.default_rng(0)).pose.z_mm


def test_a_further_grasp_is_the_draw_that_is_farthest_from_its_nearest_earlier_grasp():
    assert planned([], 40.0, 90.0) == 40.0  # the first grasp is the first draw
    assert planned([40.0], 50.0, 90.0, 30.0) == 90.0
    assert planned([40.0, 90.0], 50.0, 88.0, 62.0, 20.0) == 62.0  # 22 mm from 40; 20 mm is 20 mm away


def test_an_impossible_draw_is_left_out_and_the_last_reason_or_an_ungraspable_object_is_an_error():
    assert planned([40.0], PlanError("too wide"), 42.0) == 42.0
    with pytest.raises(PlanError, match="too high"):
        planned([40.0], PlanError("too wide"), PlanError("too high"))
    with pytest.raises(UngraspableError):
        planned([40.0], UngraspableError("larger than the jaws"), 42.0)


def test_a_rig_that_the_other_planner_cannot_use_is_refused():
    with robot.load_rig("sim", seed=0) as rig, pytest.raises(RobotConfigError, match="meshes"):
        SpreadPlanner(MeshPlanner(), []).check(rig)
