"""A scene computes only what its outputs need; its results agree with answers known by hand."""

import dataclasses
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


def passes_of(outputs, **changes):
    """Return the computations done for these outputs, by name and number."""
    made = scene(outputs, **changes)
    images = made.run()
    assert set(images) == set(outputs)
    return dict(made.passes)


def test_a_whole_scene_does_each_thing_once_for_each_finger():
    assert passes_of(ALL) == {
        "view": 1,
        "photo": 1,
        "depth": 1,
        "turn": 2,
        "wall": 2,
        "contact": 2,
        "gel": 2,
        "background": 2,
    }


def test_no_outputs_need_no_work():
    assert passes_of(()) == {}


def test_a_photo_needs_neither_depth_nor_touch():
    assert passes_of(["photo"]) == {"view": 1, "photo": 1}


def test_a_depth_image_needs_no_shading():
    assert passes_of(["depth"]) == {"view": 1, "depth": 1}


def test_photo_and_depth_share_one_geometry_pass():
    assert passes_of(["photo", "depth"])["view"] == 1


def test_touches_need_no_camera():
    assert not set(passes_of(["touch_a", "touch_b"])) & {"view", "photo", "depth"}


def test_a_no_contact_frame_needs_no_contact_solve_and_no_grip():
    assert passes_of(["touch_a_before"], grip=None) == {"background": 1}


def test_a_sensor_on_one_finger_solves_one_contact():
    done = passes_of(["touch_a", "touch_a_after"], sensors={"a": SENSORS["a"]})
    assert done["contact"] == done["wall"] == done["bare_finger"] == 1


def test_one_of_two_fingers_solves_one_contact_until_the_lift_needs_the_other():
    assert passes_of(["touch_a"])["contact"] == 1
    assert passes_of(["touch_a", "touch_a_after"])["contact"] == 2


def test_a_missed_grasp_solves_no_contact():
    miss = Grip(Pose(140.0, 0.0, MIDDLE_MM, 0.3), force_n=12.0)
    done = passes_of(["touch_a", "touch_b", "touch_a_after"], grip=miss)
    assert "contact" not in done
    assert "gel" not in done


def test_a_finger_that_comes_down_on_the_object_is_a_miss_with_this_reason():
    narrow = dataclasses.replace(GRIP, opening_mm=0.5 * float(BOTTLE.body.upper[0]))
    pinch = scene([], grip=narrow).pinch
    assert pinch.miss_reason == pinch.slip_reason == "a finger comes down on the object"
    assert pinch.final_opening_mm == 0


def test_a_missed_grasp_shows_the_no_contact_frame():
    miss = Grip(Pose(140.0, 0.0, MIDDLE_MM, 0.3), force_n=12.0)
    images = scene(["touch_a", "touch_a_before"], grip=miss).run()
    difference = images["touch_a"].astype(float) - images["touch_a_before"].astype(float)
    assert abs(difference.mean()) < 0.3
    assert np.abs(difference).max() < 25


def test_the_same_seed_makes_the_same_pictures_and_another_one_does_not():
    first, again, other = scene(ALL).run(), scene(ALL).run(), scene(ALL, seed=6).run()
    for name in ALL:
        np.testing.assert_array_equal(first[name], again[name])
        assert not np.array_equal(first[name], other[name], equal_nan=True)


def test_the_order_of_outputs_changes_no_pixel():
    whole = scene(ALL).run()
    for name in sorted(ALL, reverse=True):
        np.testing.assert_array_equal(scene([name]).run()[name], whole[name])


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
        ({"outputs": {"touch_b"}, "sensors": {"a": SENSORS["a"]}}, "needs a sensor on finger b"),
        ({"outputs": {"touch_a"}, "grip": None}, "needs a grip"),
        ({"outputs": {"touch_a_after"}, "grip": None}, "needs a grip"),
        ({"sensors": {"c": SENSORS["a"]}}, "fingers a and b"),
    ],
)
def test_an_impossible_scene_is_refused_at_once(changes, message):
    with pytest.raises(SceneError, match=message):
        scene(changes.pop("outputs", ()), **changes)
