"""Jaws that close on an object: closed forms, order of the method, and an explicit method that diverges."""

import math

import numpy as np
import pytest

from robot.readings import Pose
from robot.sim.contact.layer import Layer, press
from robot.sim.rig import SimRig
from tests.robot.sim.closing_jaws import (
    Jaws,
    LinearLaw,
    Motion,
    close,
    press_law,
    settle,
)


def spring_closing(jaws, stiffness_n_mm, times_s):
    """Return the travel in mm of a jaw that starts at rest on a spring: m s'' + c s' + k s = F, underdamped."""
    mass = jaws.jaw_mass_kg / 1e3
    decay = jaws.jaw_damping_n_s_mm / (2.0 * mass)
    turn = math.sqrt(stiffness_n_mm / mass - decay**2)
    swing = np.exp(-decay * times_s) * (np.cos(turn * times_s) + decay / turn * np.sin(turn * times_s))
    return jaws.force_n / stiffness_n_mm * (1.0 - swing)


def on_springs(stiffness_n_mm, force_n=20.0, clearance=(0.0, 0.0), **jaws):
    law = LinearLaw(stiffness_n_mm)
    return Motion(Jaws(force_n, **jaws), (law, law), clearance)


# Motion ----------------------------------------------------------------------------------------------------


def test_jaws_on_a_spring_move_as_the_damped_oscillator_does():
    motion = on_springs(100.0)
    times, states = close(motion, 0.05, 1e-4)
    exact = spring_closing(motion.jaws, 100.0, times)
    assert states[:, 0] == pytest.approx(exact, abs=4e-4 * 0.2)
    assert states[:, 1] == pytest.approx(states[:, 0])
    assert states[:, 2] == pytest.approx(0.0)


def test_the_error_falls_with_the_square_of_the_step():
    motion = on_springs(100.0)
    errors = []
    for step in (4e-4, 2e-4, 1e-4):
        times, states = close(motion, 0.02, step)
        errors.append(np.abs(states[:, 0] - spring_closing(motion.jaws, 100.0, times)).max())
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)
    assert math.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.1)


def test_an_object_off_the_middle_is_pushed_until_both_fingers_hold_it():
    motion = on_springs(10.0, clearance=(1.0, 3.0))
    _, states = close(motion, 2.0, 1e-2)
    assert motion.contact_forces(states[-1]) == pytest.approx((20.0, 20.0), rel=1e-6)
    assert states[-1, 2] > 0.0  # finger a came first and pushed it away
    assert states[-1, 0] + states[-1, 1] == pytest.approx(4.0 + 2.0 * 2.0, rel=1e-6)


# Stiffness -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stiffness_n_m", [1e3, 1e5, 1e7, 1e9])
def test_every_stiffness_ends_at_the_commanded_force_in_steps_of_ten_milliseconds(stiffness_n_m):
    motion = on_springs(stiffness_n_m * 1e-3, clearance=(2.0, 1.0))
    _, states = close(motion, 1.0, 1e-2)
    assert np.isfinite(states).all()
    assert motion.contact_forces(states[-1]) == pytest.approx((20.0, 20.0), rel=1e-4)
    assert settle(motion) == pytest.approx((20e3 / stiffness_n_m,) * 2, rel=1e-12)


def test_a_fast_oscillation_dies_out_within_long_steps():
    # 1e9 N/m, started 1 um too deep at both fingers: an excess of 1000 N decays in ten steps of 10 ms.
    motion = on_springs(1e6)
    start = np.array([1e-3 + 2e-5, 1e-3 + 2e-5, 0.0, 0.0, 0.0, 0.0])
    _, states = close(motion, 0.1, 1e-2, start)
    assert motion.contact_forces(states[-1]) == pytest.approx((20.0, 20.0), rel=1e-2)


# Rest ------------------------------------------------------------------------------------------------------


# Force laws ------------------------------------------------------------------------------------------------


def test_the_rig_shows_the_gels_at_the_rest_position_of_closing_jaws():
    """The rig presses with the commanded force at once; the closing motion does not change the recording."""
    with SimRig(4, families=["cylinder"]) as rig:
        rig.prepare(rig.object_ids(1)[0], 0)
        at = rig.sim_state.scene.placement
        rig.arm.move_to(Pose(at.x_mm, at.y_mm, 20.0, 0.3), 100.0)
        rig.gripper.grasp(12.0)
        pinch = rig.sim_state.scene.pinch
        gaps = [np.maximum(pinch.gap(finger), 0.0) for finger in "ab"]
        layers = [pinch.scene.sensors[finger].layer for finger in "ab"]
        pixel_mm = pinch._pixel_mm
    pressed = [
        press(gap, pixel_mm, layer, force_n=12.0, tolerance=1e-4) for gap, layer in zip(gaps, layers, strict=True)
    ]
    laws = [
        press_law(gap, pixel_mm, layer, 1.5 * one.approach_mm, points=6)
        for gap, layer, one in zip(gaps, layers, pressed, strict=True)
    ]
    motion = Motion(Jaws(12.0), (laws[0], laws[1]))
    _, states = close(motion, 2.0, 0.01)
    assert motion.contact_forces(states[-1]) == pytest.approx((12.0, 12.0), abs=1e-3)
    depths = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 1.0]]) @ states[-1][:3]
    assert depths == pytest.approx([one.approach_mm for one in pressed], rel=0.01)  # error of the table's interpolation


def test_a_press_law_matches_the_solver_at_and_between_the_depths_of_its_table():
    gap = (np.arange(-20.0, 21.0)[:, None] ** 2 + np.arange(-20.0, 21.0) ** 2) * 0.15**2 / 8.0 + 3.0
    layer = Layer(0.2, 0.48, 2.0)
    law = press_law(gap, 0.15, layer, 0.8)
    for depth, tolerance in ((0.4, 1e-9), (0.8, 1e-9), (0.45, 1e-2)):
        force = press(gap, 0.15, layer, depth_mm=3.0 + depth).force_n
        assert law(depth)[0] == pytest.approx(force, rel=tolerance)
