"""VisGel: which frame, which object; what holds of every importer stands in test_robot_importers."""

import pytest

from robot.importers.importing import SPLITS_FOLDER
from robot.importers.visgel import import_visgel
from tests.miniatures import visgel

pytestmark = pytest.mark.usefixtures("no_fsync")


@pytest.fixture
def source(tmp_path):
    visgel.write(tmp_path / "src")
    return tmp_path / "src"


def test_of_each_recording_the_frame_that_is_pressed_most_is_taken(source, tmp_path):
    """Frame 15 of 31 is among the 16 that are looked at, frames 1 + 29 k / 15 rounded: k = 7 gives 14.53."""
    recording = import_visgel(source, tmp_path / "out")
    assert [grasp.object_id for grasp in recording.grasps] == [
        "seen-1-rec_00000",
        "seen-1-rec_00001",
        "seen-12-rec_00000",
        "unseen-3-rec_00000",
    ]
    for grasp, (part, sitting, name) in zip(recording.grasps, visgel.RECORDINGS + visgel.UNSEEN, strict=True):
        root = source / f"data_{part}/images"
        where, frame = f"{sitting}/{name}", f"frame{visgel.PRESSED:04}.jpg"
        assert (tmp_path / "out" / grasp.touches["a"]).read_bytes() == (root / "touch" / where / frame).read_bytes()
        assert (tmp_path / "out" / grasp.photo).read_bytes() == (root / "vision" / where / frame).read_bytes()
        no_contact = root / "touch" / where / "frame0000.jpg"
        assert (tmp_path / "out" / grasp.touches_before["a"]).read_bytes() == no_contact.read_bytes()
        assert grasp.sequence_id == f"{part}-{sitting}"


@pytest.mark.parametrize("between", ["", "images", "a/b"])
def test_the_folders_between_are_found(tmp_path, between):
    visgel.write(tmp_path / "src", between)
    assert len(import_visgel(tmp_path / "src", tmp_path / "out").grasps) == visgel.GRASPS


def test_what_the_authors_held_out_is_the_test_part(source, tmp_path):
    import_visgel(source, tmp_path / "out")
    assert (tmp_path / "out" / SPLITS_FOLDER / "unseen.json").is_file()
    assert '"test": [\n  "unseen-3-rec_00000"\n ]' in (tmp_path / "out" / SPLITS_FOLDER / "unseen.json").read_text()


def test_a_copy_of_the_seen_part_alone_has_no_split(source, tmp_path):
    (source / "data_unseen").rename(tmp_path / "elsewhere")
    assert len(import_visgel(source, tmp_path / "out").grasps) == 3
    assert not (tmp_path / "out" / SPLITS_FOLDER).exists()


def test_a_pressed_frame_that_cannot_be_read_gives_way_to_another(source, tmp_path):
    (source / f"data_seen/images/touch/1/rec_00000/frame{visgel.PRESSED:04}.jpg").write_bytes(b"broken")
    recording = import_visgel(source, tmp_path / "out")
    assert len(recording.grasps) == visgel.GRASPS


def test_a_recording_of_one_frame_is_skipped(source, tmp_path):
    folder = source / "data_seen/images/touch/12/rec_00000"
    for frame in sorted(folder.iterdir())[1:]:
        frame.unlink()
    recording = import_visgel(source, tmp_path / "out")
    assert recording.info["skipped"] == {"it has no two frames": 1}
