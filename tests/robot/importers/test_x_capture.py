"""Importer of X-Capture; test_importers.py tests the common behaviour."""

import cv2
import numpy as np
import pytest

from robot.importers.x_capture import import_x_capture
from tests.miniatures import picture, x_capture

pytestmark = pytest.mark.usefixtures("no_fsync")


@pytest.fixture
def source(tmp_path):
    x_capture.write(tmp_path / "src")
    return tmp_path / "src"


def test_a_point_is_a_grasp_of_its_object_with_the_force_from_its_file_name(source, tmp_path):
    recording = import_x_capture(source, tmp_path / "out")
    first = recording.grasps[0]
    assert (first.grasp_id, first.object_id, first.sequence_id) == ("00071-000-10N", "00071", "00071")
    assert first.force_n == 10.0
    assert (recording.folder / first.photo).read_bytes() == (source / "00071/000/000_rgb.png").read_bytes()
    touch = (source / "00071/000/000_10N_tactile.png").read_bytes()
    assert (recording.folder / first.touches["a"]).read_bytes() == touch


def test_depth_is_imported_if_it_is_a_16_bit_picture(source, tmp_path):
    picture(source / "00071/001/001_depth.png", 3)
    (source / "00071/002/002_depth.png").write_bytes(b"nothing")
    by_id = {grasp.grasp_id: grasp for grasp in import_x_capture(source, tmp_path / "out").grasps}
    depth = cv2.imread(str(tmp_path / "out" / by_id["00071-000-10N"].depth), cv2.IMREAD_UNCHANGED)
    assert (depth.dtype, depth[0, 0]) == (np.uint16, 400)
    assert by_id["00071-001-10N"].depth is None
    assert by_id["00071-002-10N"].depth is None


def test_a_touch_without_its_photo_is_skipped_and_counted(source, tmp_path):
    recording = import_x_capture(source, tmp_path / "out")
    assert recording.info["skipped"] == {"its photo is missing": 1}
    assert any("not run on the real data" in note for note in recording.notes)


def test_touches_of_two_forces_at_a_point_are_two_grasps(source, tmp_path):
    picture(source / "00071/000/000_15N_tactile.png", 77, (24, 18))
    recording = import_x_capture(source, tmp_path / "out")
    forces = [grasp.force_n for grasp in recording.grasps if grasp.grasp_id.startswith("00071-000-")]
    assert forces == [10.0, 15.0]
