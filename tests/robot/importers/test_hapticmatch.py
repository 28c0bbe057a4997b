"""Importer of HapticMatch; test_importers.py tests the common behaviour."""

import pickle

import cv2
import numpy as np
import pytest

from robot.errors import ImporterError
from robot.importers.hapticmatch import import_hapticmatch, normals
from tests.miniatures import hapticmatch

pytestmark = pytest.mark.usefixtures("no_fsync")


@pytest.fixture
def source(tmp_path):
    hapticmatch.write(tmp_path / "src")
    return tmp_path / "src"


class Trap:
    """An object that creates a file if it is unpickled."""

    def __reduce__(self):
        return open, ("unpickled", "w")


def test_a_material_is_an_object_and_its_samples_come_in_the_order_of_their_numbers(source, tmp_path):
    recording = import_hapticmatch(source, tmp_path / "out")
    denim = [grasp for grasp in recording.grasps if grasp.object_id == "Denim"]
    assert [grasp.grasp_id for grasp in denim] == ["Denim-1", "Denim-2", "Denim-9", "Denim-10"]
    assert {grasp.sequence_id for grasp in denim} == {"Denim"}
    assert (recording.folder / denim[0].photo).read_bytes() == (source / "Texture/Denim/1.jpg").read_bytes()


def test_the_touch_is_the_picture_of_the_normals_of_its_own_height_map(source, tmp_path):
    recording = import_hapticmatch(source, tmp_path / "out")
    (grasp,) = (grasp for grasp in recording.grasps if grasp.grasp_id == "Denim-2")
    stored = cv2.imread(str(recording.folder / grasp.touches["a"]))[..., ::-1]
    np.testing.assert_array_equal(stored, normals(hapticmatch.heights(102)))


def test_the_normal_of_a_plane_with_slope_1_has_45_degrees():
    """The normal is (-1, 0, 1) / sqrt(2): 127.5 (1 - 0.7071) = 37.3, 127.5, 127.5 (1 + 0.7071) = 217.7."""
    plane = np.tile(np.arange(6.0), (5, 1))
    assert (normals(plane) == (37, 128, 218)).all()
    assert (normals(plane.T)[..., 1] == 37).all()
    assert (normals(np.zeros((4, 4))) == (128, 128, 255)).all()
    np.testing.assert_array_equal(normals(3 * plane), normals(plane, scale=3.0))


@pytest.mark.parametrize(
    "heights",
    [
        np.zeros(5),
        np.zeros((1, 5)),
        np.zeros((2, 5000)),
        np.full((4, 4), np.nan),
        np.full((4, 4), np.inf),
        np.zeros((4, 4), bool),
    ],
)
def test_an_array_that_is_not_a_height_map_is_refused(heights):
    with pytest.raises(ImporterError, match="its height map must"):
        normals(heights)


def test_heights_of_any_size_make_a_picture():
    assert normals(np.array([[0, 1e308], [-1e308, 0]])).shape == (2, 2, 3)
    assert normals(np.array([[0, 65535], [0, 65535]], np.uint16))[0, 0, 0] == 0


def test_a_program_in_a_height_map_does_not_run_and_costs_its_own_grasp(source, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (source / "Texture/Denim/1.pkl").write_bytes(pickle.dumps(Trap()))
    recording = import_hapticmatch(source, tmp_path / "out")
    assert len(recording.grasps) == hapticmatch.GRASPS - 1
    assert not (tmp_path / "unpickled").exists()
    assert any("Denim-1" in note and "it refers to" in note for note in recording.notes)


def test_an_infinite_or_negative_scale_is_refused(source, tmp_path):
    for scale in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ImporterError, match="scale must be above 0"):
            import_hapticmatch(source, tmp_path / "out", scale=scale)
