"""Checks of a recording: each fault gives its finding, and a clean recording gives none."""

import json
import shutil

import pytest

from retrieval.data.check.recording import check_recording, check_split
from retrieval.data.dataset import Split, load_grasps, make_split
from retrieval.errors import DatasetError
from tests import synthetic


def remarks(folder, split=None):
    """Return the findings without notes."""
    return [finding for finding in check_recording(folder, split) if finding.severity != "note"]


class Broken:
    """A copy of a recording that a test breaks."""

    def __init__(self, recording, folder):
        self.folder = folder
        shutil.copytree(recording, folder)

    @property
    def rows(self):
        return [json.loads(line) for line in (self.folder / "metadata.jsonl").read_text().splitlines()]

    @rows.setter
    def rows(self, rows):
        (self.folder / "metadata.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))

    def change(self, numbers, change):
        """Apply `change` to the lines of these numbers."""
        rows = self.rows
        for number in numbers:
            change(rows[number])
        self.rows = rows

    def file(self, number, column):
        return self.folder / self.rows[number][f"{column}_file_name"]

    def names(self, numbers):
        """Return the grasp ids of these lines."""
        return tuple(self.rows[number]["grasp_id"] for number in numbers)

    def findings(self, split=None):
        return remarks(self.folder, split)


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """8 objects, 3 grasps each, with a photo and two gel images: 72 pictures."""
    folder = tmp_path_factory.mktemp("clean") / "recording"
    return synthetic.write_recording(folder, synthetic.make_objects(8), 3, before=False)


@pytest.fixture
def broken(clean, tmp_path):
    return Broken(clean, tmp_path / "r")


def swap_photo_and_touch(row):
    row["photo_file_name"], row["touch_a_file_name"] = row["touch_a_file_name"], row["photo_file_name"]


def one(findings):
    (finding,) = findings
    return finding.severity, finding.kind, finding.message


def good_split(folder):
    return make_split(load_grasps(folder), validation=0.25, test=0.2, seed=0)


# Clean -----------------------------------------------------------------------------------------------------


def test_a_clean_recording_and_a_drawn_split_have_no_finding(recording):
    assert remarks(recording, good_split(recording)) == []


@pytest.mark.parametrize(("seed", "fingers"), [(1, "a"), (2, "ab")])
def test_other_clean_recordings_have_no_finding(tmp_path, seed, fingers):
    objects = synthetic.make_objects(6, seed=seed)
    folder = synthetic.write_recording(tmp_path / "r", objects, 2, seed=seed, fingers=fingers, before=False, misses=1)
    assert remarks(folder) == []


def test_a_folder_that_is_not_a_recording_is_an_error(tmp_path):
    with pytest.raises(DatasetError, match=r"recording\.json"):
        check_recording(tmp_path)


def test_progress_goes_to_stderr(recording, capsys):
    check_recording(recording)
    out, err = capsys.readouterr()
    assert out == ""
    assert "check: 180/180 images" in err  # 12 objects, 3 grasps; a photo, two touches, two no-contact frames


# Files -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("column", ["photo", "touch_a", "touch_b"])
def test_a_missing_file_is_named(broken, column):
    path = broken.file(4, column)
    path.unlink()
    assert one(broken.findings()) == ("error", "broken", f"images/{path.name}: no such file")


def test_a_missing_no_contact_frame_is_named(recording, tmp_path):
    broken = Broken(recording, tmp_path / "r")
    path = broken.file(4, "touch_a_before")
    path.unlink()
    assert one(broken.findings()) == ("error", "broken", f"images/{path.name}: no such file")


@pytest.mark.parametrize("fraction", [0.0, 0.9])
@pytest.mark.parametrize("column", ["photo", "touch_b"])
def test_a_truncated_picture_is_named(broken, column, fraction):
    path = broken.file(7, column)
    data = path.read_bytes()
    path.write_bytes(data[: int(fraction * len(data))])
    severity, kind, message = one(broken.findings())
    assert (severity, kind) == ("error", "broken")
    assert message.startswith(f"images/{path.name}: ")


def test_every_broken_file_has_a_finding_and_other_files_are_still_checked(broken):
    for number in (0, 5, 9):
        broken.file(number, "touch_a").write_bytes(b"no picture")
    broken.file(12, "photo").write_bytes(broken.file(20, "photo").read_bytes())
    assert [finding.kind for finding in broken.findings()] == ["broken"] * 3 + ["duplicate"]


def test_a_recording_without_any_readable_picture_gives_findings(broken):
    for path in (broken.folder / "images").iterdir():
        path.write_bytes(b"")
    findings = broken.findings()
    assert {finding.kind for finding in findings} == {"broken"}
    assert len(findings) == 72


# Grasps ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("column", ["photo", "touch_a"])
def test_the_same_picture_under_two_objects_names_both(broken, column):
    """The second file is a copy of the first; a shared photo would be positive and negative at once."""
    one_file, other = broken.file(1, column), broken.file(10, column)
    other.write_bytes(one_file.read_bytes())
    severity, kind, message = one(broken.findings())
    assert (severity, kind) == ("error", "duplicate")
    assert message.startswith("2 objects share one image: ")
    for number, path in ((1, one_file), (10, other)):
        assert f"{broken.rows[number]['object_id']} (images/{path.name})" in message


def test_one_photo_file_in_the_lines_of_two_objects_is_found(broken):
    name = broken.rows[0]["photo_file_name"]
    broken.change([8], lambda row: row.update(photo_file_name=name))
    severity, kind, message = one(broken.findings())
    assert (severity, kind) == ("error", "duplicate")
    assert message.count(f"({name})") == 2


def test_a_photo_shared_by_the_grasps_of_one_object_is_fine(broken):
    name = broken.rows[0]["photo_file_name"]
    assert broken.rows[0]["object_id"] == broken.rows[1]["object_id"]
    broken.change([1], lambda row: row.update(photo_file_name=name))
    assert broken.findings() == []


def test_two_fingers_with_the_same_picture_are_a_warning(broken):
    broken.file(3, "touch_b").write_bytes(broken.file(3, "touch_a").read_bytes())
    message = f"two fingers have the same image in 1 of 24 grasps: {broken.rows[3]['grasp_id']}"
    assert one(broken.findings()) == ("warning", "same-fingers", message)


@pytest.mark.parametrize("column", ["touch_a_file_name", "touch_b_file_name"])
def test_a_photo_that_is_also_the_touch_is_an_error_although_nothing_looks_swapped(broken, column):
    broken.change(range(24), lambda row: row.update({column: row["photo_file_name"]}))
    severity, kind, message = one(broken.findings())
    assert (severity, kind) == ("error", "same-modality")
    assert message.startswith("photo and touch are the same image in 24 of 24 grasps: ")


def test_objects_with_one_grasp_give_a_warning_that_names_the_first_five(tmp_path):
    folder = synthetic.write_recording(tmp_path / "r", synthetic.make_objects(7), 1, before=False)
    names = sorted(obj.object_id for obj in synthetic.make_objects(7))
    severity, kind, message = one(remarks(folder))
    assert (severity, kind) == ("warning", "one-grasp")
    assert message.startswith("7 of 7 object(s) have only one grasp, ")
    assert message.endswith(f": {', '.join(names[:5])} and 2 more")


def test_one_object_with_one_grasp_is_named(broken):
    rows = broken.rows
    broken.rows = [rows[0], *rows[3:]]
    severity, kind, message = one(broken.findings())
    assert (severity, kind) == ("warning", "one-grasp")
    assert message.startswith("1 of 8 object(s) have only one grasp")
    assert message.endswith(f": {rows[0]['object_id']}")


# Swapped modalities ----------------------------------------------------------------------------------------


def test_photos_and_touches_swapped_throughout_are_found(broken):
    broken.change(range(24), swap_photo_and_touch)
    severity, kind, message = one(broken.findings())
    assert (severity, kind) == ("error", "swapped")
    assert "throughout" in message
    assert "exchange the columns" in message


@pytest.mark.parametrize("numbers", [[0], [5, 20], [1, 2, 3, 10, 11, 22, 23]])
def test_the_grasps_with_photo_and_touch_swapped_are_named(broken, numbers):
    broken.change(numbers, swap_photo_and_touch)
    names = [broken.rows[number]["grasp_id"] for number in numbers]
    severity, kind, message = one(broken.findings())
    assert (severity, kind) == ("error", "swapped")
    assert message.startswith(f"touch and photo look swapped in {len(numbers)} of 24 grasps: {', '.join(names[:5])}")
    assert message.endswith("and 2 more" if len(numbers) == 7 else names[-1])


def test_two_grasps_are_too_few_to_find_a_swap(tmp_path):
    folder = synthetic.write_recording(tmp_path / "r", synthetic.make_objects(1), 2, before=False)
    broken = Broken(folder, tmp_path / "copy")
    broken.change([0], swap_photo_and_touch)
    assert broken.findings() == []


# Splits ----------------------------------------------------------------------------------------------------


def with_test(split, *names):
    return Split(split.seed, split.train, split.validation, (*split.test, *names))


def test_an_object_in_two_parts_is_an_error_and_so_are_its_sequences(clean):
    split = good_split(clean)
    first, second = split.train[:2]
    objects, sequences = remarks(clean, with_test(split, second, first))
    names = ", ".join(sorted([first, second]))
    assert (objects.severity, objects.kind) == ("error", "split-objects")
    assert objects.message == f"the split shares 2 object(s): {names}"
    assert (sequences.severity, sequences.kind) == ("error", "split-sequences")


def test_an_object_in_two_parts_without_sequences_is_one_error(broken):
    broken.change(range(24), lambda row: row.pop("sequence_id"))
    split = good_split(broken.folder)
    assert one(broken.findings(with_test(split, split.validation[0])))[:2] == ("error", "split-objects")


def test_a_sequence_cut_in_two_is_an_error(broken):
    """Two objects are in one video, and an earlier split separates them."""
    split = good_split(broken.folder)
    take = {split.train[0], split.test[0]}
    numbers = [number for number, row in enumerate(broken.rows) if row["object_id"] in take]
    broken.change(numbers, lambda row: row.update(sequence_id="one take"))
    cut, leak = broken.findings(split)
    assert (cut.severity, cut.kind) == ("error", "split-sequences")
    assert cut.message.startswith("the split cuts 1 sequence(s) in two")
    assert cut.message.endswith(": one take")
    assert (leak.severity, leak.kind) == ("error", "sequences-in-training")
    assert broken.findings(good_split(broken.folder)) == []


def test_an_object_that_the_split_leaves_out_is_a_warning(clean):
    split = good_split(clean)
    left_out = Split(0, split.train[1:], split.validation, split.test)
    found = one(remarks(clean, left_out))
    assert found == ("warning", "split-absent", f"the split leaves out 1 object(s): {split.train[0]}")


def test_an_object_of_the_split_that_was_not_recorded_is_a_warning(clean):
    split = good_split(clean)
    found = one(remarks(clean, Split(0, (*split.train, "ghost"), split.validation, split.test)))
    assert found == ("warning", "split-unknown", "the split names 1 object(s) not recorded: ghost")


def test_a_split_is_checked_without_reading_pictures(broken):
    shutil.rmtree(broken.folder / "images")
    grasps = load_grasps(broken.folder)
    split = make_split(grasps, validation=0.25, test=0.2, seed=0)
    assert list(check_split(grasps, split)) == []
    assert one(check_split(grasps, Split(0, split.train, (), split.test)))[1] == "split-absent"
