"""Contact of two closing fingers and whether they hold, against analytic bodies with known answers."""

import dataclasses
import math

import numpy as np
import pytest

from robot.readings import Pose
from robot.sim.camera import Placement
from robot.sim.gel.sensor import draw_sensor
from robot.sim.objects.body import Body
from robot.sim.objects.draw import draw_object
from robot.sim.scene import GRAVITY_M_S2, SAFETY, Grip, Hand, Scene

SENSORS = {finger: draw_sensor(0, finger) for finger in "ab"}
ANY = draw_object(0, 0)


class Slanted(Body):
    """A solid between the planes x = -10 + z' tan(left) and x = 10 - z' tan(right), z' = z - 50, for |y| < 40."""

    def __init__(self, left_rad=0.0, right_rad=0.0, half_y_mm=40.0):
        self.slopes = math.tan(left_rad), math.tan(right_rad)
        self.lower, self.upper = np.array([-80.0, -half_y_mm, 0.0]), np.array([80.0, half_y_mm, 100.0])

    def _cast(self, rays, step_mm):
        """Rays come from outside, across the solid, like those of fingers: at a plane n.p = c, t = (c - n.o) / n.d."""
        distance = np.full(len(rays.origins), np.inf)
        for sign, slope in zip((-1.0, 1.0), self.slopes, strict=True):
            normal = np.array([sign, 0.0, slope])
            speed = rays.directions @ normal
            towards = speed < -1e-9
            reach = (10.0 + 50.0 * slope - rays.origins @ normal) / np.where(towards, speed, -1.0)
            points = rays.origins + reach[:, None] * rays.directions
            inside = (
                (np.abs(points[:, 1]) <= self.upper[1]) & (points[:, 2] >= 0) & (points[:, 2] <= 100) & (reach >= 0)
            )
            distance = np.where(towards & inside, np.minimum(distance, reach), distance)
        return distance

    def _normals(self, points, step_mm):
        raise NotImplementedError

    def volumes_mm3(self, shell_mm):
        return 1e5, 1e4


def thing(body, *, friction=0.6, modulus_mpa=1e4, density_kg_m3=1000.0):
    """Return an object of 1e5 mm3: at 1000 kg/m3 it weighs 0.1 kg."""
    material = dataclasses.replace(
        ANY.material, friction=friction, modulus_mpa=modulus_mpa, density_kg_m3=density_kg_m3, poisson=0.3
    )
    return dataclasses.replace(ANY, body=body, material=material)


def pinch(obj, *, yaw=0.0, force_n=12.0, sensors=None, placement=None, opening_mm=110.0, z_mm=50.0, y_mm=0.0):
    grip, sensors = Grip(Pose(0.0, y_mm, z_mm, yaw), force_n, opening_mm), SENSORS if sensors is None else sensors
    return Scene(obj, placement or Placement(), sensors=sensors, grip=grip, seed=1).pinch


def test_flat_sides_end_nearly_square_to_the_fingers():
    block = thing(Slanted())
    for degrees in (-25, -7, 0, 7, 25):
        placement = pinch(block, yaw=math.radians(degrees)).final_placement
        assert math.degrees(placement.yaw_rad) == pytest.approx(degrees, abs=0.6)


def test_the_jaws_end_at_the_width_less_both_approaches():
    made = pinch(thing(Slanted()))
    approach = made.contact("a").approach_mm + made.contact("b").approach_mm
    angle = made.final_placement.yaw_rad
    pad = SENSORS["a"].field.size_mm[1] * (1 - 1 / 160)
    width = 20 / math.cos(angle) + pad * abs(math.tan(angle))
    assert made.final_opening_mm == pytest.approx(width - approach, abs=0.02)


def test_a_bare_finger_does_not_give_way():
    made = pinch(thing(Slanted()), sensors={"a": SENSORS["a"]})
    assert made.final_opening_mm == pytest.approx(20 - made.contact("a").approach_mm, abs=0.3)
    assert made.scene.passes["contact"] == 1
    assert made.slip_reason is None


def test_a_foam_is_not_squeezed_to_nothing():
    assert pinch(thing(Slanted(), modulus_mpa=0.01), force_n=25.0).final_opening_mm >= 0.2 * 20


@pytest.mark.parametrize(("factor", "held"), [(1.05, True), (0.95, False)])
def test_friction_must_carry_the_weight_and_a_half(factor, held):
    friction, mass_kg = 0.5, 0.1
    force = factor * SAFETY * mass_kg * GRAVITY_M_S2 / (2 * friction)
    made = pinch(thing(Slanted(half_y_mm=5.0), friction=friction), force_n=force)
    assert made.slip_reason == (None if held else "the object is too heavy for the friction")


@pytest.mark.parametrize(("degrees", "held"), [(10, True), (25, False)])
def test_a_wedge_steeper_than_the_friction_cone_is_squeezed_out(degrees, held):
    """Friction 0.3 holds up to atan(0.3) = 16.7 degrees."""
    wedge = thing(Slanted(math.radians(degrees), math.radians(degrees)), friction=0.3)
    made = pinch(wedge, force_n=4.0)
    assert (made.slip_reason is None) == held


def test_contacts_that_are_far_apart_along_the_fingers_slip():
    """A plate leaning by 50 degrees: a touches it low, b high."""
    made = pinch(thing(Slanted(math.radians(50), math.radians(-50)), friction=0.3))
    assert made.slip_reason in ("the fingers press past each other", "the side is too steep")


def test_an_object_next_to_the_fingers_or_under_one_is_missed():
    made = pinch(thing(Slanted(half_y_mm=5.0)), y_mm=30.0)
    assert made.miss_reason == "the object is not between the fingers"
    assert made.scene.passes["contact"] == 0
    made = pinch(thing(Slanted()), placement=Placement(x_mm=50.0))
    assert made.miss_reason == "a finger comes down on the object"


def test_an_object_grasped_far_from_its_middle_turns_about_the_grip():
    """Jaws close 30 mm from the middle of a block, 10 degrees off square, and meet the same place after the turn.

    A turn about the block's own middle would move that place aside by 30 sin(10 deg) = 5 mm.
    """
    block, angle = thing(Slanted()), math.radians(10)
    moved = {}
    for about_grip in (True, False):
        made = dataclasses.replace(
            pinch(block, y_mm=30.0, yaw=angle).scene, hand=Hand(turns_about_grip=about_grip)
        ).pinch
        assert made.final_placement.yaw_rad == pytest.approx(angle, abs=math.radians(0.6))
        moved[about_grip] = made.final_placement.to_object(np.array([[0.0, 30.0, 0.0]]))[0]
    np.testing.assert_allclose(moved[True], [0, 30, 0], atol=1e-9)
    assert moved[False][0] == pytest.approx(30 * math.sin(angle), abs=0.4)


@pytest.mark.parametrize("tilt", [math.pi / 2, -math.pi / 2])
def test_from_the_side_the_gap_of_an_upright_cylinder_is_turned_by_a_quarter(tilt):
    """From above the wall is parallel to the columns, so every row is the same; from a side every column."""
    post = dataclasses.replace(draw_object(0, 0, family="cylinder", relief="smooth"))
    upright = pinch(post, yaw=0.3, z_mm=40.0).gap("a")
    grip = Grip(Pose(0.0, 0.0, 40.0, 0.3, tilt), 12.0)
    tilted = dataclasses.replace(pinch(post, yaw=0.3).scene, grip=grip).pinch.gap("a")
    assert np.ptp(upright, axis=0).max() < 1e-3 < np.ptp(upright, axis=1).max()
    assert np.ptp(tilted, axis=1).max() < 1e-3 < np.ptp(tilted, axis=0).max()
