"""Resting poses, and grasps of meshes from above and from the sides, for solids with answers known by hand."""

import dataclasses
import functools
import math
import re

import numpy as np
import pytest

from robot.collection import CollectSettings, collect
from robot.errors import RobotConfigError, UngraspableError
from robot.grasping.attempt import AttemptRunner
from robot.grasping.settings import GraspSettings
from robot.readings import Pose
from robot.recording.folder import read_recording
from robot.rig import load_rig
from robot.sim.antipodal import find_grasps
from robot.sim.objects import resting
from robot.sim.objects.resting import UP, stable_up_directions
from tests.meshes import ball, bottle, box, load_mesh_object, saved, trimesh

SETTINGS, STROKE_MM = GraspSettings(), 110.0
FINGER_MM, HAND_MM = 15.0, 50.0


def grasps_of(tmp_path, mesh):
    body = load_mesh_object(saved(tmp_path / "thing.stl", mesh), 0, relief="smooth").body
    return find_grasps(body, SETTINGS, STROKE_MM)


def mesh_rig(folder, seed=0, **settings):
    return load_rig("sim", seed=seed, meshes=str(folder), contact_grid=[30, 40], **settings)


def test_a_box_rests_on_its_six_sides_upright_first_then_the_most_stable():
    ups = stable_up_directions(box(60, 90, 180).vertices, np.zeros(3))
    assert ups[0] is UP
    np.testing.assert_allclose(np.sort(np.abs(ups[1:5]), axis=1), np.tile([0, 0, 1], (4, 1)), atol=1e-9)
    np.testing.assert_allclose([abs(up[0]) for up in ups[1:5]], [1, 1, 0, 0], atol=1e-9)  # the largest sides
    np.testing.assert_allclose(ups[5], [0, 0, -1], atol=1e-9)


def test_a_box_is_grasped_across_its_flat_sides_from_above_and_from_the_sides(tmp_path):
    grasps = grasps_of(tmp_path, box(60, 90, 180))
    degrees = np.degrees(grasps.yaw_rad).round().astype(int)
    assert set(degrees) == {0, 10, 80, 90, 100, 170}  # within the friction cone of a side's normal: 17 degrees
    for yaw, width in ((0, 60), (90, 90)):
        np.testing.assert_allclose(grasps.width_mm[degrees == yaw], width, atol=1e-3)
    for tilt in (0.0, math.pi / 2, -math.pi / 2):
        assert (grasps.tilt_rad == tilt).sum() > 100
    heights = grasps.points[grasps.tilt_rad == 0, 2]
    assert 180 - SETTINGS.reach_mm <= heights.min() < heights.max() <= 180 - SETTINGS.top_margin_mm
    heights = grasps.points[grasps.tilt_rad != 0, 2]
    assert heights.min() >= HAND_MM / 2
    assert np.ptp(heights) > 120
    np.testing.assert_allclose(grasps.points[degrees == 0, 0], 0, atol=1e-3)  # in the middle between the two sides


@pytest.mark.parametrize("solid", [box(60, 90, 180), bottle(), box(40, 200, 30)], ids=["box", "bottle", "bar"])
def test_neither_fingers_nor_hand_sweep_over_the_object_or_the_table(tmp_path, solid):
    """Checked with points all over the surface, in the frame of the open gripper, along its whole path."""
    grasps = grasps_of(tmp_path, solid)
    assert len(grasps) > 100
    solid = solid.copy()
    solid.apply_translation([0, 0, -solid.bounds[0, 2]])
    # Between rays of the grid, 3 mm apart, the fingers may meet the object.
    points, _ = trimesh.sample.sample_surface(solid, int(0.3 * solid.area), seed=0)
    inside, coarse = STROKE_MM / 2, 3.0
    for number in np.random.default_rng(1).choice(len(grasps), 100, replace=False):
        pose = Pose(*grasps.points[number], grasps.yaw_rad[number], grasps.tilt_rad[number])
        x, y, z = ((points - pose.as_tuple()[:3]) @ pose.rotation()).T
        fingers = (
            (np.abs(x) > inside) & (np.abs(y) < SETTINGS.finger_mm / 2 - coarse) & (z > coarse - SETTINGS.floor_mm)
        )
        hand = (np.abs(y) < HAND_MM / 2 - coarse) & (z > SETTINGS.reach_mm + coarse)
        assert not (fingers & (np.abs(x) < inside + FINGER_MM)).any()
        assert not (hand & (np.abs(x) < inside + FINGER_MM)).any()
        tips = np.array([[0, side * SETTINGS.finger_mm / 2, -SETTINGS.floor_mm] for side in (-1, 1)])
        back = np.array([[0, side * HAND_MM / 2, SETTINGS.reach_mm] for side in (-1, 1)])
        corners = np.concatenate([tips, back]) @ pose.rotation().T + pose.as_tuple()[:3]
        assert corners[:, 2].min() >= 0
        withdrawn = z - grasps.retreat_mm[number]  # from there, the whole object is ahead of the fingertips
        assert withdrawn.max() < -SETTINGS.floor_mm + coarse


def test_a_bottle_is_grasped_at_its_body_and_its_neck_from_all_around(tmp_path):
    grasps = grasps_of(tmp_path, bottle())
    assert len(set(grasps.yaw_rad)) == 18
    neck, body = grasps.points[:, 2] > 152, grasps.points[:, 2] < 100
    np.testing.assert_allclose(grasps.width_mm[body & (grasps.points[:, 2] > 15)], 68, atol=2.5)
    np.testing.assert_allclose(grasps.width_mm[neck], 26, atol=4)  # a pad there may touch the shoulder
    assert neck.sum() > 50
    slanted = (grasps.points[:, 2] > 130) & (grasps.points[:, 2] < 138)  # 20 mm up for 16 mm in: too steep to hold
    assert not slanted.any()


def test_a_box_that_is_too_wide_on_two_axes_is_grasped_when_it_rests_on_edge(tmp_path):
    assert not len(grasps_of(tmp_path, box(150, 160, 60)))
    rig = mesh_rig(tmp_path)
    with rig:
        name = rig.object_ids(1)[0]
        rig.prepare(name, 0)
        height = rig.sim_state.scene.obj.body.mesh.vertices[:, 2].max()
        assert height > 149
        attempts = [AttemptRunner(rig, 0, rig.attempt).run(name, number) for number in range(3)]
    assert "held" in {attempt.outcome for attempt in attempts}
    assert all(attempt.fit["width_mm"] < 80 for attempt in attempts)


def test_an_object_that_no_allowed_force_lifts_is_reported_as_too_heavy(tmp_path):
    saved(tmp_path / "brick.stl", box(60, 90, 180))
    with mesh_rig(tmp_path) as rig:
        rig.prepare(rig.object_ids(1)[0], 0)
        scene = rig.sim_state.scene
        lead = dataclasses.replace(scene.obj.material, name="lead", density_kg_m3=11340.0, friction=0.3)
        rig.sim_state.scene = dataclasses.replace(scene, obj=dataclasses.replace(scene.obj, material=lead))
        mass = (60 * 90 + 60 * 180 + 90 * 180) * 2 * 3 * 11340e-9  # a shell of 3 mm
        message = rf"too heavy to lift: {mass:.2f} kg of lead need {1.5 * mass * 9.81 / 0.6:.0f} N .* ends at 25 N"
        with pytest.raises(UngraspableError, match=message):
            rig.planner.plan(rig, None, SETTINGS, np.random.default_rng(0))


@pytest.fixture(scope="module")
def attempts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    saved(folder / "box.stl", box(60, 90, 180))
    with mesh_rig(folder, seed=2) as rig:
        runner, name, moves = AttemptRunner(rig, 2, rig.attempt), rig.object_ids(1)[0], []
        move = rig.arm._move_to
        rig.arm._move_to = lambda pose, speed: moves.append(pose) or move(pose, speed)
        results = []
        for number in range(8):
            moves.clear()
            results.append((runner.run(name, number), list(moves)))
        return results


def test_attempts_come_from_above_and_from_the_sides_and_most_hold(attempts):
    tilts = [len(attempt.fields["pose"]) == 5 for attempt, _ in attempts]
    assert 2 <= sum(tilts) <= 6
    assert sum(attempt.outcome == "held" for attempt, _ in attempts) >= 5


def test_a_tilted_hand_descends_next_to_the_object_moves_level_and_lifts_straight_up(attempts):
    held = [each for each in attempts if each[0].outcome == "held" and len(each[0].fields["pose"]) == 5]
    assert held
    for attempt, moves in held:
        pose = Pose(*attempt.fields["pose"])
        at = moves.index(pose)
        high, start, above = moves[at - 2], moves[at - 1], moves[at + 1]
        assert (high.x_mm, high.y_mm) == (start.x_mm, start.y_mm)
        assert high.z_mm > 400
        assert start.z_mm == pose.z_mm
        assert above == dataclasses.replace(pose, z_mm=above.z_mm)
        assert above.z_mm > pose.z_mm + 100
        ahead = -pose.rotation()[:, 2]
        way = np.subtract(pose.as_tuple()[:3], start.as_tuple()[:3])
        np.testing.assert_allclose(way / np.linalg.norm(way), ahead, atol=1e-3)
        assert moves[-1] == start


def test_a_mallet_is_grasped_from_the_end_of_its_handle_and_not_through_its_head(tmp_path):
    """At any rotation the hand comes from the free side; half a turn of the jaws swaps only the fingers."""
    head = box(120, 40, 80)
    head.apply_translation([0, 100, 0])
    saved(tmp_path / "mallet.stl", box(20, 160, 80) + head)
    with mesh_rig(tmp_path) as rig:
        name, approach_directions = rig.object_ids(1)[0], []
        for number in range(40):
            rig.prepare(name, number)
            plan = rig.planner.plan(rig, None, SETTINGS, np.random.default_rng(number))
            across_handle = plan.fit["width_mm"] < 30
            if plan.pose.tilt_rad and across_handle:
                approach_directions.append(-plan.pose.rotation()[:, 2] @ rig.sim_state.scene.placement.rotation())
    assert len(approach_directions) > 5
    np.testing.assert_allclose(np.array(approach_directions)[:, 1] > 0.95, True)


def three(folder):
    folder.mkdir()
    for name, mesh in (("a_box", box(40, 50, 70)), ("b_globe", ball(80, 2)), ("c_bar", box(30, 60, 50))):
        saved(folder / f"{name}.stl", mesh)
    return functools.partial(mesh_rig, folder, seed=1)


def files(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_collection_skips_and_names_ungraspable_objects_and_continues(tmp_path, monkeypatch):
    monkeypatch.setattr(resting, "_MAX_POSES", 1)
    make_rig, settings = three(tmp_path / "meshes"), CollectSettings(grasps=2)
    tallies = collect(make_rig, tmp_path / "r", objects=3, seed=1, settings=settings)
    assert [each.accepted for each in tallies] == [2, 0, 2]
    assert [each.attempts > 0 for each in tallies] == [True, False, True]
    globe = tallies[1].object_id
    recording = read_recording(tmp_path / "r")
    skipped = recording.info["skipped_objects"]
    assert list(skipped) == [globe]
    assert re.match(r"wider than the gripper opens: 1[45]\d mm .* 110 mm less 5 mm", skipped[globe])
    assert globe not in {grasp.object_id for grasp in recording.grasps}
    before = files(tmp_path / "r")
    again = collect(make_rig, tmp_path / "r", objects=3, seed=1, settings=settings)
    assert (again, files(tmp_path / "r")) == (tallies, before)


def test_a_file_chooses_the_planner_and_the_mesh_planner_needs_meshes(tmp_path):
    assert "tilt in radian" in three(tmp_path / "meshes")().info["units"]["pose"]
    assert type(load_rig("sim", seed=0, meshes=str(tmp_path / "meshes")).planner).__name__ == "MeshPlanner"
    (tmp_path / "rig.toml").write_text(f'rig = "sim"\nmeshes = "{tmp_path}/meshes"\n[planner]\nname = "cylinder"\n')
    assert type(load_rig(str(tmp_path / "rig.toml"), seed=0).planner).__name__ == "CylinderPlanner"
    (tmp_path / "rig.toml").write_text('rig = "sim"\n[planner]\nname = "mesh"\n')
    with pytest.raises(RobotConfigError, match=r'rig\.toml: \[planner\]: name = "mesh" plans for meshes'):
        load_rig(str(tmp_path / "rig.toml"), seed=0)
