"""Importer of Touch and Go; test_importers.py tests the common behaviour."""

import json
import tracemalloc
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.errors import ImporterError
from robot.importers.touch_and_go import _runs, import_touch_and_go
from tests.miniatures import touch_and_go

pytestmark = pytest.mark.usefixtures("no_fsync")
FIRST, SECOND, THIRD = touch_and_go.VIDEOS


@pytest.fixture
def source(tmp_path):
    touch_and_go.write(tmp_path / "src")
    return tmp_path / "src"


def test_an_unbroken_run_of_contact_with_one_material_is_an_object_and_its_video_the_sequence(source, tmp_path):
    recording = import_touch_and_go(source, tmp_path / "out")
    objects = {grasp.object_id: grasp.sequence_id for grasp in recording.grasps}
    assert objects == {f"{video}-{first:010d}": video for video in touch_and_go.VIDEOS for first in (2, 10)}
    assert recording.info["objects"][f"{FIRST}-0000000002"] == {"label": 3, "material": "Wood", "sequence": FIRST}
    assert recording.info["objects"][f"{FIRST}-0000000010"]["material"] == "Plastic"


def test_frames_of_a_run_are_evenly_spread_and_0_imports_all(source, tmp_path):
    def frames(recording):
        return [int(grasp.grasp_id[-10:]) for grasp in recording.grasps if grasp.object_id == f"{FIRST}-0000000002"]

    assert frames(import_touch_and_go(source, tmp_path / "two", frames=2)) == [3, 6]  # of 2 3 4 5 6 7
    assert frames(import_touch_and_go(source, tmp_path / "one", frames=1)) == [4]
    assert frames(import_touch_and_go(source, tmp_path / "all", frames=0)) == [2, 3, 4, 5, 6, 7]


def test_a_negative_number_of_frames_is_refused(source, tmp_path):
    with pytest.raises(ImporterError, match="frames must be at least 1, or 0 for all, got -1"):
        import_touch_and_go(source, tmp_path / "out", frames=-1)


def test_photo_and_touch_are_of_one_moment_and_the_no_contact_frame_is_not_in_label_txt(source, tmp_path):
    recording = import_touch_and_go(source, tmp_path / "out")
    grasp = next(grasp for grasp in recording.grasps if grasp.grasp_id == f"{SECOND}-0000000011")
    video = source / "dataset" / SECOND
    for path, file in (
        (grasp.photo, "video_frame/0000000011.jpg"),
        (grasp.touches["a"], "gelsight_frame/0000000011.jpg"),
        (grasp.touches_before["a"], "gelsight_frame/0000000000.jpg"),
    ):
        assert (recording.folder / path).read_bytes() == (video / file).read_bytes()


def test_a_video_that_begins_in_contact_has_a_later_no_contact_frame(source, tmp_path):
    lines = [f"{FIRST}/{frame:010d}.jpg,3" for frame in range(3)] + [f"{FIRST}/0000000003.jpg,1"]
    (source / "label.txt").write_text("\n".join(lines))
    recording = import_touch_and_go(source, tmp_path / "out")
    no_contact = (source / "dataset" / FIRST / "gelsight_frame" / "0000000004.jpg").read_bytes()
    assert (recording.folder / recording.grasps[0].touches_before["a"]).read_bytes() == no_contact


def test_negative_labels_and_lines_of_another_form_are_counted(source, tmp_path):
    with open(source / "label.txt", "a") as file:
        file.write("\nsomething else\n../../etc/0000000001.jpg,3\n")
    recording = import_touch_and_go(source, tmp_path / "out")
    assert recording.info["skipped"] == {
        "its label is negative": 1,
        "a line of label.txt is not <sequence>/<frame>.jpg,<label>": 2,
    }


def test_the_published_split_is_stored_if_it_divides_whole_videos(source, tmp_path):
    import_touch_and_go(source, tmp_path / "out")
    split = json.loads((tmp_path / "out/splits/published.json").read_text())
    assert split["test"] == [f"{THIRD}-0000000002", f"{THIRD}-0000000010"]
    assert len(split["train"]) == 4


def test_a_split_of_frames_gets_a_leak_note_and_is_replaced_by_one_of_whole_videos(source, tmp_path):
    """9 of 18 test lines belong to a video in the test part only, 9 to a video in both files."""
    train, test = (source / f"{part}.txt" for part in ("train", "test"))
    test.write_text(test.read_text() + "\n" + "\n".join(train.read_text().split("\n")[9:]))
    recording = import_touch_and_go(source, tmp_path / "out")
    (leak,) = [note for note in recording.info["notes"] if note.startswith("LEAK")]
    assert "has 1 of 3 sequences in two parts, and 50% of its test rows are frames" in leak
    assert not (tmp_path / "out/splits/published.json").exists()
    whole = json.loads((tmp_path / "out/splits/published-whole.json").read_text())
    assert {name.rpartition("-")[0] for name in whole["test"]} == {THIRD}
    assert {name.rpartition("-")[0] for name in whole["train"]} == {FIRST, SECOND}


def test_an_error_tells_how_to_extract_frames(source, tmp_path):
    (source / "dataset" / FIRST / "gelsight_frame").rename(source / "elsewhere")
    with pytest.raises(ImporterError, match=r"has no gelsight_frame/; run the authors' extract_frame\.py first"):
        import_touch_and_go(source, tmp_path / "out")


@given(st.text(alphabet="0123456789_/.jpg,- \n", max_size=200))
def test_lines_of_any_text_become_runs_or_skips(text):
    with TemporaryDirectory() as folder:
        (Path(folder) / "label.txt").write_text(text)
        runs, skipped = _runs(Path(folder) / "label.txt")
    assert len(skipped) <= text.count("\n") + 1
    assert all(run.first <= run.last and run.label >= 0 and "/" not in run.sequence for run in runs)


@pytest.mark.slow
def test_memory_for_100000_labels_grows_with_their_runs_only(tmp_path):
    with open(tmp_path / "label.txt", "w") as file:
        file.writelines(f"20220601_{number // 5000:06d}/{number % 5000:010d}.jpg,3\n" for number in range(100_000))
    tracemalloc.start()
    try:
        runs, _ = _runs(tmp_path / "label.txt")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(runs) == 20
    assert peak < 500_000  # the file has 3.9 MB
