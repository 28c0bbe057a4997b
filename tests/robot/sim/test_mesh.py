"""Meshes: valid files, refused files with the reason, and casting against closed forms."""

import builtins
import functools
import sys

import numpy as np
import pytest

from robot.collection import CollectSettings, collect
from robot.errors import RecordingError, RobotConfigError, SceneError
from robot.rig import load_rig
from robot.sim.objects.mesh import Mesh, MeshBody
from robot.sim.objects.relief import Relief
from robot.sim.objects.resting import UP
from tests.meshes import ball, box, load_mesh_object, saved, solid

CUBE = box(40, 40, 40)


@pytest.fixture
def globe(tmp_path):
    return load_mesh_object(saved(tmp_path / "ball.stl", ball(30)), 0, relief="smooth")


@pytest.mark.parametrize("name", ["cube.stl", "cube.obj", "cube.PLY"])
def test_a_cube_stands_on_the_table_in_every_format(tmp_path, name):
    moved = solid(CUBE.vertices + np.array([100, 5, -3]), CUBE.faces)
    item = load_mesh_object(saved(tmp_path / name, moved), 0, relief="smooth")
    np.testing.assert_allclose([item.body.lower, item.body.upper], [[-20, -20, 0], [20, 20, 40]], atol=1e-4)
    assert item.body.mesh.solid.volume == pytest.approx(64000)
    assert item.object_id == "mesh.cube-smooth-0000"
    assert len(item.body.mesh.vertices) == 8


@pytest.mark.parametrize(("scale", "faces"), [(0.001, CUBE.faces), (1, CUBE.faces[:, ::-1])])
def test_small_numbers_are_metres_and_inward_faces_are_turned(tmp_path, scale, faces):
    path = saved(tmp_path / "cube.obj", solid(scale * CUBE.vertices, faces))
    assert load_mesh_object(path, 0).body.mesh.solid.volume == pytest.approx(64000)


def test_only_geometry_is_read(tmp_path, monkeypatch):
    path = saved(tmp_path / "cube.obj", CUBE)
    path.write_text("mtllib cube.mtl\nusemtl paint\n" + path.read_text())
    (tmp_path / "cube.mtl").write_text("newmtl paint\nmap_Kd secret.png\n")
    opened, real = [], builtins.open
    monkeypatch.setattr(builtins, "open", lambda *a, **k: opened.append(str(a[0])) or real(*a, **k))
    load_mesh_object(path, 0, relief="smooth")
    assert not [name for name in opened if name.endswith((".mtl", ".png"))]


FIRST = np.arange(12)[:, None] == 0


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (CUBE.vertices, CUBE.faces[:-1], "3 edges border a hole.*fill_holes"),
        (np.where(np.arange(8)[:, None] == 3, np.nan, CUBE.vertices), CUBE.faces, "NaN or infinite"),
        (CUBE.vertices * [1, 1, 0], CUBE.faces, "at least 2 mm thick"),
        (CUBE.vertices, np.where(FIRST, CUBE.faces[:, ::-1], CUBE.faces), "turned outwards.*fix_normals"),
        (CUBE.vertices, [[0, 0, 1]], "no triangles with an area"),
    ],
)
def test_a_surface_that_is_not_a_closed_solid_is_refused(tmp_path, vertices, faces, message):
    with pytest.raises(SceneError, match=message):
        load_mesh_object(saved(tmp_path / "bad.ply", solid(vertices, faces)), 0)


@pytest.mark.parametrize("name", ["bad.stl", "bad.obj", "bad.ply"])
def test_broken_and_truncated_files_are_one_clear_error(tmp_path, name):
    whole = saved(tmp_path / "ball.stl", ball(30, 2)).read_bytes()
    broken = [b"", b"\x00" * 84, b"nonsense", b"ply\nformat ascii 1.0\nelement vertex 9", b"v 1 2 x\n"]
    for content in [*broken, *(whole[:length] for length in range(0, len(whole) - 1, 1971))]:
        (tmp_path / name).write_bytes(content)
        with pytest.raises(SceneError, match=name):
            load_mesh_object(tmp_path / name, 0)


@pytest.mark.parametrize("package", ["trimesh", "embreex"])
def test_the_message_for_a_missing_package_names_the_extra(tmp_path, monkeypatch, package):
    path = saved(tmp_path / "cube.obj", CUBE)
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "trimesh.ray.ray_pyembree", raising=False)
    with pytest.raises(SceneError, match=rf"{package}.*pip install 'touch-retrieval\[mesh\]'"):
        load_mesh_object(path, 0)


def test_rays_meet_a_ball_at_the_root_of_the_quadratic(globe):
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = rng.uniform(globe.body.lower, globe.body.upper, (2000, 3)) - 200 * directions
    offset = origins - [0, 0, 30]
    half = np.einsum("ij,ij->i", offset, directions)
    root = half**2 - np.einsum("ij,ij->i", offset, offset) + 900
    found = globe.body.cast(origins, directions)
    # Facets of 4 degrees lie up to 30 (1 - cos 2 deg) = 0.02 mm inside the ball, deeper across their diagonals.
    clear = root > 50
    np.testing.assert_allclose(found[clear], (-half - np.sqrt(np.maximum(root, 0)))[clear], atol=0.15)
    assert np.isinf(found[root < -1]).all()
    points = (origins + np.where(np.isfinite(found), found, 0)[:, None] * directions)[np.isfinite(found)]
    radial = (points - [0, 0, 30]) / 30
    np.testing.assert_allclose(globe.body.normals(points), radial, atol=0.03)


def test_a_coarse_scan_of_a_ball_feels_as_round_as_it_looks(tmp_path):
    body = load_mesh_object(saved(tmp_path / "coarse.stl", ball(30, subdivisions=2)), 0, relief="smooth").body
    outwards = np.random.default_rng(0).standard_normal((2000, 3)) * [1, 1, 0.5]
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    origins = body.mesh.vertices.mean(axis=0) + 60 * outwards
    _, flat = body.first_faces(origins, -outwards)
    assert np.abs(flat - 30).max() > 0.35  # facets of 18 degrees
    np.testing.assert_allclose(body.cast(origins, -outwards), 30, atol=0.05)


def test_a_cube_keeps_its_edges_and_faces(tmp_path):
    body = load_mesh_object(saved(tmp_path / "cube.obj", CUBE), 0, relief="smooth").body
    x = np.array([-19.9, -3.0, 19.9, 20.1])
    origins = np.stack([x, np.full(4, -50.0), np.full(4, 20.0)], axis=1)
    found = body.cast(origins, np.tile([0.0, 1, 0], (4, 1)))
    np.testing.assert_allclose(found, [30, 30, 30, np.inf], atol=1e-5)
    np.testing.assert_allclose(body.normals(origins[:3] * [1, 0.4, 1]), np.tile([0, -1, 0], (3, 1)), atol=1e-6)
    below = body.cast(np.array([[0.0, 0, -5]]), np.array([[0.0, 0, 1]]))
    np.testing.assert_allclose(below, 5, atol=1e-5)
    assert body.cast(np.array([[0.0, 0, 20]]), np.array([[1.0, 0, 0]])) == 0


def test_relief_moves_hits_by_its_height_and_tilts_normals(tmp_path):
    path = saved(tmp_path / "ball.stl", ball(30))
    textured = load_mesh_object(path, 1, relief="ribs").body
    smooth = load_mesh_object(path, 1, relief="smooth").body
    z = np.linspace(24, 36, 300)
    x = np.linspace(-6, 6, 300)
    origins = np.concatenate([np.stack([0 * z, 0 * z - 60, z], 1), np.stack([x, 0 * x - 60, 0 * x + 30], 1)])
    directions = np.tile([0.0, 1, 0], (600, 1))
    lift = smooth.cast(origins, directions) - textured.cast(origins, directions)
    amplitude = textured.relief.amplitude_mm
    low, high = (-amplitude, 0) if textured.relief.engraved else (0, amplitude)
    assert low - 0.1 <= lift.min()
    assert lift.max() <= high + 0.1 * amplitude + 0.05
    assert np.ptp(lift) > 0.6 * amplitude
    points = origins + textured.cast(origins, directions)[:, None] * directions
    assert np.abs(textured.normals(points) - smooth.normals(points)).max() > 0.1


def test_relief_keeps_its_pitch_and_height_along_the_side_of_a_long_box():
    long_box = box(200, 24, 40)
    body = MeshBody(Mesh(long_box.vertices, long_box.faces).rest_on_table(UP), Relief("ribs", 1.0, 5.0))
    x = np.arange(-95, 95, 0.1)
    origins = np.stack([x, 0 * x - 60, 0 * x + 20], axis=1)
    height = 60 - 12 - body.cast(origins, np.tile([0.0, 1, 0], (len(x), 1)))
    crests = 1 + np.flatnonzero((height[1:-1] > height[:-2]) & (height[1:-1] >= height[2:]) & (height[1:-1] > 0.5))
    np.testing.assert_allclose(np.diff(x[crests]), 5.0, atol=0.25)
    assert len(crests) == 39
    np.testing.assert_allclose(height[crests], 1.0, atol=0.05)


def test_the_mass_is_that_of_the_volume_or_of_a_shell(globe):
    whole, shell = (volume * globe.material.density_kg_m3 for volume in (4 / 3 * np.pi * 0.03**3, 4 * np.pi * 2.7e-6))
    assert globe.mass_kg == pytest.approx(whole if whole <= 0.6 else shell, rel=0.01)


def test_hidden_files_are_not_meshes_and_two_meshes_of_one_name_are_refused(tmp_path):
    saved(tmp_path / "cube.stl", CUBE)
    (tmp_path / "._cube.stl").write_bytes(b"Mac OS X")
    names = load_rig("sim", seed=0, meshes=str(tmp_path)).object_ids(1)
    assert [name.split("-")[0] for name in names] == ["mesh.cube"]
    saved(tmp_path / "cube.STL", box(50, 50, 50))
    with pytest.raises(
        RobotConfigError, match=r"must not contain two meshes of one name, got 'mesh\.cube-.*\. Rename one"
    ):
        load_rig("sim", seed=0, meshes=str(tmp_path)).object_ids(2)


def test_a_rig_of_meshes_grasps_them_and_continues_only_with_the_same_files(tmp_path):
    folder, make_rig = tmp_path / "meshes", functools.partial(load_rig, "sim", seed=0, meshes=str(tmp_path / "meshes"))
    folder.mkdir()
    for name, size in (("cube", 40), ("larger", 50)):
        saved(folder / f"{name}.stl", box(size, size, size))
    settings = CollectSettings(grasps=1)
    tallies = collect(make_rig, tmp_path / "recording", objects=2, seed=0, settings=settings)
    assert [tally.object_id.split("-")[0] for tally in tallies] == ["mesh.cube", "mesh.larger"]
    assert sum(tally.attempts for tally in tallies) > 0
    with pytest.raises(RobotConfigError, match="must contain at least 3 STL, OBJ or PLY"):
        make_rig().object_ids(3)
    saved(folder / "larger.stl", box(60, 60, 60))
    with pytest.raises(RecordingError, match="meshes sha256"):
        collect(make_rig, tmp_path / "recording", objects=2, seed=0, settings=settings)
