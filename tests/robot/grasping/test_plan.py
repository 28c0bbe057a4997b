"""Grasp plans: drawn as in the paper within the limits of object and rig, or refused with the reason."""

import contextlib
import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from robot.errors import PlanError, RobotConfigError
from robot.grasping.planner import plan_grasp
from robot.grasping.settings import GraspSettings
from robot.readings import Region
from robot.sight.cylinder import CylinderFit
from tests.fake_rig import WORKSPACE, FakeRig

FIT = CylinderFit(12.0, -7.0, 100.0, 30.0, "circle", (30.0, 30.0))
STROKE = 110.0


def plan(seed=0, fit=FIT, settings=None, workspace=WORKSPACE, stroke=STROKE):
    return plan_grasp(fit, settings or GraspSettings(), workspace, stroke, np.random.default_rng(seed))


def plans(count=2000, **changes):
    return [plan(seed, **changes) for seed in range(count)]


RANGES = ((11, 13), (-8, -6), (10, 85), (0, math.pi), (5, 25))
"""Of x, y, z (from the floor to 15 mm below the top), yaw and force."""


def test_position_yaw_and_force_are_uniform_and_independent():
    table = np.array([[*p.pose.as_tuple(), p.force_n] for p in plans()])
    for values, (low, high) in zip(table.T, RANGES, strict=True):
        assert low <= values.min() <= values.max() <= high
        assert stats.kstest(values, "uniform", (low, high - low)).pvalue > 0.001
    correlation = np.corrcoef(table.T) - np.eye(5)
    assert np.abs(correlation).max() < 4 / math.sqrt(len(table))  # 4 standard errors


def test_a_plan_comes_from_straight_above_with_open_jaws_and_fingers_reach_at_most_reach_mm_below_the_top():
    for each in plans(20):
        assert each.above == dataclasses.replace(each.pose, z_mm=each.pose.z_mm + 180)
        assert each.opening_mm == STROKE
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


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("force_n", (10.0, 5.0)),
        ("force_n", (5.0, math.inf)),
        ("jitter_mm", -1.0),
    ],
)
def test_a_setting_out_of_range_is_refused(name, value):
    with pytest.raises(RobotConfigError, match=name):
        GraspSettings(**{name: value})


def test_forces_and_a_floor_outside_the_rigs_limits_are_refused_before_any_motion():
    rig = FakeRig()
    GraspSettings().check(rig.arm, rig.gripper)
    for force in ((4.0, 25.0), (5.0, 81.0)):
        with pytest.raises(RobotConfigError, match="force_n must be within 5 to 80 N, the range of fake gripper"):
            GraspSettings(force_n=force).check(rig.arm, rig.gripper)
    with pytest.raises(RobotConfigError, match="floor_mm must lie below the workspace's top"):
        GraspSettings(floor_mm=rig.arm.workspace.upper[2] + 1).check(rig.arm, rig.gripper)
