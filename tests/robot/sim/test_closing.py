"""Jaws that close on an object come to rest where the simulated rig presses at once."""

from functools import partial

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from robot.readings import Pose
from robot.sim.contact.layer import press
from robot.sim.rig import SimRig
from tests.robot.sim.closing_jaws import Motion, close, spring


def test_an_object_off_the_middle_is_pushed_until_both_fingers_hold_it():
    motion = Motion(20.0, (partial(spring, 10.0),) * 2, (1.0, 3.0))
    state = close(motion, 2.0)
    assert motion.contact_forces(state)[0] == pytest.approx((20.0, 20.0), rel=1e-3)
    assert state[2] > 0.0  # finger a came first and pushed it away
    assert state[0] + state[1] == pytest.approx(4.0 + 2.0 * 2.0, rel=1e-3)


def test_the_rig_shows_the_gels_at_the_rest_position_of_closing_jaws():
    """The rig presses with the commanded force at once; the closing motion does not change the recording."""
    with SimRig(4, families=["cylinder"]) as rig:
        rig.prepare(rig.object_ids(1)[0], 0)
        at = rig.sim_state.scene.placement
        rig.arm.move_to(Pose(at.x_mm, at.y_mm, 20.0, 0.3), 100.0)
        rig.gripper.grasp(12.0)
        pinch = rig.sim_state.scene.pinch
    laws, depths = [], []
    for finger in "ab":
        gap, layer = pinch.gap(finger), pinch.scene.sensors[finger].layer
        depths.append(press(gap, pinch._pixel_mm, layer, force_n=12.0, tolerance=1e-4).approach_mm)
        table = depths[-1] * np.linspace(0.0, 1.5, 7)
        forces = [press(gap, pinch._pixel_mm, layer, depth_mm=depth).force_n for depth in table]
        force = PchipInterpolator(table, forces)
        laws.append(lambda depth, force=force: (float(force(depth)), float(force(depth, 1))))
    motion = Motion(12.0, (laws[0], laws[1]))
    state = close(motion, 2.0)
    assert motion.contact_forces(state)[0] == pytest.approx((12.0, 12.0), rel=1e-3)
    assert motion.depths(state) == pytest.approx(depths, rel=0.01)  # error of the table's interpolation
