"""A scene computes only what its outputs need; its results agree with answers known by hand."""

import math

import numpy as np
import pytest

from robot.errors import SceneError
from robot.readings import Pose
from robot.sim.camera import Placement
from robot.sim.gel.sensor import draw_sensor
from robot.sim.objects.draw import draw_object
from robot.sim.scene import Grip, Scene

SENSORS = {finger: draw_sensor(0, finger) for finger in "ab"}
BOTTLE = draw_object(0, 0, family="cylinder", relief="ribs")
MIDDLE_MM = min(60.0, 0.5 * BOTTLE.body.upper[2])
GRIP = Grip(Pose(0.0, 0.0, MIDDLE_MM, 0.3), force_n=12.0)
ALL = {
    "photo",
    "depth",
    *(f"touch_{finger}{moment}" for finger in "ab" for moment in ("", "_before", "_after")),
}


def scene(outputs, **changes):
    settings = {"obj": BOTTLE, "sensors": SENSORS, "grip": GRIP, "seed": 5, "outputs": frozenset(outputs)} | changes
    return Scene(**settings)


MISS = Grip(Pose(140.0, 0.0, MIDDLE_MM, 0.3), force_n=12.0)


@pytest.mark.parametrize(
    ("outputs", "changes", "passes"),
    [
        (sorted(ALL), {}, "view photo depth 2*turn 2*wall 2*contact 2*gel 2*background"),
        ([], {}, ""),
        (["photo"], {}, "view photo"),
        (["touch_a_before"], {"grip": None}, "background"),
        (["touch_a", "touch_a_after"], {"sensors": {"a": SENSORS["a"]}}, "2*turn wall bare_finger contact gel"),
        (["touch_a"], {}, "2*turn 2*wall contact gel"),
        (["touch_a", "touch_a_after"], {}, "2*turn 2*wall 2*contact gel"),
        (["touch_a", "touch_b", "touch_a_after"], {"grip": MISS}, "2*turn 2*wall background"),
    ],
)
def test_each_output_does_only_what_it_needs_and_shares_the_rest(outputs, changes, passes):
    made = scene(outputs, **changes)
    assert set(made.run()) == set(outputs)
    counts = (each.rpartition("*") for each in passes.split())
    assert dict(made.passes) == {name: int(count or 1) for count, _, name in counts}


def test_pictures_depend_on_the_seed_and_not_on_the_other_outputs():
    whole, other = scene(ALL).run(), scene(ALL, seed=6).run()
    for name in sorted(ALL, reverse=True):
        np.testing.assert_array_equal(scene([name]).run()[name], whole[name])
        assert not np.array_equal(whole[name], other[name], equal_nan=True)


def test_both_gels_carry_the_clamping_force():
    pinch = scene([]).pinch
    for finger in "ab":
        contact = pinch.contact(finger)
        pixel_area = (SENSORS[finger].field.size_mm[1] / contact.pressure_mpa.shape[1]) ** 2
        assert contact.pressure_mpa.sum() * pixel_area == pytest.approx(12.0, rel=0.02)


def test_turning_hand_and_object_together_changes_no_gel_image():
    angle = math.radians(70)
    c, s = math.cos(angle), math.sin(angle)
    here = scene([], placement=Placement(4.0, -3.0, 0.2), grip=Grip(Pose(2.0, 1.0, MIDDLE_MM, 0.3), 12.0))
    pose = Pose(2 * c - 1 * s, 2 * s + 1 * c, MIDDLE_MM, 0.3 + angle)
    there = scene([], placement=Placement(4 * c + 3 * s, 4 * s - 3 * c, 0.2 + angle), grip=Grip(pose, 12.0))
    np.testing.assert_allclose(here.pinch.gap("a"), there.pinch.gap("a"), atol=2e-3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"outputs": {"sound"}}, "outputs are photo, depth"),
        ({"outputs": {"touch_c"}}, "needs a sensor on finger c"),
        ({"outputs": {"touch_a"}, "grip": None}, "needs a grip"),
        ({"sensors": {"c": SENSORS["a"]}}, "fingers a and b"),
    ],
)
def test_an_impossible_scene_is_refused_at_once(changes, message):
    with pytest.raises(SceneError, match=message):
        scene(changes.pop("outputs", ()), **changes)
