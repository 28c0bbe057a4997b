"""Importer of PhysiCLeAR; test_importers.py tests the common behaviour."""

import cv2
import numpy as np
import pytest

from robot.errors import ImporterError
from robot.importers.physiclear import import_physiclear
from robot.importers.press_videos import strongest_frames
from tests.miniatures import physiclear


def test_a_video_is_a_sequence_of_five_frames_of_its_part_without_photos(source, tmp_path):
    """Each video has its own no-contact frame; every frame is stored once."""
    recording = import_physiclear(source, tmp_path / "out")
    found = [(grasp.grasp_id, grasp.object_id, grasp.sequence_id) for grasp in recording.grasps]
    assert found[:6] == [(f"apple_0-{place}", "apple", "apple_0") for place in range(1, 6)] + [
        ("apple_1-1", "apple", "apple_1")
    ]
    assert {name for _, name, _ in found} == set(physiclear.PARTS)
    assert {(grasp.photo, grasp.session) for grasp in recording.grasps} == {(None, None)}
    assert any("no photos" in note for note in recording.notes)
    before = {grasp.sequence_id: grasp.touches_before["a"] for grasp in recording.grasps}
    assert len(set(before.values())) == len(before) == 6
    assert all(grasp.touches_before["a"] == before[grasp.sequence_id] for grasp in recording.grasps)
    assert len(list((recording.folder / "images").iterdir())) == physiclear.GRASPS + 6
    frames = [cv2.imread(str(recording.folder / before[name])).astype(float) for name in ("apple_0", "usb_3_plug_0")]
    assert np.median(frames[1] - frames[0]) == pytest.approx(8, abs=2)


def test_the_frames_of_strongest_contact_are_in_order_of_time_and_the_first_frame_is_the_no_contact_frame(tmp_path):
    """Contact rises to frame 6 of 12 and falls: frames 4 to 8 differ most from frame 0."""
    physiclear.write_video(tmp_path / "pen_0.mov", physiclear.presses(0, 0))
    no_contact, *strongest = strongest_frames(tmp_path / "pen_0.mov", 5)
    frames = physiclear.presses(0, 0)
    for place, frame in enumerate((4, 5, 6, 7, 8)):
        assert np.abs(strongest[place].astype(float) - frames[frame]).mean() < 3  # the codec's loss
    assert np.abs(no_contact.astype(float) - frames[0]).mean() < 3


def test_the_length_of_a_video_gives_its_session(tmp_path):
    for number, length in enumerate((50, 126, 80)):
        physiclear.write_video(tmp_path / "src" / f"pen_{number}.mov", physiclear.presses(0, 0, length))
    recording = import_physiclear(tmp_path / "src", tmp_path / "out", frames=1)
    assert [grasp.session for grasp in recording.grasps] == ["50-frames", "126-frames", None]


def test_the_folder_of_the_repository_is_found_and_an_option_sets_the_number_of_frames(source, tmp_path):
    (tmp_path / "clone").mkdir()
    source.rename(tmp_path / "clone" / "dataset")
    recording = import_physiclear(tmp_path / "clone", tmp_path / "out", frames=2)
    assert len(recording.grasps) == 2 * 6
    with pytest.raises(ImporterError, match="frames must be a whole number >= 1, got 0"):
        import_physiclear(tmp_path / "clone", tmp_path / "out2", frames=0)


def test_a_video_too_short_or_without_change_costs_its_own_grasps(source, tmp_path):
    physiclear.write_video(source / "apple_0.mov", physiclear.presses(0, 0)[:4])
    physiclear.write_video(source / "apple_1.mov", [np.full((48, 64, 3), 90, np.uint8)] * 8)
    recording = import_physiclear(source, tmp_path / "out")
    assert recording.info["skipped"] == {
        "its video must have at least 5 frames that differ from the first one": 10,
    }
