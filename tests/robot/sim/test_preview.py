"""The contact sheet of a simulated recording shows its images."""

import cv2
import numpy as np
import pytest

from robot.collection import CollectSettings, collect
from robot.errors import RecordingError
from robot.recording.folder import RecordingWriter, read_recording
from robot.rig import load_rig
from robot.sim.preview import TILE_PX, write_preview


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    folder = tmp_path_factory.mktemp("collected") / "recording"
    collect(lambda: load_rig("sim", seed=3), folder, objects=2, seed=3, settings=CollectSettings(grasps=1))
    return folder


def test_a_row_for_each_object_and_a_tile_for_each_picture(collected, tmp_path):
    sheet = cv2.imread(str(write_preview(collected, tmp_path / "new" / "preview.png")))
    assert sheet.shape[1] == 8 * TILE_PX
    assert 2 * TILE_PX < sheet.shape[0] < 2 * (TILE_PX + 24) + 30


def test_the_photo_is_in_the_first_tile(collected, tmp_path):
    sheet = cv2.imread(str(write_preview(collected, tmp_path / "preview.png")))
    grasp = next(grasp for grasp in read_recording(collected).grasps if grasp.grasped)
    photo = cv2.imread(str(collected / grasp.photo))
    small = cv2.resize(photo, (TILE_PX - 4, TILE_PX - 4), interpolation=cv2.INTER_AREA)
    below_the_header = 24 + 2
    np.testing.assert_array_equal(sheet[below_the_header : below_the_header + TILE_PX - 4, 2 : TILE_PX - 2], small)


def test_walls_are_simulated_again_from_the_recording(collected):
    """The walls simulated from the recording are reproducible."""
    rig = load_rig("sim", seed=3)
    grasp = next(grasp for grasp in read_recording(collected).grasps if grasp.grasped)
    walls = rig.walls(grasp)
    assert set(walls) == {"a", "b"}
    assert all(wall.min() == 0 for wall in walls.values())
    assert rig.walls(grasp)["a"].shape == (120, 160)
    np.testing.assert_array_equal(rig.walls(grasp)["a"], walls["a"])


def test_a_recording_of_another_rig_is_refused_with_a_message(tmp_path):
    with RecordingWriter(tmp_path / "r", {"source": "hands", "sensor": "DIGIT", "rig": "bench"}):
        pass
    with pytest.raises(RecordingError, match="simulated rig"):
        write_preview(tmp_path / "r", tmp_path / "p.png")


def test_an_empty_recording_is_refused_with_a_message(tmp_path):
    with RecordingWriter(tmp_path / "r", {"source": "x", "sensor": "y", "rig": "sim", "seed": 0, "rig_settings": {}}):
        pass
    with pytest.raises(RecordingError, match="at least one grasp"):
        write_preview(tmp_path / "r", tmp_path / "p.png")
