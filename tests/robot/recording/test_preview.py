"""The contact sheet of a recording shows its images."""

import cv2
import numpy as np
import pytest

from robot.collection import CollectSettings, collect
from robot.errors import RecordingError
from robot.recording.folder import RecordingWriter, read_recording
from robot.recording.preview import TILE_PX, write_preview
from tests.fake_rig import FakeRig


def test_a_row_for_each_object_and_a_tile_for_each_picture_begins_with_the_photo(tmp_path):
    folder = tmp_path / "recording"
    collect(lambda: FakeRig(3), folder, objects=["round-0", "round-1"], seed=3, settings=CollectSettings(grasps=1))
    sheet = cv2.imread(str(write_preview(folder, tmp_path / "new" / "preview.png")))
    assert sheet.shape[1] == 6 * TILE_PX
    assert 2 * TILE_PX < sheet.shape[0] < 2 * (TILE_PX + 24) + 30
    photo = cv2.imread(str(folder / next(grasp for grasp in read_recording(folder).grasps if grasp.grasped).photo))
    small = cv2.resize(photo, (156, round(156 * photo.shape[0] / photo.shape[1])), interpolation=cv2.INTER_AREA)
    top = 24 + (TILE_PX - len(small)) // 2
    np.testing.assert_array_equal(sheet[top : top + len(small), 2 : TILE_PX - 2], small)


def test_an_empty_recording_is_refused_with_a_message(tmp_path):
    with RecordingWriter(tmp_path / "r", {"source": "x", "sensor": "y"}):
        pass
    with pytest.raises(RecordingError, match="at least one grasp"):
        write_preview(tmp_path / "r", tmp_path / "p.png")
