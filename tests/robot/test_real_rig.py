"""A rig of real devices from a file: its devices, its errors; reading the file connects nothing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robot.drivers.manual_arm import ManualArm
from robot.drivers.usb_camera.driver import OpencvTactile, UvcCamera
from robot.drivers.wsg50.driver import WSG50
from robot.errors import RobotConfigError, UnknownName
from robot.grasping.planner import CylinderPlanner
from robot.readings import Pose
from robot.real_rig import DRIVERS, load_driver
from robot.rig import GraspPlan, GraspPlanner, load_rig
from robot.sight import hand_eye

TABLES = {
    "": 'rig = "real"\nsource = "bench 3"\nsensor = "gelsight mini"',
    "limits": "workspace_lower_mm = [-100, -100, 10]\nworkspace_upper_mm = [100, 100, 300]\nforce_n = 15\n"
    "jaw_speed_mm_s = 40\narm_speed_mm_s = 90",
    "arm": 'driver = "manual"',
    "gripper": 'driver = "wsg50"\nhost = "127.0.0.1"',
    "sensors.a": 'driver = "uvc"\ndevice = "/dev/v4l/by-id/usb-gel-video-index0"',
    "camera": 'driver = "uvc"\ndevice = "/dev/v4l/by-id/usb-cam-video-index0"',
    "object": "x_mm = 0\ny_mm = 5\nheight_mm = 100\nradius_mm = 30",
}


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Return the rig of a file with some tables replaced (None: left out)."""
    monkeypatch.chdir(tmp_path)

    def load_changed(**changed):
        tables = {name: text for name, text in {**TABLES, **changed}.items() if text is not None}
        Path("rig.toml").write_text("\n".join(f"[{name}]\n{text}" if name else text for name, text in tables.items()))
        return load_rig("rig.toml", seed=0)

    return load_changed


def points():
    """Write the calibration file of a camera 800 mm above the table that points down."""
    camera = np.array([[0, 0, 800], [100, 0, 800], [0, 100, 800], [0, 0, 700], [90, 80, 650]], float)
    rig = camera * [1, -1, -1] + [0, 0, 800]
    hand_eye.fit_hand_eye(camera, rig).save(Path("hand_eye.json"))


def test_a_file_becomes_a_rig_with_its_devices_under_its_limits(load):
    rig = load()
    assert isinstance(rig.arm, ManualArm)
    assert isinstance(rig.gripper, WSG50)
    assert isinstance(rig.sensors["a"], OpencvTactile)
    assert isinstance(rig.camera, UvcCamera)
    assert rig.arm.workspace.upper == (100, 100, 300)
    assert rig.arm.max_speed_mm_s == 90
    assert rig.gripper.max_force_n <= 15
    assert rig.gripper.max_speed_mm_s == 40
    assert rig.info["source"] == "bench 3"
    assert "licence" not in rig.info
    assert rig.info["rig_settings"]["gripper"]["driver"] == "wsg50"
    assert not any(device.is_connected for device in rig.devices)
    assert rig.attempt.grasp.force_n == (5.0, 15)  # the defaults, capped by the limits
    assert (rig.attempt.travel_mm_s, rig.attempt.approach_mm_s, rig.attempt.closing_mm_s) == (90, 50, 40)


def test_known_values_of_the_gels_are_recorded_and_the_others_are_unknown(load):
    unknown = {"thickness_mm": "unknown", "modulus_mpa": "unknown", "poisson": "unknown"}
    assert load().info["gels"] == [{"a": unknown}]
    rig = load(**{"gel.a": "thickness_mm = 4"})
    assert rig.info["gels"] == [{"a": {**unknown, "thickness_mm": 4.0}}]


def test_a_file_names_the_objects(load):
    rig = load(**{"": TABLES[""] + '\nobjects = ["nut", "bolt"]'})
    assert rig.object_ids(1) == ["nut"]
    with pytest.raises(RobotConfigError, match="names 2 objects, fewer than 3: give --objects 2"):
        rig.object_ids(3)


def test_a_given_object_replaces_the_fit_for_a_camera_without_depth(load):
    fit = load().object_fit
    assert (fit.x_mm, fit.y_mm, fit.height_mm, fit.radius_mm, fit.method) == (0, 5, 100, 30, "given")
    assert fit.width_mm(1.0, 25.0) == 60
    with pytest.raises(RobotConfigError, match="has no depth: give the position and size of every object"):
        load(object=None)


def test_a_file_chooses_the_grasp_planner_and_its_settings(load):
    assert load(planner="search_margin_mm = 20").planner.search_margin_mm == 20
    named = load(planner='name = "cylinder"\nsearch_margin_mm = 30')
    assert (type(named.planner), named.planner.search_margin_mm) == (CylinderPlanner, 30)
    assert named.info["rig_settings"]["planner"] == {"name": "cylinder", "search_margin_mm": 30}


class Blind(GraspPlanner):
    needs_depth = False

    def __init__(self, *, height_mm: float):
        self.height_mm = height_mm

    def plan(self, rig, image, settings, rng):
        pose = Pose(1.0, 2.0, self.height_mm, 0.5)
        return GraspPlan(pose, replace(pose, z_mm=200.0), rig.gripper.stroke_mm, 10.0)


BLIND = 'name = "tests.robot.test_real_rig:Blind"\nheight_mm = 40'


def test_a_planner_of_a_users_module_plans_without_depth_if_it_needs_none(load):
    rig = load(planner=BLIND, object=None)
    plan = rig.planner.plan(rig, None, rig.attempt.grasp, np.random.default_rng(0))
    assert plan.pose == Pose(1.0, 2.0, 40, 0.5)


def test_a_camera_with_depth_requires_a_calibration(load):
    depth = 'driver = "realsense"\n'
    with pytest.raises(RobotConfigError, match="a camera with depth requires hand_eye = FILE"):
        load(camera=depth)
    points()
    found = load(camera=depth + 'hand_eye = "hand_eye.json"', object=None)
    assert found.camera.extrinsics[:3, 3] == pytest.approx([0, 0, 800], abs=1e-6)
    assert found.object_fit is None


BAD = {
    "an unknown driver": ({"arm": 'driver = "kuka"'}, r"\[arm\]: driver must be one of .*, sawyer; got 'kuka'"),
    "no driver": ({"gripper": 'host = "a"'}, r"\[gripper\]: driver must be one of wsg50; got None"),
    "an unknown key": ({"gripper": 'driver = "wsg50"\nhost = "a"\nbort = 1'}, r"\[gripper\] has no setting 'bort'"),
    "a key too few": ({"gripper": 'driver = "wsg50"'}, r"\[gripper\] requires 'host'"),
    "an unknown finger": ({"sensors.c": 'driver = "uvc"'}, r"\[sensors.b\] or both; got .*c"),
    "a limit of zero": ({"limits": TABLES["limits"] + "\nstate_age_s = 0"}, r"\[limits\]: state_age_s must be"),
    "a force above the limit": ({"grasp": "force_n = [5, 16]"}, "force_n must be at most 15"),
    "a speed above the limit": ({"attempt": "travel_mm_s = 91"}, r"travel_mm_s must be at most 90"),
    "an unknown attempt setting": ({"attempt": "speed = 3"}, r"\[attempt\] has no setting 'speed'"),
    "a gel of no finger": ({"gel.b": "thickness_mm = 4"}, r"a finger with a sensor: \[gel\.a\]; got 'b'"),
    "a gel of no thickness": ({"gel.a": "thickness_mm = 0"}, r"\[gel\.a\]: thickness_mm must be a number >= 0\.01"),
    "an unknown planner": ({"planner": 'name = "sphere"'}, r"\[planner\]: name must be one of cylinder, mesh; .*Class"),
    "a planner without its setting": ({"planner": BLIND.split("\n")[0]}, r"\[planner\] requires 'height_mm'"),
    "a planner with a negative margin": ({"planner": "search_margin_mm = -1"}, r"\[planner\]: search_margin_mm"),
    "a planner that is another object": ({"planner": 'name = "json:dumps"'}, "'json:dumps' must be a GraspPlanner"),
    "meshes of a real rig": ({"planner": 'name = "mesh"'}, "plans for meshes of the simulated rig only"),
    "no time to settle": ({"attempt": "settle_s = 0"}, r"\[attempt\]: settle_s must be at least 0\.1 s"),
    "an object of no size": ({"object": "x_mm = 0\ny_mm = 0\nheight_mm = 0\nradius_mm = 3"}, r"\[object\]: height_mm"),
}


@pytest.mark.parametrize("case", sorted(BAD))
def test_a_wrong_file_is_refused_with_the_place_and_the_remedy(case, load):
    changed, message = BAD[case]
    with pytest.raises((RobotConfigError, UnknownName), match=message):
        load(**changed)


@pytest.mark.parametrize(("role", "name"), [(role, name) for role, known in DRIVERS.items() for name in known])
def test_every_driver_of_the_table_exists_and_refuses_an_unknown_key(role, name):
    with pytest.raises(RobotConfigError, match="no setting 'bort'"):
        load_driver(role, {"driver": name, "bort": 1}, "[x]")
