"""Known problems of published data sets: each planted problem is found, and a clean recording has no findings."""

import shutil

import cv2
import numpy as np
import pytest

from retrieval.data.check.recording import check_recording
from retrieval.data.dataset import Split, load_grasps, make_split
from robot.recording.folder import RecordingWriter
from tests import synthetic
from tests.retrieval.data.test_check import Broken, one, remarks, swap_photo_and_touch


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """8 objects, 3 grasps each with no-contact frames."""
    folder = tmp_path_factory.mktemp("clean") / "recording"
    return synthetic.write_recording(folder, synthetic.make_objects(8), 3)


@pytest.fixture
def broken(clean, tmp_path):
    return Broken(clean, tmp_path / "r")


# Dead and repeated frames ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("column", "what"), [("photo", "the photo"), ("touch_b", "a touch"), ("touch_a_before", "a no-contact frame")]
)
@pytest.mark.parametrize("level", [0, 128])
def test_dead_frames_are_named(broken, column, what, level):
    for number in (4, 17):
        cv2.imwrite(str(broken.file(number, column)), np.full((120, 160, 3), level, np.uint8))
    (finding,) = [finding for finding in broken.findings() if finding.kind == "dead-frame"]
    assert (finding.severity, finding.grasps) == ("error", broken.names((4, 17)))
    assert finding.message.startswith(f"{what} has a single colour (a dead frame) in 2 of 24 grasps: ")


def test_a_dead_frame_with_jpeg_noise_is_dead_and_a_dark_frame_with_noise_is_not(broken):
    dark = np.random.default_rng(0).integers(0, 12, (120, 160, 3), dtype=np.uint8)
    cv2.imwrite(str(broken.file(2, "photo")), dark)
    assert [finding for finding in broken.findings() if finding.kind == "dead-frame"] == []
    cv2.imwrite(str(broken.file(2, "photo")), np.full((120, 160, 3), (3, 90, 201), np.uint8))  # a .jpg
    (finding,) = [finding for finding in broken.findings() if finding.kind == "dead-frame"]
    assert finding.grasps == broken.names((2,))


def test_a_frozen_sensor_whose_touch_equals_the_no_contact_frame_is_named(broken):
    broken.file(5, "touch_b").write_bytes(broken.file(5, "touch_b_before").read_bytes())
    severity, kind, message = one(broken.findings())
    assert (severity, kind) == ("error", "frozen-frame")
    assert message == f"touch and no-contact frame are the same image in 1 of 24 grasps: {broken.names((5,))[0]}"


def test_a_touch_repeated_within_an_object_is_a_warning_and_a_shared_photo_is_not(broken):
    assert broken.rows[3]["object_id"] == broken.rows[5]["object_id"]
    broken.file(5, "touch_a").write_bytes(broken.file(3, "touch_a").read_bytes())
    broken.file(4, "photo").write_bytes(broken.file(3, "photo").read_bytes())
    (finding,) = broken.findings()
    assert (finding.severity, finding.kind) == ("warning", "repeated-touch")
    assert finding.grasps == broken.names((3, 5))


# Backgrounds -------------------------------------------------------------------------------------------------


def use_background_of(broken, first):
    """Give every grasp the no-contact frames of another grasp: `first` maps row numbers to row numbers."""
    rows = broken.rows
    for number, row in enumerate(rows):
        for finger in "ab":
            source = broken.file(first(number), f"touch_{finger}_before")
            if source != broken.folder / row[f"touch_{finger}_before_file_name"]:
                shutil.copyfile(source, broken.folder / row[f"touch_{finger}_before_file_name"])


def test_one_background_for_many_objects_is_a_warning_with_counts(broken):
    use_background_of(broken, lambda number: 0)
    severity, kind, message = one(broken.findings())
    assert (severity, kind) == ("warning", "one-background")
    assert message.startswith("2 no-contact frame(s) serve 24 of 24 grasps, of 8 objects: ")


def test_one_background_for_each_object_is_no_problem_and_not_reported_as_light(broken):
    use_background_of(broken, lambda number: number - number % 3)
    assert broken.findings() == []
    assert any("separate no-contact frame" in finding.message for finding in check_recording(broken.folder))


# Swapped folders ---------------------------------------------------------------------------------------------


def test_a_sequence_with_swapped_folders_is_named(broken):
    """TVL's first upload had this problem: `vision` and `tactile` exchanged below one timestamp."""
    broken.change([6, 7, 8, 20], swap_photo_and_touch)
    severity, kind, message = one(broken.findings())
    assert (severity, kind) == ("error", "swapped")
    swapped, other = broken.rows[6]["sequence_id"], broken.rows[20]["sequence_id"]
    assert message.startswith(
        f"touch and photo look swapped, throughout the sequence(s) {swapped}, in 4 of 24 grasps: "
    )
    assert other not in message.split(" in 4 of")[0]


# Test sequences in training ----------------------------------------------------------------------------------


def write_videos(folder, sequences, frames=6, sequence_ids=True, mixed=True):
    """Write frames of videos: one press each, which moves by a pixel a frame, with sensor noise.

    With `mixed`, every second frame of a video belongs to another object, as in splits that ignore videos.
    """
    rng = np.random.default_rng(0)
    with RecordingWriter(folder, {"source": "videos", "sensor": "drawn gel"}) as writer:
        for sequence, drawn in enumerate(synthetic.make_objects(sequences)):
            press = synthetic.draw_touch(drawn, 0, fingers="a")["a"]
            for frame in range(frames):
                noise = rng.normal(0, 2, press.shape)
                touch = np.clip(np.roll(press, frame, axis=1) + noise, 0, 255).astype(np.uint8)
                part = "odd" if mixed and frame % 2 else "even"
                writer.append(
                    f"{sequence:02d}-{frame}",
                    f"{sequence:02d}-{part}",
                    {"photo": synthetic.draw_photo(drawn, frame, px=96), "touch_a": touch},
                    sequence_id=f"video {sequence}" if sequence_ids else None,
                )
    return folder


def split_within_videos(folder):
    """Return a split with the even frames in training and the odd ones in the test."""
    objects = sorted({grasp.object_id for grasp in load_grasps(folder)})
    even, odd = ([name for name in objects if name.endswith(part)] for part in ("even", "odd"))
    return Split(0, tuple(even), (), tuple(odd))


def sequence_findings(folder, split):
    return [finding for finding in remarks(folder, split) if finding.kind == "sequences-in-training"]


def test_test_sequences_in_training_are_an_error_with_the_accuracy_of_raw_pixels(tmp_path):
    folder = write_videos(tmp_path / "r", 10)
    (finding,) = sequence_findings(folder, split_within_videos(folder))
    assert finding.severity == "error"
    assert finding.message.startswith(
        "30 of 30 test grasps belong to sequences that are also in training, and for 100% of them the nearest training "
        "touch by raw pixels is of the same sequence (chance 10%)"
    )


def test_neighbouring_frames_without_sequence_ids_are_a_warning_with_both_fractions(tmp_path):
    folder = write_videos(tmp_path / "r", 10, sequence_ids=False)
    (finding,) = sequence_findings(folder, split_within_videos(folder))
    assert finding.severity == "warning"
    assert int(finding.message.split("%")[0]) > 90
    assert "(0% of the training touches have one)" in finding.message


@pytest.mark.parametrize("sequence_ids", [True, False])
def test_a_split_that_keeps_videos_together_has_no_such_finding(tmp_path, sequence_ids):
    folder = write_videos(tmp_path / "r", 10, sequence_ids=sequence_ids, mixed=False)
    split = make_split(load_grasps(folder), validation=0.2, test=0.3, seed=0)
    assert sequence_findings(folder, split) == []


def test_touches_of_one_object_that_differ_like_touches_of_two_give_no_finding(clean):
    split = make_split(load_grasps(clean), validation=0.25, test=0.25, seed=0)
    assert sequence_findings(clean, split) == []
