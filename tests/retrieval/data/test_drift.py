"""Drift of light and gel: it is found where objects were touched one after another, and not where they were mixed."""

import cv2
import numpy as np
import pytest

from retrieval.commands.main import main
from retrieval.data.check.drift import nearest_grasp_accuracy
from retrieval.data.check.recording import check_recording
from tests import synthetic
from tests.retrieval.data.test_check import Broken, one

OBJECTS, GRASPS = 8, 5
GELS = ("touch_a", "touch_b", "touch_a_before", "touch_b_before")


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """8 objects, 5 grasps each with no-contact frames, object by object."""
    folder = tmp_path_factory.mktemp("clean") / "recording"
    return synthetic.write_recording(folder, synthetic.make_objects(OBJECTS), GRASPS)


@pytest.fixture
def broken(clean, tmp_path):
    return Broken(clean, tmp_path / "r")


def dim(path, gain):
    cv2.imwrite(str(path), np.clip(cv2.imread(str(path)) * gain, 0, 255).astype(np.uint8))


def let_drift(broken, columns=GELS):
    """Raise the brightness of the gel images by 20 %, evenly over the lines."""
    rows = broken.rows
    for number in range(len(rows)):
        for column in columns:
            dim(broken.file(number, column), 0.8 + 0.2 * number / len(rows))


def in_rounds(rows):
    return [row for turn in range(GRASPS) for row in rows[turn::GRASPS]]


def finding(broken, kind):
    (found,) = [each for each in check_recording(broken.folder) if each.kind == kind]
    return found


# Drift -----------------------------------------------------------------------------------------------------


def test_drift_identifies_objects_that_were_touched_one_after_another(broken):
    """In a block of 5, the outer lines have one neighbour of two in the block: (3 + 2 / 2) / 5 = 80 %."""
    let_drift(broken)
    severity, kind, message = one(broken.findings())
    assert (severity, kind) == ("warning", "drift")
    assert message.startswith("the no-contact frames alone identify the object in ")
    assert int(message.split(" in ")[1].split("%")[0]) >= 70
    assert "(chance 10%), the order of their capture alone in 8" in message  # 4 other grasps of the object among 39
    assert "(40 different frames of 8 objects): light or gel drifted" in message
    assert "touch the objects in rounds (each object once, then again)" in message


def test_the_same_drift_does_not_identify_objects_that_were_touched_in_rounds(broken):
    broken.rows = in_rounds(broken.rows)
    let_drift(broken)
    assert broken.findings() == []
    note = finding(broken, "drift")
    assert note.severity == "note"
    assert "the order of their capture alone in 0% [0, 0] (chance 10%)" in note.message
    assert int(note.message.split(" in ")[1].split("%")[0]) <= 10
    assert "drifted" not in note.message


def test_times_give_the_order_of_capture_whatever_the_order_of_the_lines(broken):
    captured = {row["grasp_id"]: place for place, row in enumerate(in_rounds(broken.rows))}
    broken.change(range(OBJECTS * GRASPS), lambda row: row.update(time_s=float(captured[row["grasp_id"]])))
    assert "the order of their capture alone in 0% [0, 0]" in finding(broken, "drift").message


def test_a_command_prints_the_accuracies_of_a_clean_recording(clean, capsys):
    assert main(["check", str(clean)]) == 0
    assert "note: the no-contact frames alone identify the object in " in capsys.readouterr().err


def test_an_error_in_the_photos_does_not_hide_the_drift(broken):
    """Recordings without photos have the touch in place of the photo."""
    let_drift(broken)
    broken.change(range(OBJECTS * GRASPS), lambda row: row.update(photo_file_name=row["touch_a_file_name"]))
    assert {each.kind for each in broken.findings()} == {"same-modality", "drift"}


# Common no-contact frames ----------------------------------------------------------------------------------


@pytest.mark.parametrize("same_file", [True, False])
def test_a_no_contact_frame_that_all_grasps_of_an_object_share_does_not_count(broken, same_file):
    """Each object has its own light and one frame: nothing is left to compare, and the order is reported."""
    let_drift(broken, GELS[2:])
    for number in range(OBJECTS * GRASPS):
        first = number - number % GRASPS
        for column in GELS[2:]:
            if same_file:
                name = broken.rows[first][f"{column}_file_name"]
                broken.change([number], lambda row, key=f"{column}_file_name", name=name: row.update({key: name}))
            elif number != first:
                broken.file(number, column).write_bytes(broken.file(first, column).read_bytes())
    assert broken.findings() == []
    note = finding(broken, "unchecked-light")
    assert note.message.startswith("the order of capture alone identifies the object in 8")
    assert "without a separate no-contact frame" in note.message
    assert "touch the objects in rounds" in note.message


def test_objects_with_a_common_no_contact_frame_are_left_out(broken):
    for number in range(1, GRASPS):
        for column in GELS[2:]:
            broken.file(number, column).write_bytes(broken.file(0, column).read_bytes())
    message = finding(broken, "drift").message
    assert "(35 different frames of 7 objects); 1 object(s) with one no-contact frame for all grasps" in message


# Light -----------------------------------------------------------------------------------------------------


def change_lamps(broken, columns):
    """Change the brightness of each object's pictures by up to 8 %."""
    objects = sorted({row["object_id"] for row in broken.rows})
    for number, row in enumerate(broken.rows):
        gain = 0.92 + 0.16 * objects.index(row["object_id"]) / (len(objects) - 1)
        for column in columns:
            dim(broken.file(number, column), gain)


def test_light_that_changes_from_object_to_object_is_found_on_the_no_contact_frames(broken):
    change_lamps(broken, GELS)
    assert one(broken.findings())[:2] == ("warning", "drift")


def test_strong_light_is_found_from_touches_only(broken):
    change_lamps(broken, GELS[:2])
    assert "light" in {each.kind for each in broken.findings()}


# Statistics ------------------------------------------------------------------------------------------------


def test_accuracy_at_chance_level_does_not_exceed_chance():
    objects = np.repeat(np.arange(10), 6)
    rng = np.random.default_rng(0)
    assert not nearest_grasp_accuracy(rng.normal(size=(60, 18)), objects).exceeds_chance(0.2)
    result = nearest_grasp_accuracy(objects[:, None] + rng.normal(0, 0.05, (60, 18)), objects)
    assert (result.accuracy, result.low, result.high) == (1.0, 1.0, 1.0)
    assert (result.chance, result.queries, result.objects) == (pytest.approx(5 / 59), 60, 10)
    assert result.exceeds_chance(0.2)
    assert str(result) == "100% [100, 100] (chance 8%)"


def test_equal_values_have_exactly_the_accuracy_of_chance():
    objects = np.array([0, 0, 0, 1, 1, 2])
    result = nearest_grasp_accuracy(np.ones((6, 4)), objects)
    assert result.accuracy == pytest.approx((2 / 5 + 1 / 5) / 2)
    assert result.chance == pytest.approx(result.accuracy)
    assert (result.queries, result.objects) == (5, 2)


def test_one_object_or_single_grasps_have_no_accuracy():
    assert nearest_grasp_accuracy(np.arange(5)[:, None], np.arange(5)) is None
    assert nearest_grasp_accuracy(np.arange(5)[:, None], np.zeros(5, int)) is None
