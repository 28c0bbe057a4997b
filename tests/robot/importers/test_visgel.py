"""Importer of VisGel: choice of frame and object; test_importers.py tests the common behaviour."""

import pytest

from robot.importers.importing import SPLITS_FOLDER
from robot.importers.visgel import import_visgel
from tests.miniatures import visgel

pytestmark = pytest.mark.usefixtures("no_fsync")


@pytest.fixture
def source(tmp_path):
    visgel.write(tmp_path / "src")
    return tmp_path / "src"


def test_the_frame_of_strongest_contact_is_the_touch(source, tmp_path):
    """Frame 15 of 31 is among the 16 compared frames, 1 + 29 k / 15 rounded: k = 7 gives 14.53."""
    recording = import_visgel(source, tmp_path / "out")
    assert [grasp.object_id for grasp in recording.grasps] == [
        "seen-1-rec_00000",
        "seen-1-rec_00001",
        "seen-12-rec_00000",
        "unseen-3-rec_00000",
    ]
    for grasp, (part, session, name) in zip(recording.grasps, visgel.RECORDINGS + visgel.UNSEEN, strict=True):
        root = source / f"data_{part}/images"
        path, frame = f"{session}/{name}", f"frame{visgel.PRESSED:04}.jpg"
        assert (tmp_path / "out" / grasp.touches["a"]).read_bytes() == (root / "touch" / path / frame).read_bytes()
        assert (tmp_path / "out" / grasp.photo).read_bytes() == (root / "vision" / path / frame).read_bytes()
        no_contact = root / "touch" / path / "frame0000.jpg"
        assert (tmp_path / "out" / grasp.touches_before["a"]).read_bytes() == no_contact.read_bytes()
        assert grasp.sequence_id == f"{part}-{session}"


@pytest.mark.parametrize("between", ["", "images", "a/b"])
def test_folders_in_between_are_searched(tmp_path, between):
    visgel.write(tmp_path / "src", between)
    assert len(import_visgel(tmp_path / "src", tmp_path / "out").grasps) == visgel.GRASPS


def test_what_the_authors_held_out_is_the_test_part(source, tmp_path):
    import_visgel(source, tmp_path / "out")
    assert (tmp_path / "out" / SPLITS_FOLDER / "unseen.json").is_file()
    assert '"test": [\n  "unseen-3-rec_00000"\n ]' in (tmp_path / "out" / SPLITS_FOLDER / "unseen.json").read_text()


def test_a_copy_without_the_unseen_part_has_no_split(source, tmp_path):
    (source / "data_unseen").rename(tmp_path / "elsewhere")
    assert len(import_visgel(source, tmp_path / "out").grasps) == 3
    assert not (tmp_path / "out" / SPLITS_FOLDER).exists()


def test_an_unreadable_frame_is_replaced_by_another(source, tmp_path):
    (source / f"data_seen/images/touch/1/rec_00000/frame{visgel.PRESSED:04}.jpg").write_bytes(b"broken")
    recording = import_visgel(source, tmp_path / "out")
    assert len(recording.grasps) == visgel.GRASPS


def test_a_recording_of_one_frame_is_skipped(source, tmp_path):
    folder = source / "data_seen/images/touch/12/rec_00000"
    for frame in sorted(folder.iterdir())[1:]:
        frame.unlink()
    recording = import_visgel(source, tmp_path / "out")
    assert recording.info["skipped"] == {"it has fewer than two frames": 1}
