"""The simulated rig follows the rig contract, and an attempt depends only on seed, object and number."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest

from robot.collection import CollectSettings, collect
from robot.errors import DeviceError, RobotConfigError, UnknownName
from robot.grasping.attempt import AttemptRunner
from robot.grasping.settings import AttemptSettings
from robot.readings import Pose
from robot.recording.folder import read_recording
from robot.rig import load_rig
from robot.sim.rig import STROKE_MM, SimRig


@pytest.fixture
def rig():
    with SimRig(4, families=["cylinder"]) as made:
        yield made


def pinch(rig, z_mm=None, force_n=12.0, yaw=0.3, offset_mm=0.0):
    """Close over the object on the table; return the state of the gripper."""
    placement, obj = rig.sim_state.scene.placement, rig.sim_state.scene.obj
    z_mm = max(10.0, 0.5 * obj.body.upper[2]) if z_mm is None else z_mm
    rig.gripper.open(STROKE_MM)
    rig.arm.move_to(Pose(placement.x_mm + offset_mm, placement.y_mm, z_mm, yaw), 100.0)
    return rig.gripper.grasp(force_n)


def lift(rig):
    pose = rig.arm.pose()
    rig.arm.move_to(Pose(pose.x_mm, pose.y_mm, pose.z_mm + 100, pose.yaw_rad), 100.0)
    return rig.gripper.state()


def test_a_held_object_sets_the_opening_and_shows_in_both_gels_before_and_after_the_lift(rig):
    rig.prepare(rig.object_ids(1)[0], 0)
    before = {finger: sensor.read().pixels.astype(float) for finger, sensor in rig.sensors.items()}
    state, width = pinch(rig), 2 * float(rig.sim_state.scene.obj.body.upper[0])
    assert state.status == "holding"
    assert width - 8 < state.opening_mm < width + 0.1  # less the compression of the gels
    during = {finger: sensor.read().pixels for finger, sensor in rig.sensors.items()}
    assert lift(rig).status == "holding"
    for finger, sensor in rig.sensors.items():
        assert np.abs(during[finger] - before[finger]).mean() > 3
        assert np.abs(sensor.read().pixels - before[finger]).mean() > 3
    rig.gripper.open(STROKE_MM)
    assert np.abs(rig.sensors["a"].read().pixels - before["a"]).mean() < 3


@pytest.mark.parametrize(
    ("friction", "offset_mm", "closed", "lifted"),
    [(0.01, 0.0, "holding", "part_lost"), (0.5, 100.0, "no_part", "no_part")],
)
def test_a_slippery_and_a_missed_object_give_no_contact_frames(rig, friction, offset_mm, closed, lifted):
    rig.prepare(rig.object_ids(1)[0], 0)
    before = rig.sensors["a"].read().pixels.astype(float)
    scene = rig.sim_state.scene
    obj = replace(scene.obj, material=replace(scene.obj.material, friction=friction))
    rig.sim_state.scene = replace(scene, obj=obj)
    assert pinch(rig, offset_mm=offset_mm).status == closed
    assert lift(rig).status == lifted
    assert np.abs(rig.sensors["a"].read().pixels - before).mean() < 3


def test_an_attempt_depends_only_on_seed_object_and_number(rig):
    first, second = rig.object_ids(2)
    rig.prepare(first, 3)
    expected = rig.camera.read()
    rig.prepare(second, 0)
    rig.camera.read()
    rig.prepare(first, 3)
    again = rig.camera.read()
    np.testing.assert_array_equal(expected.colour, again.colour)
    np.testing.assert_array_equal(expected.depth_m, again.depth_m)
    rig.prepare(first, 4)
    assert not np.array_equal(expected.colour, rig.camera.read().colour)
    rig.prepare(first, 4)
    assert rig.camera.read(depth=False).depth_m is None
    assert rig.sim_state.scene.passes["depth"] == 0


def test_the_camera_pose_is_off_by_five_to_ten_millimetres():
    for seed in range(20):
        rig = SimRig(seed)
        error = rig.camera.extrinsics[:3, 3] - rig.camera._camera.to_rig[:3, 3]
        assert 5 <= np.linalg.norm(error) <= 10


def test_several_pairs_of_gels_alternate_over_the_objects():
    with SimRig(0, gels=3) as rig:
        brightnesses = set()
        for name in rig.object_ids(12):
            rig.prepare(name, 0)
            brightnesses.add(rig.sensors["a"].read().pixels.astype(float).mean().round())
            scene = rig.sim_state.scene
            assert scene.sensors["a"] != scene.sensors["b"]
        assert len(brightnesses) == 3


@pytest.mark.parametrize("optics", ["led", "grey", "gelsight_mini"])
def test_a_session_drifts_slowly_and_differs_from_others_with_and_without_contact(optics):
    def images(seed=4, number=0, **settings):
        with SimRig(seed, families=["cylinder"], optics=optics, **settings) as rig:
            rig.prepare(rig.object_ids(1)[0], number)
            before = rig.sensors["a"].read().pixels.astype(float)
            pinch(rig)
            return before, rig.sensors["a"].read().pixels.astype(float)

    plain, monday, tuesday = images(), images(session="monday"), images(session="tuesday")
    later = images(number=200, session="monday")  # two hours
    np.testing.assert_array_equal(images(session=""), plain)
    np.testing.assert_array_equal(images(session="monday"), monday)
    colours = [before.mean((0, 1)) for before, _ in (plain, monday, tuesday, later)]
    for one, two in ((0, 1), (1, 2)):
        assert 0.01 < np.abs(np.log(colours[one] / colours[two])).max() < 0.4
    assert 0.001 < np.abs(np.log(colours[1] / colours[3])).max() < 0.06
    gains = [np.median((drifted + 1) / (still + 1), axis=(0, 1)) for drifted, still in zip(monday, plain, strict=True)]
    np.testing.assert_allclose(*gains, atol=0.03)  # the press changes a part of the image


def test_the_file_sets_force_and_attempts_of_grasps(tmp_path):
    path = tmp_path / "sim.toml"
    path.write_text('rig = "sim"\n[grasp]\nforce_n = [10.0, 11.0]\n[attempt]\nsettle_s = 0.25\noutputs = ["before"]\n')
    with load_rig(str(path), seed=0) as rig:
        assert (rig.attempt.settle_s, rig.attempt.retries) == (0.25, AttemptSettings.retries)
        runner = AttemptRunner(rig, 0, rig.attempt)
        attempts = [runner.run(rig.object_ids(1)[0], number) for number in range(6)]
    tried = [attempt for attempt in attempts if attempt.images]
    assert tried
    assert all(10.0 <= attempt.fields["force_n"] <= 11.0 for attempt in tried)
    assert set(tried[0].images) == {"photo", "touch_a", "touch_a_before", "touch_b", "touch_b_before"}


def test_a_softer_gel_is_compressed_further():
    openings = []
    for modulus in (0.2, 0.8):
        gel = {finger: {"modulus_mpa": modulus, "thickness_mm": 3.0, "poisson": 0.48} for finger in "ab"}
        with SimRig(4, families=["cylinder"], gel=gel) as rig:
            rig.prepare(rig.object_ids(1)[0], 0)
            openings.append(pinch(rig).opening_mm)
    assert openings[0] < openings[1] - 0.1


def test_a_recording_has_the_materials_of_each_pair_of_gels(tmp_path):
    gel = {"thickness_mm": 3.0, "modulus_mpa": 0.35, "poisson": 0.48}
    rig = functools.partial(load_rig, "sim", seed=0, gels=2, gel={"a": gel, "b": {"thickness_mm": 2.0}})
    settings = CollectSettings(1, attempt=AttemptSettings(outputs=("before",)))
    collect(rig, tmp_path / "r", objects=1, seed=0, settings=settings)
    first, second = read_recording(tmp_path / "r").info["gels"]
    assert first["a"] == second["a"] == gel
    assert first["b"]["thickness_mm"] == second["b"]["thickness_mm"] == 2.0
    layers = [pair["b"].layer for pair in rig()._gels]
    assert [pair["b"]["modulus_mpa"] for pair in (first, second)] == [layer.modulus_mpa for layer in layers]


def test_an_empty_table_and_an_object_of_another_seed_raise(rig):
    with pytest.raises(DeviceError, match="Call prepare"):
        rig.camera.read()
    for name in ("bottle-ribs-0009-00001", "mug"):
        with pytest.raises(RobotConfigError, match=f"has no '{name}"):
            rig.prepare(name, 0)


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"fingers": ["a", "c"]}, RobotConfigError),
        ({"optics": "neon"}, UnknownName),
        ({"families": ["teapot"]}, RobotConfigError),
        ({"gels": 0}, RobotConfigError),
        ({"grasp": {"force_n": [1.0, 10.0]}}, RobotConfigError),
        ({"gel": {"a": {"modulus_mpa": math.nan}}}, RobotConfigError),
    ],
)
def test_impossible_settings_are_refused(settings, error):
    with pytest.raises(error):
        load_rig("sim", seed=0, **settings)
