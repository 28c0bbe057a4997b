"""Importer of YCB-Slide; test_importers.py tests the common behaviour."""

import builtins

import pytest

from robot.errors import ImporterError
from robot.importers.ycb_slide import import_ycb_slide
from tests.miniatures import picture, ycb_slide

pytestmark = pytest.mark.usefixtures("no_fsync")


@pytest.fixture
def source(tmp_path):
    ycb_slide.write(tmp_path / "src")
    return tmp_path / "src"


def test_one_frame_per_second_is_imported_with_the_webcam_frame_of_its_number(source, tmp_path):
    recording = import_ycb_slide(source, tmp_path / "out")
    assert [grasp.grasp_id for grasp in recording.grasps][:3] == [
        f"004_sugar_box-dataset_0-frame_{number:07}" for number in (0, 30, 60)
    ]
    assert recording.grasps[0].sequence_id == "004_sugar_box-dataset_0"
    photo = source / "real/004_sugar_box/dataset_0/webcam_frames/frame_0000030.jpg"
    assert (tmp_path / "out" / recording.grasps[1].photo).read_bytes() == photo.read_bytes()


def test_every_sets_the_number_of_frames(source, tmp_path):
    assert len(import_ycb_slide(source, tmp_path / "out", every=1).grasps) == 4 * 61
    with pytest.raises(ImporterError, match="at least 1, got 0"):
        import_ycb_slide(source, tmp_path / "other", every=0)


def test_the_folder_real_itself_can_be_imported(source, tmp_path):
    assert len(import_ycb_slide(source / "real", tmp_path / "out").grasps) == ycb_slide.GRASPS


def test_pickled_tables_are_never_opened(source, tmp_path, monkeypatch):
    def checked_open(path, *arguments, **options):
        assert not str(path).endswith(".npy")
        return original_open(path, *arguments, **options)

    original_open = builtins.open
    monkeypatch.setattr(builtins, "open", checked_open)
    import_ycb_slide(source, tmp_path / "out")


def test_frames_without_a_webcam_frame_are_skipped(source, tmp_path):
    (source / "real/004_sugar_box/dataset_1/webcam_frames/frame_0000060.jpg").unlink()
    recording = import_ycb_slide(source, tmp_path / "out")
    assert recording.info["skipped"] == {"its photo is missing": 1}


def test_simulated_logs_are_refused(tmp_path):
    picture(tmp_path / "src/sim/004_sugar_box/00/tactile_images/0.jpg", 1)
    with pytest.raises(ImporterError, match="simulated logs have no photos"):
        import_ycb_slide(tmp_path / "src", tmp_path / "out")
