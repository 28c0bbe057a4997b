"""Leakage audit: planted copies are found after re-encoding, different frames are not reported as copies."""

import shutil

import cv2
import numpy as np
import pytest

from retrieval.data.dataset import Split, load_grasps
from retrieval.errors import ImageError
from retrieval.evaluation.audit import audit
from tests import synthetic
from tests.retrieval.data.test_check import COPIES, GENTLE


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """Recording of 10 objects with 3 grasps each, a photo and two touches."""
    folder = tmp_path_factory.mktemp("audit") / "recording"
    return synthetic.write_recording(folder, synthetic.make_objects(10), 3, before=False)


@pytest.fixture
def recording(clean, tmp_path):
    return shutil.copytree(clean, tmp_path / "recording")


def split_of(grasps):
    names = sorted({grasp.object_id for grasp in grasps})
    return Split(seed=0, train=tuple(names[:5]), validation=tuple(names[5:7]), test=tuple(names[7:]))


def run_audit(folder, split=None):
    grasps = load_grasps(folder)
    return audit(grasps, split or split_of(grasps), quiet=True)


def one_of_each(folder):
    """Return a training grasp, a validation grasp and a test grasp."""
    grasps = load_grasps(folder)
    return (split_of(grasps).select(grasps, part)[0] for part in ("train", "validation", "test"))


def test_a_clean_recording_is_reported_as_clean(recording):
    found = run_audit(recording)
    assert found["clean"]
    assert found["verdict"].startswith("No object, sequence or file is in two parts")
    assert (found["shared"], found["identical"]) == ([], {"count": 0, "examples": []})
    assert list(found["frames"]) == ["photo", "touch a", "touch b"]
    for frames in found["frames"].values():
        assert (frames["test"], frames["train_validation"], frames["near_copies"]) == (9, 21, 0)
        assert frames["examples"] == []
    checked = [found["frames"][kind]["checked"] for kind in ("photo", "touch a", "touch b")]
    assert checked[0] >= 7
    counts = f"{checked[0]} of 9 (photo), {checked[1]} of 9 (touch a), {checked[2]} of 9 (touch b) test frames"
    assert counts in found["verdict"]
    assert "none was found" in found["verdict"]


def test_a_copied_file_is_found_under_another_name_and_in_another_column(recording):
    train, _, test = one_of_each(recording)
    shutil.copy(train.touches[0], test.touches[1])
    found = run_audit(recording)
    assert found["identical"]["count"] == 1
    assert found["identical"]["examples"] == [[f"test: {test.grasp_id} touch b", f"train: {train.grasp_id} touch a"]]
    assert not found["clean"]
    assert "1 file(s) are byte-identical in two parts" in found["verdict"]


@pytest.mark.parametrize("how", COPIES)
def test_a_copy_that_is_re_encoded_brighter_moved_or_flipped_is_found(recording, how):
    """Harder changes remove the fine relief of the drawn touches, which are then reported as unchecked."""
    train, _, test = one_of_each(recording)
    for source, copy in zip((train.photo, *train.touches), (test.photo, *test.touches), strict=True):
        cv2.imwrite(str(copy), COPIES[how](cv2.imread(str(source))))
    found = run_audit(recording)
    for kind in ("photo", "touch a", "touch b") if how in GENTLE else ("photo",):
        assert found["frames"][kind]["near_copies"] == 1
        assert f"1 of 9 test frames ({kind})" in found["verdict"]
    assert found["frames"]["photo"]["examples"] == [[f"test: {test.grasp_id}", f"train: {train.grasp_id}"]]


def test_a_copy_of_a_validation_frame_counts_too(recording):
    """Validation objects select settings, so test objects must differ from them too."""
    _, validation, test = one_of_each(recording)
    shutil.copy(validation.photo, test.photo)
    found = run_audit(recording)
    assert found["identical"]["count"] == found["frames"]["photo"]["near_copies"] == 1


def test_shared_objects_and_sequences_are_reported(recording):
    grasps = load_grasps(recording)
    good = split_of(grasps)
    bad = Split(seed=0, train=(*good.train, good.test[0]), validation=good.validation, test=good.test)
    found = run_audit(recording, bad)
    assert not found["clean"]
    assert "the split shares 1 object(s)" in found["verdict"]


def test_objects_outside_the_split_are_left_out(recording):
    grasps = load_grasps(recording)
    whole = split_of(grasps)
    found = run_audit(recording, Split(seed=0, train=whole.train[:2], validation=(), test=whole.test))
    assert (found["frames"]["photo"]["test"], found["frames"]["photo"]["train_validation"]) == (9, 6)


def test_frames_of_one_side_only_are_not_compared(recording):
    """A model trained elsewhere: the recording has only test objects."""
    grasps = load_grasps(recording)
    names = tuple(sorted({grasp.object_id for grasp in grasps}))
    found = run_audit(recording, Split(seed=0, train=(), validation=(), test=names))
    assert found["clean"]
    assert "near copies were not checked, as one side has no frames" in found["verdict"]


def test_a_damaged_image_is_named(recording):
    train, *_ = one_of_each(recording)
    train.photo.write_bytes(b"no picture")
    with pytest.raises(ImageError, match=train.photo.name):
        run_audit(recording)


def test_low_contact_touches_are_reported_as_unchecked(recording):
    """Noisy no-contact frames lack detail to recognise a copy, so the verdict does not count them as checked."""
    rng = np.random.default_rng(0)
    gel = cv2.imread(str(load_grasps(recording)[0].touches[0]))
    for grasp in load_grasps(recording):
        noisy = np.clip(gel + rng.normal(0, 1.5, gel.shape), 0, 255).astype(np.uint8)
        cv2.imwrite(str(grasp.touches[0]), noisy)
    found = run_audit(recording)
    frames = found["frames"]["touch a"]
    assert (frames["checked"], frames["near_copies"]) == (0, 0)
    assert "0 of 9 (touch a)" in found["verdict"]
    assert "the other test frames have too little detail to recognise a copy" in found["verdict"]
