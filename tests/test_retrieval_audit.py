"""The leakage audit: planted copies are found whatever was done to their bytes, and different frames are not taken
for copies."""

import shutil

import cv2
import numpy as np
import pytest

from retrieval.dataset import Split, load_grasps
from retrieval.errors import ImageError
from retrieval.evaluation.audit import CLOSE_GREY_LEVELS, audit, nearest
from tests import synthetic


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """10 objects, 3 grasps each, a photo and two touches."""
    folder = tmp_path_factory.mktemp("audit") / "recording"
    return synthetic.write_recording(folder, synthetic.make_objects(10), 3, before=False)


@pytest.fixture
def recording(clean, tmp_path):
    return shutil.copytree(clean, tmp_path / "recording")


def split_of(grasps):
    names = sorted({grasp.object_id for grasp in grasps})
    return Split(seed=0, train=tuple(names[:5]), validation=tuple(names[5:7]), test=tuple(names[7:]))


def judge(folder, split=None):
    grasps = load_grasps(folder)
    return audit(grasps, split or split_of(grasps), quiet=True)


def one_of_each(folder):
    """A training grasp, a validation grasp and a test grasp."""
    grasps = load_grasps(folder)
    return (split_of(grasps).select(grasps, part)[0] for part in ("train", "validation", "test"))


def brighter(picture, levels):
    return np.clip(picture.astype(np.int16) + levels, 0, 255).astype(np.uint8)


def test_a_clean_recording_is_said_to_be_clean(recording):
    found = judge(recording)
    assert found["clean"]
    assert found["verdict"].startswith("No object, sequence or file stands in two parts")
    assert (found["shared"], found["identical"]) == ([], {"count": 0, "examples": []})
    assert found["objects"] == {"train": 5, "validation": 2, "test": 3}
    assert found["grasps"] == {"train": 15, "validation": 6, "test": 9}
    assert list(found["frames"]) == ["photo", "touch a", "touch b"]
    for frames in found["frames"].values():
        assert (frames["test"], frames["seen"], frames["close"]) == (9, 21, 0)
        assert frames["to_seen"] == sorted(frames["to_seen"])
        assert frames["to_seen"][0] > CLOSE_GREY_LEVELS


def test_a_copied_file_is_found_under_another_name_and_in_another_column(recording):
    train, _, test = one_of_each(recording)
    shutil.copy(train.touches[0], test.touches[1])
    found = judge(recording)
    assert found["identical"]["count"] == 1
    assert found["identical"]["examples"] == [[f"test: {test.grasp_id} touch b", f"train: {train.grasp_id} touch a"]]
    assert not found["clean"]
    assert "1 file(s) stand byte for byte in two parts" in found["verdict"]


@pytest.mark.parametrize("levels", [0, 1, -1, 3])
@pytest.mark.parametrize("kind", ["photo", "touch a", "touch b"])
def test_a_copy_encoded_again_and_made_brighter_is_found(recording, kind, levels):
    train, _, test = one_of_each(recording)
    source, copy = [train.photo, *train.touches], [test.photo, *test.touches]
    place = ["photo", "touch a", "touch b"].index(kind)
    picture = brighter(cv2.imread(str(source[place])), levels)
    copy[place].write_bytes(cv2.imencode(copy[place].suffix, picture, [cv2.IMWRITE_JPEG_QUALITY, 75])[1].tobytes())
    found = judge(recording)
    assert found["frames"][kind]["close"] == 1
    assert found["frames"][kind]["nearest"][0]["test"] == test.grasp_id
    assert found["frames"][kind]["nearest"][0]["seen"] == train.grasp_id
    assert f"1 of 9 test frames ({kind})" in found["verdict"]


def test_bytes_alone_and_whole_numbers_alone_would_miss_it(recording):
    """What the audit does not rely on: equal digests, and a difference of unsigned bytes."""
    train, *_ = one_of_each(recording)
    picture = cv2.imread(str(train.photo))
    data = cv2.imencode(".jpg", brighter(picture, -1), [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
    copy = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert copy.tobytes() != picture.tobytes()
    naive = (copy - picture).astype(np.float64)  # uint8: -1 becomes 255
    assert np.sqrt((naive**2).mean()) > 100
    true = copy.astype(np.float64) - picture.astype(np.float64)
    assert np.sqrt((true**2).mean()) < 3


def test_a_copy_of_a_validation_frame_counts_too(recording):
    """The test objects must be new to what was chosen as well as to what was fitted."""
    _, validation, test = one_of_each(recording)
    shutil.copy(validation.photo, test.photo)
    found = judge(recording)
    assert found["identical"]["count"] == found["frames"]["photo"]["close"] == 1


def test_shared_objects_and_sequences_are_said(recording):
    grasps = load_grasps(recording)
    good = split_of(grasps)
    bad = Split(seed=0, train=(*good.train, good.test[0]), validation=good.validation, test=good.test)
    found = judge(recording, bad)
    assert not found["clean"]
    assert "the split shares 1 object(s)" in found["verdict"]


def test_objects_outside_the_split_are_left_out(recording):
    grasps = load_grasps(recording)
    whole = split_of(grasps)
    found = judge(recording, Split(seed=0, train=whole.train[:2], validation=(), test=whole.test))
    assert found["grasps"] == {"train": 6, "validation": 0, "test": 9}
    assert found["frames"]["photo"]["seen"] == 6


def test_without_frames_on_one_side_there_is_nothing_to_compare(recording):
    """A model trained elsewhere: the recording holds test objects only."""
    grasps = load_grasps(recording)
    names = tuple(sorted({grasp.object_id for grasp in grasps}))
    found = judge(recording, Split(seed=0, train=(), validation=(), test=names))
    assert found["frames"]["photo"]["to_seen"] is None
    assert found["frames"]["photo"]["nearest"] == []
    assert found["clean"]
    assert "no frames of both sides to compare" in found["verdict"]
    nothing = judge(recording, Split(seed=0, train=names, validation=(), test=()))["frames"]["photo"]
    assert (nothing["test"], nothing["to_seen"], nothing["within_object"]) == (0, None, None)


def test_a_damaged_image_is_named(recording):
    train, *_ = one_of_each(recording)
    train.photo.write_bytes(b"no picture")
    with pytest.raises(ImageError, match=train.photo.name):
        judge(recording)


def test_two_runs_agree_to_the_last_digit(recording):
    assert judge(recording) == judge(recording)


def test_nearest_frames_are_those_of_two_plain_loops():
    rng = np.random.default_rng(0)
    queries, frames = rng.normal(size=(7, 12)), rng.normal(size=(11, 12))
    rows, distances = nearest(queries, frames)
    for query, row, distance in zip(queries, rows, distances, strict=True):
        plain = [np.sqrt(np.mean((query - frame) ** 2)) for frame in frames]
        assert row == int(np.argmin(plain))
        assert distance == pytest.approx(min(plain), rel=1e-12)


def test_a_copy_far_from_the_origin_has_distance_zero():
    """|a|^2 - 2ab + |b|^2 alone does not say so: of large numbers it leaves the noise of their last digits."""
    frames = 1e6 + np.random.default_rng(0).normal(size=(5, 1024))
    squares = (frames**2).sum(axis=1)
    naive = squares - 2 * np.einsum("ij,ij->i", frames, frames) + (frames * frames).sum(axis=1)
    parts = squares[:, None] - 2 * frames @ frames.T + squares
    assert max(np.abs(naive).max(), np.abs(np.diag(parts)).max()) > 0
    assert (nearest(frames, frames)[1] == 0).all()


def test_touches_that_hardly_differ_from_their_untouched_gel_are_faint_and_no_copies(tmp_path):
    folder = synthetic.write_recording(tmp_path / "recording", synthetic.make_objects(10), 3, before=True)
    for grasp in load_grasps(folder):  # pressed hard: half of the gel changes
        for touch, untouched in zip(grasp.touches, grasp.backgrounds, strict=True):
            gel = cv2.imread(str(touch))
            gel[:, : gel.shape[1] // 2] = 255 - gel[:, : gel.shape[1] // 2]
            cv2.imwrite(str(untouched), gel)
    assert judge(folder)["frames"]["touch a"]["faint"] == 0
    train, _, test = one_of_each(folder)
    gel = cv2.imread(str(train.backgrounds[0]))
    for grasp, level in ((train, 1), (test, 2)):  # the gel alone, twice: near to each other, and to their own gel
        for finger in range(2):
            cv2.imwrite(str(grasp.touches[finger]), brighter(gel, level))
            cv2.imwrite(str(grasp.backgrounds[finger]), gel)
    frames = judge(folder)["frames"]["touch a"]
    assert frames["to_seen"][0] < CLOSE_GREY_LEVELS
    assert (frames["faint"], frames["close"]) == (1, 0)
    assert test.grasp_id not in {pair["test"] for pair in frames["nearest"]}
