"""Grasp plans: drawn as in the paper within the limits of object and rig, or refused with the reason."""

import contextlib
import dataclasses
import math

import numpy as np
import pytest

from robot.errors import PlanError, RobotConfigError
from robot.grasping.planner import plan_grasp
from robot.grasping.settings import GraspSettings
from robot.readings import Region
from robot.sight.cylinder import CylinderFit
from tests.fake_rig import WORKSPACE, FakeGripper, FakeRigState

FIT = CylinderFit(12.0, -7.0, 100.0, 30.0, 0.5, "circle", (30.0, 30.0))
STROKE = 110.0


def plan(seed=0, fit=FIT, settings=None, workspace=WORKSPACE, stroke=STROKE):
    return plan_grasp(fit, settings or GraspSettings(), workspace, stroke, np.random.default_rng(seed))


def plans(count=2000, **changes):
    return [plan(seed, **changes) for seed in range(count)]


def farthest_from_uniform(values, low, high):
    """Return Kolmogorov's distance between these values and a uniform distribution, by a plain loop."""
    ordered = sorted((value - low) / (high - low) for value in values)
    count = len(ordered)
    return max(max(abs(value - k / count), abs(value - (k + 1) / count)) for k, value in enumerate(ordered))


KOLMOGOROV = 1.95
"""For n uniform values, n^(1/2) times the distance is below this in 999 of 1000 cases; the seeds are fixed."""


def test_yaw_force_and_height_are_uniform_and_independent():
    drawn = plans()
    bound = KOLMOGOROV / math.sqrt(len(drawn))
    assert farthest_from_uniform([p.pose.yaw_rad for p in drawn], 0, math.pi) < bound
    assert farthest_from_uniform([p.force_n for p in drawn], 5, 25) < bound
    assert farthest_from_uniform([p.pose.z_mm for p in drawn], 10, 85) < bound  # floor, and 15 mm below the top
    assert farthest_from_uniform([p.pose.x_mm for p in drawn], 11, 13) < bound
    assert farthest_from_uniform([p.pose.y_mm for p in drawn], -8, -6) < bound
    table = np.array([[*p.pose.as_tuple(), p.force_n] for p in drawn])
    assert table[:, 3].min() >= 0
    assert table[:, 3].max() < math.pi
    correlation = np.corrcoef(table.T) - np.eye(5)
    assert np.abs(correlation).max() < 4 / math.sqrt(len(drawn))  # 4 standard errors


def test_a_plan_comes_from_straight_above_with_open_jaws():
    for each in plans(20):
        assert each.above == dataclasses.replace(each.pose, z_mm=each.pose.z_mm + 180)
        assert each.opening_mm == STROKE


def test_fingers_reach_at_most_reach_mm_below_the_top():
    tall = dataclasses.replace(FIT, height_mm=250.0)
    assert min(p.pose.z_mm for p in plans(200, fit=tall)) >= 250 - 110


@pytest.mark.parametrize("height", [10.0, 20.0, 25.0])
def test_a_low_object_is_grasped_at_the_floor_also_that_of_the_workspace(height):
    """The authors' interval is inverted below 25 mm: its lower end lies above its upper end."""
    low = dataclasses.replace(FIT, height_mm=height)
    assert {p.pose.z_mm for p in plans(20, fit=low)} == {10.0}
    workspace = Region((-150.0, -150.0, 30.0), (150.0, 150.0, 500.0))
    assert min(p.pose.z_mm for p in plans(50, workspace=workspace)) >= 30


REFUSED = {
    "lower than the fingers reach": ({"height_mm": 9.9}, {}, "the lowest height of the fingers is 10 mm"),
    "wider than the stroke": ({"radius_mm": 50.1}, {}, "wider than the stroke: .* must open 110 mm"),
    "a smaller stroke": ({}, {"stroke": 60.0}, "wider than the stroke"),
    "outside the workspace": ({"x_mm": 152.0}, {}, "out of the workspace"),
    "too high for the arm": ({"height_mm": 495.0}, {}, "too high: it is 495 mm high"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_an_impossible_grasp_is_refused_with_the_reason(case):
    fit, options, reason = REFUSED[case]
    with pytest.raises(PlanError, match=reason):
        plan(fit=dataclasses.replace(FIT, **fit), **options)


def test_a_long_box_is_refused_along_its_length_and_grasped_across():
    box = dataclasses.replace(FIT, method="box", half_mm=(80.0, 15.0), radius_mm=15.0)
    yaws = []
    for seed in range(300):
        with contextlib.suppress(PlanError):
            yaws.append(plan(seed, fit=box).pose.yaw_rad)
    assert 0.5 < len(yaws) / 300 < 0.9
    assert all(abs(yaw - math.pi / 2) < 1.3 for yaw in yaws)  # across it is pi / 2


def test_a_refused_plan_draws_as_many_numbers_as_any_other():
    rng, other = np.random.default_rng(0), np.random.default_rng(0)
    with pytest.raises(PlanError):
        plan_grasp(FIT, GraspSettings(), WORKSPACE, 10.0, rng)
    plan_grasp(FIT, GraspSettings(), WORKSPACE, STROKE, other)
    assert rng.uniform() == other.uniform()


WRONG = {
    "force_n": [(0.0, 5.0), (10.0, 5.0), (5.0, math.inf), (math.nan, 5.0)],
    "jitter_mm": [-1.0, math.nan, math.inf],
    "floor_mm": [-1.0],
    "reach_mm": [0.0],
    "lift_mm": [0.0],
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in WRONG.items() for value in values])
def test_a_setting_out_of_range_is_refused(name, value):
    with pytest.raises(RobotConfigError, match=name):
        GraspSettings(**{name: value})


def test_forces_outside_the_grippers_range_are_refused_before_any_motion():
    gripper = FakeGripper(FakeRigState(0))
    GraspSettings().check(gripper)
    for force in ((4.0, 25.0), (5.0, 81.0)):
        with pytest.raises(RobotConfigError, match="force_n must be within 5 to 80 N, the range of fake gripper"):
            GraspSettings(force_n=force).check(gripper)
