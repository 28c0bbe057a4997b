"""Checks of a recording: each planted fault gives its finding, and a clean recording gives none."""

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from retrieval.commands.main import main
from retrieval.data.check.drift import check_sessions
from retrieval.data.check.opening import check_openings
from retrieval.data.check.recording import check_gel_layout, check_recording
from retrieval.data.check.split import check_split
from retrieval.data.dataset import Grasp, Split, load_grasps, make_split
from tests import synthetic

GELS = ("touch_a", "touch_b", "touch_a_before", "touch_b_before")


class Broken:
    """A copy of a recording that a test breaks."""

    def __init__(self, recording, folder):
        self.folder = folder
        shutil.copytree(recording, folder)
        self.rows = [json.loads(line) for line in (folder / "metadata.jsonl").read_text().splitlines()]

    def change(self, numbers, change):
        for number in numbers:
            change(self.rows[number])
        (self.folder / "metadata.jsonl").write_text("".join(json.dumps(row) + "\n" for row in self.rows))

    def exchange(self, numbers, *columns):
        """Exchange the files of pairs of columns."""

        def exchange(row):
            keys = [f"{column}_file_name" for column in columns]
            for first, second in zip(keys[::2], keys[1::2], strict=True):
                row[first], row[second] = row[second], row[first]

        self.change(numbers, exchange)

    def file(self, number, column):
        return self.folder / self.rows[number][f"{column}_file_name"]

    def copy(self, source, target):
        """Copy the bytes of a file: (number, column) each."""
        shutil.copyfile(self.file(*source), self.file(*target))

    def edit(self, number, column, change):
        path = self.file(number, column)
        cv2.imwrite(str(path), change(cv2.imread(str(path))))

    def names(self, numbers):
        return tuple(self.rows[number]["grasp_id"] for number in numbers)


def remarks(folder, split=None):
    """Return the findings without notes."""
    return [finding for finding in check_recording(folder, split) if finding.severity != "note"]


def kinds(findings):
    return {(finding.severity, finding.kind, finding.grasps) for finding in findings}


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """6 objects, 4 grasps each and one miss, object by object."""
    folder = tmp_path_factory.mktemp("clean") / "recording"
    return synthetic.write_recording(folder, synthetic.make_objects(6), 4, misses=1)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """8 objects, 2 grasps each, without no-contact frames."""
    folder = tmp_path_factory.mktemp("plain") / "recording"
    return synthetic.write_recording(folder, synthetic.make_objects(8), 2, before=False)


@pytest.fixture
def broken(clean, tmp_path):
    return Broken(clean, tmp_path / "r")


def test_a_clean_recording_and_a_drawn_split_have_no_finding(clean):
    assert remarks(clean, good_split(clean)) == []
    assert check_gel_layout(clean) == []


def test_missing_and_truncated_pictures_are_named_and_others_are_still_checked(broken):
    """Also in a rejected grasp, the fifth of each object."""
    broken.exchange([20], "photo", "touch_a")
    damaged = ((4, "photo", None), (8, "touch_b", 0.0), (13, "touch_a_before", 0.9))
    paths = [broken.file(number, column) for number, column, _ in damaged]
    for path, (*_, fraction) in zip(paths, damaged, strict=True):
        data = path.read_bytes()
        path.unlink()
        if fraction is not None:
            path.write_bytes(data[: int(fraction * len(data))])
    *found, swapped = remarks(broken.folder)
    assert [(finding.severity, finding.kind) for finding in found] == [("error", "broken")] * 3
    assert {finding.message.split(": ")[0] for finding in found} == {f"images/{path.name}" for path in paths}
    assert (swapped.kind, swapped.grasps) == ("swapped", broken.names([20]))


def test_a_recording_without_any_readable_picture_gives_findings(plain, tmp_path):
    broken = Broken(plain, tmp_path / "r")
    for path in (broken.folder / "images").iterdir():
        path.write_bytes(b"")
    assert [finding.kind for finding in remarks(broken.folder)] == ["broken"] * 48


def test_the_same_picture_under_two_objects_names_both(broken):
    """A shared photo would be positive and negative at once. Grasps of one object may share a photo."""
    broken.copy((0, "photo"), (2, "photo"))
    photo = broken.rows[1]["photo_file_name"]
    broken.change([10], lambda row: row.update(photo_file_name=photo))
    broken.copy((6, "touch_a"), (25, "touch_a"))
    found = remarks(broken.folder)
    assert [(finding.severity, finding.kind) for finding in found] == [("error", "duplicate")] * 2
    for finding, numbers, column in zip(found, ((1, 10), (6, 25)), ("photo", "touch_a"), strict=True):
        assert all(broken.rows[number]["object_id"] in finding.message for number in numbers)
        assert broken.file(numbers[1], column).name in finding.message


def test_objects_with_one_grasp_give_a_warning_that_names_the_first_five(tmp_path):
    folder = synthetic.write_recording(tmp_path / "r", synthetic.make_objects(7), 1, before=False)
    names = sorted(obj.object_id for obj in synthetic.make_objects(7))
    (finding,) = remarks(folder)
    assert (finding.severity, finding.kind) == ("warning", "one-grasp")
    assert finding.message.endswith(f": {', '.join(names[:5])} and 2 more")


def test_pictures_that_are_equal_or_of_one_colour_are_named(broken):
    broken.change((1, 7), lambda row: row.update(touch_b_file_name=row["photo_file_name"]))
    broken.copy((2, "touch_a"), (2, "touch_b"))
    broken.copy((8, "touch_b_before"), (8, "touch_b"))
    broken.copy((10, "touch_a"), (11, "touch_a"))
    for number, column, level in ((12, "photo", (3, 90, 201)), (15, "touch_b", 0)):
        broken.edit(number, column, lambda image, level=level: np.full_like(image, level))
    for number in (16, 18):
        broken.edit(number, "touch_a_before", lambda image: np.full_like(image, 128))
    dark = np.random.default_rng(0).integers(0, 12, (120, 160, 3), dtype=np.uint8)  # with noise, so not dead
    broken.edit(22, "photo", lambda _: dark)
    expected = {
        ("error", "same-modality", (1, 7)),
        ("warning", "same-fingers", (2,)),
        ("error", "frozen-frame", (8,)),
        ("warning", "repeated-touch", (10, 11)),
        ("error", "dead-frame", (12,)),
        ("error", "dead-frame", (15,)),
        ("error", "dead-frame", (16, 18)),
    }
    assert kinds(remarks(broken.folder)) == {(*what, broken.names(numbers)) for *what, numbers in expected}


MOMENTS = ("touch_a", "touch_a_before", "touch_b", "touch_b_before")
COLOURS, FOLDERS = (3, 18, 27), (1, 8, 13)


@pytest.mark.parametrize(
    ("numbers", "columns", "kind"),
    [
        ((5, 11, 15, 21, 26, 28), GELS, "swapped-fingers"),
        ((2, 17, 22), MOMENTS, "swapped-moments"),
        (range(30), MOMENTS, "swapped-moments"),
        (range(30), ("photo", "touch_a"), "swapped"),
    ],
)
def test_exchanged_columns_give_a_finding_with_the_grasps(broken, numbers, columns, kind):
    broken.exchange(numbers, *columns)
    assert kinds(remarks(broken.folder)) == {("error", kind, broken.names(numbers))}


def test_a_sequence_with_swapped_folders_and_exchanged_channels_are_named(broken):
    """TVL's first upload had this problem: `vision` and `tactile` exchanged below one timestamp."""
    broken.change(FOLDERS, lambda row: row.update(sequence_id="one folder"))
    broken.change((20,), lambda row: row.update(sequence_id="half"))
    broken.exchange((*FOLDERS, 21), "photo", "touch_a")
    for number in COLOURS:
        for column in ("touch_b", "touch_b_before"):
            broken.edit(number, column, lambda image: image[..., ::-1])
    found = remarks(broken.folder)
    assert kinds(found) == {
        ("error", "swapped", broken.names(sorted((*FOLDERS, 21)))),
        ("warning", "colour-layout", broken.names(COLOURS)),
    }


@pytest.mark.parametrize(
    ("opening", "message"),
    [
        (lambda object_number, grasp: (30 + 9 * object_number + grasp) / 1000, "not between 0.5 and 300.* metres"),
        (lambda object_number, grasp: 110.0, "commanded.* by 0 % among grasps of an object and by 0 % among objects"),
        (lambda object_number, grasp: 30.0 + 9 * grasp, "says nothing of the object.* by 24 % .* by 0 %"),
        (lambda object_number, grasp: 30.0 + 9 * object_number + grasp, None),
    ],
)
def test_openings_that_no_gripper_measures_or_that_say_nothing_of_the_object_are_doubted(opening, message):
    grasps = [
        Grasp(f"{name}-{number}", str(name), None, Path("photo"), (), (), opening_mm=opening(name, number))
        for name in range(6)
        for number in range(3)
    ]
    found = list(check_openings(grasps))
    assert [bool(re.search(message, finding.message)) for finding in found] == [True] if message else not found


def test_two_grasps_are_too_few_to_find_a_swap(tmp_path):
    folder = synthetic.write_recording(tmp_path / "r", synthetic.make_objects(1), 2, before=False)
    broken = Broken(folder, tmp_path / "copy")
    broken.exchange([0], "photo", "touch_a")
    assert remarks(broken.folder) == []


def test_one_no_contact_frame_for_many_objects_is_a_warning_with_counts(broken):
    first = broken.rows[0]
    broken.change(
        range(30), lambda row: row.update({f"{gel}_file_name": first[f"{gel}_file_name"] for gel in GELS[2:]})
    )
    (finding,) = remarks(broken.folder)
    assert (finding.severity, finding.kind) == ("warning", "one-background")
    assert finding.message.startswith("2 no-contact frame(s) serve 24 of 24 grasps, of 6 objects: ")


def test_an_import_prints_the_warning_about_exchanged_channels_and_succeeds(tmp_path, capsys):
    down, right = np.meshgrid(np.linspace(0, 255, 120), np.linspace(0, 255, 160), indexing="ij")
    gel = np.stack([down, right / 2 + 60, 255 - right], axis=-1)
    for number in range(8):
        folder = tmp_path / "src" / f"mug-{number // 2}"
        folder.mkdir(parents=True, exist_ok=True)
        image = np.clip(gel + np.random.default_rng(number).normal(0, 9, gel.shape), 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"touch_{number}.png"), image[..., ::-1] if number == 5 else image)
        cv2.imwrite(str(folder / f"photo_{number}.png"), image // (number + 1))
    assert main(["import", "folder", str(tmp_path / "src"), "--out", str(tmp_path / "out")]) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning")]
    assert "touch of finger a looks as if it had red and blue exchanged" in line
    assert "in 1 of 8 grasps" in line


def let_drift(broken, order=range(30), columns=GELS):
    """Raise the brightness of the gel images by 20 % in this order of the lines."""
    for place, number in enumerate(order):
        gain = 0.8 + 0.2 * place / 30
        for column in columns:
            broken.edit(number, column, lambda image, gain=gain: np.clip(image * gain, 0, 255).astype(np.uint8))


def test_drift_identifies_objects_that_were_touched_one_after_another(broken):
    """In a block of 4, the outer lines have one neighbour of two in the block: (2 + 2 / 2) / 4 = 75 %."""
    let_drift(broken)
    broken.change(range(30), lambda row: row.pop("photo_file_name"))  # it has touches only, which is no finding
    (drift,) = remarks(broken.folder)
    assert (drift.severity, drift.kind) == ("warning", "drift")
    found = re.match(
        r"the no-contact frames alone identify the object in (\d+)% \[.*?\] \(chance 13%\), the order of their capture "
        r"alone in 7\d% .*? \(24 different frames of 6 objects\): light or gel drifted",
        drift.message,
    )
    assert int(found[1]) >= 60
    assert "touch the objects in rounds (each object once, then again)" in drift.message


def test_sessions_between_which_no_result_can_be_tested_are_named(broken):
    for key, kinds in (("sensor", {"one-session"}), ("object_id", {"separate-sessions"}), ("grasp_id", set())):
        broken.change(range(30), lambda row, key=key: row.update(session=row.get(key, "-")[-1]))
        assert {one.kind for one in check_sessions(load_grasps(broken.folder))} == kinds


def test_the_same_drift_does_not_identify_objects_that_were_touched_in_rounds(broken):
    """Times give the order of capture, whatever the order of the lines."""
    rounds = [number for turn in range(5) for number in range(turn, 30, 5)]
    let_drift(broken, rounds)
    captured = {broken.rows[number]["grasp_id"]: float(place) for place, number in enumerate(rounds)}
    broken.change(range(30), lambda row: row.update(time_s=captured[row["grasp_id"]]))
    assert remarks(broken.folder) == []
    (note,) = [finding for finding in check_recording(broken.folder) if finding.kind == "drift"]
    found = re.search(r"alone identify the object in (\d+)%.*alone in 0% \[0, 0\] \(chance 13%\)", note.message)
    assert int(found[1]) <= 13


def test_a_no_contact_frame_that_all_grasps_of_an_object_share_does_not_count(broken):
    """Each object has its own light and one frame: nothing is left to compare, and the order is reported."""
    let_drift(broken, columns=GELS[2:])
    for number in range(30):
        for column in GELS[2:]:
            if number % 5:
                broken.copy((number - number % 5, column), (number, column))
    found = check_recording(broken.folder)
    assert {finding.severity for finding in found} == {"note"}
    assert {finding.kind for finding in found} >= {"one-session", "unchecked-light"}
    (message,) = [finding.message for finding in found if finding.kind == "unchecked-light"]
    assert message.startswith("the order of capture alone identifies the object in 7")
    assert "touch the objects in rounds" in message


def good_split(folder):
    return make_split(load_grasps(folder), validation=0.25, test=0.2, seed=0)


def split_kinds(folder, split):
    return {(finding.severity, finding.kind) for finding in remarks(folder, split)}


def test_objects_and_sequences_in_two_parts_are_errors_and_objects_in_none_are_warnings(plain, tmp_path):
    split = good_split(plain)
    grasps = load_grasps(plain)
    shared = Split(0, split.train, split.validation, (*split.test, split.train[1], split.train[0]))
    objects, sequences = check_split(grasps, shared)
    assert (objects.severity, objects.kind) == ("error", "split-objects")
    assert objects.message.endswith(f"2 object(s): {', '.join(sorted(split.train[:2]))}")
    assert (sequences.severity, sequences.kind) == ("error", "split-sequences")
    assert split_kinds(plain, Split(0, split.train[1:], split.validation, split.test)) == {("warning", "split-absent")}
    ghost = Split(0, (*split.train, "ghost"), split.validation, split.test)
    assert split_kinds(plain, ghost) == {("warning", "split-unknown")}
    broken = Broken(plain, tmp_path / "r")
    numbers = [n for n, row in enumerate(broken.rows) if row["object_id"] in (split.train[0], split.test[0])]
    broken.change(numbers, lambda row: row.update(sequence_id="one take"))  # an earlier split separates the objects
    assert split_kinds(broken.folder, split) == {("error", "split-sequences")}
    assert split_kinds(broken.folder, good_split(broken.folder)) == set()
