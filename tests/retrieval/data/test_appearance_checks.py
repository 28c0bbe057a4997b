"""Checks of a recording by appearance: each planted fault is found, and a clean recording has no findings."""

import re

import cv2
import numpy as np
import pytest

from retrieval.data.check.appearance_statistics import (
    exchanged_photos,
    swapped_fingers,
    swapped_moments,
)
from retrieval.data.check.recording import check_recording
from tests import synthetic
from tests.retrieval.data.test_check import Broken, one, remarks

GRASPS = 5


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """8 objects, 5 grasps each with no-contact frames, and one miss each."""
    folder = tmp_path_factory.mktemp("clean") / "recording"
    return synthetic.write_recording(folder, synthetic.make_objects(8), GRASPS, misses=1)


@pytest.fixture
def broken(clean, tmp_path):
    return Broken(clean, tmp_path / "r")


def exchange(*columns):
    """Return a change of a line that exchanges the files of pairs of columns."""

    def change(row):
        for first, second in zip(columns[::2], columns[1::2], strict=True):
            keys = f"{first}_file_name", f"{second}_file_name"
            row[keys[0]], row[keys[1]] = row[keys[1]], row[keys[0]]

    return change


def edit(path, change):
    """Rewrite a picture in place."""
    cv2.imwrite(str(path), change(cv2.imread(str(path))))


# Clean -----------------------------------------------------------------------------------------------------


def test_a_clean_recording_has_only_notes_on_what_could_not_be_checked(clean):
    assert remarks(clean) == []
    kinds = {finding.kind for finding in check_recording(clean)}
    assert kinds <= {"drift", "unchecked-photos", "compared-copies"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 5])
def test_a_clean_simulated_recording_has_no_finding(tmp_path, seed):
    from retrieval.commands.main import main

    options = ["--objects", "5", "--grasps", "4", "--seed", str(seed), "--out", str(tmp_path / "r")]
    assert main(["collect", "--rig", "sim", *options]) == 0
    assert [finding for finding in remarks(tmp_path / "r") if finding.kind != "one-grasp"] == []


def test_a_broken_picture_of_a_rejected_grasp_is_named(broken):
    number = next(number for number, row in enumerate(broken.rows) if not row["grasped"])
    path = broken.file(number, "touch_b")
    path.write_bytes(b"no picture")
    severity, kind, message = one(broken.findings())
    assert (severity, kind) == ("error", "broken")
    assert path.name in message


# Fingers and moments ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("numbers", [[7], [0, 1, 13, 20, 33], list(range(0, 48, 3))])
def test_grasps_whose_fingers_are_swapped_are_named(broken, numbers):
    broken.change(numbers, exchange("touch_a", "touch_b", "touch_a_before", "touch_b_before"))
    touch, no_contact = broken.findings()
    for finding in (touch, no_contact):
        assert (finding.severity, finding.kind, finding.grasps) == ("error", "swapped-fingers", broken.names(numbers))
    assert touch.message.startswith(f"fingers a and b look swapped (touch) in {len(numbers)} of 48 grasps: ")


def test_similar_fingers_cannot_be_checked_and_are_not_reported_as_swapped():
    frames = np.random.default_rng(0).normal(0.5, 0.02, (2, 40, 6, 8, 3)).astype(np.float32)
    assert swapped_fingers(*frames) is None
    assert swapped_fingers(frames[0], frames[0]) is None
    assert swapped_fingers(frames[0], frames[1] + np.float32([0.1, 0, -0.1])).tolist() == []


@pytest.mark.parametrize("numbers", [[2], [0, 1, 14, 20, 33]])
def test_grasps_with_touch_and_no_contact_frame_exchanged_are_named(broken, numbers):
    broken.change(numbers, exchange("touch_a", "touch_a_before", "touch_b", "touch_b_before"))
    (finding,) = broken.findings()
    assert (finding.severity, finding.kind, finding.grasps) == ("error", "swapped-moments", broken.names(numbers))


def test_touches_and_no_contact_frames_swapped_throughout_are_found(broken):
    broken.change(range(48), exchange("touch_a", "touch_a_before", "touch_b", "touch_b_before"))
    (finding,) = broken.findings()
    assert (finding.severity, finding.kind) == ("error", "swapped-moments")
    assert "throughout" in finding.message


def test_touches_without_contact_leave_swapped_moments_undecided():
    gel = np.full((20, 6, 8, 3), 0.5, np.float32)
    noise = np.random.default_rng(0).normal(0, 0.001, (2, 20, 6, 8, 3)).astype(np.float32)
    found = swapped_moments(gel + noise[0], gel + noise[1])
    assert (found.swapped.tolist(), found.all_swapped, found.low_contact) == ([], False, 20)


# Photos ------------------------------------------------------------------------------------------


def plain_photos(seed=0):
    """Return five photos each of a red, a green and a blue patch on a grey table, each under a different light."""
    rng = np.random.default_rng(seed)
    photos, objects = [], np.repeat(np.arange(3), 5)
    for name in objects:
        photo = np.full((64, 64, 3), 0.4)
        photo[20:44, 20:44] = np.roll([0.8, 0.25, 0.15], name) * rng.uniform(0.8, 1.1)
        photos.append(np.clip(photo + rng.normal(0, 0.01, photo.shape), 0, 1))
    return np.array(photos, dtype=np.float32), objects


def test_photos_exchanged_between_two_objects_are_reported_as_a_pair():
    photos, objects = plain_photos()
    assert exchanged_photos(photos, objects).pairs == []
    assert exchanged_photos(photos, objects).distinguishable_pairs == 3
    photos[[1, 7]] = photos[[7, 1]]
    assert exchanged_photos(photos, objects).pairs == [(1, 7)]


def test_photos_of_objects_of_one_colour_cannot_be_checked():
    photos, _ = plain_photos()
    found = exchanged_photos(photos[[0, 1, 2, 3, 4] * 2], np.repeat([0, 1], 5))
    assert (found.pairs, found.distinguishable_pairs, found.all) == ([], 0, 1)
    assert exchanged_photos(photos[:6], np.repeat([0, 1], 3)).distinguishable_pairs == 0  # three photos are too few


def test_a_check_names_the_grasps_whose_photos_are_exchanged(broken):
    """Three objects with plain photos; two photos of the first and second object are exchanged."""
    broken.rows = broken.rows[: 3 * (GRASPS + 1)]
    files = [broken.file(number, "photo") for number, row in enumerate(broken.rows) if row["grasped"]]
    photos = plain_photos()[0]
    photos[[2, 8]] = photos[[8, 2]]
    for path, photo in zip(files, photos, strict=True):
        cv2.imwrite(str(path), np.rint(255 * photo[..., ::-1]).astype(np.uint8))
    found = one(finding for finding in broken.findings() if finding.kind == "exchanged-photos")
    first, second = broken.rows[2]["grasp_id"], broken.rows[9]["grasp_id"]
    assert found[0] == "warning"
    assert "the photos of 1 pair(s) of grasps look exchanged between two objects: " in found[2]
    assert (first in found[2], second in found[2]) == (True, True)


# Copies ----------------------------------------------------------------------------------------------------


def test_a_touch_made_from_its_own_photo_is_named(broken):
    numbers = [1, 9, 26]
    for number in numbers:
        photo = cv2.resize(cv2.imread(str(broken.file(number, "photo"))), (160, 120), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(broken.file(number, "touch_b")), photo)
    found = [finding for finding in broken.findings() if finding.kind in ("same-modality", "swapped-fingers")]
    assert {finding.severity for finding in found} == {"error"}
    assert {name for finding in found for name in finding.grasps} == set(broken.names(numbers))


COPIES = {
    "JPEG 20": lambda image: cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 20])[1], 1),
    "gain 1.1": lambda image: np.clip(np.rint(1.1 * image), 0, 255).astype(np.uint8),
    "2 px": lambda image: cv2.warpAffine(
        image, np.float32([[1, 0, 2], [0, 1, -2]]), image.shape[1::-1], borderMode=cv2.BORDER_REFLECT
    ),
    "mirrored": lambda image: image[:, ::-1],
    "upside down": lambda image: image[::-1],
}


GENTLE = ("gain 1.1", "mirrored", "upside down")


def found_in(how):
    """Return the kinds of pictures with found copies; stronger changes erase the fine relief of the drawn touches."""
    return {"photo", "touch a", "touch b"} if how in GENTLE else {"photo"}


@pytest.mark.parametrize("how", COPIES)
def test_near_copies_of_another_object_are_named(broken, how):
    for column in ("photo", "touch_a", "touch_b"):
        copy = COPIES[how](cv2.imread(str(broken.file(3, column))))
        cv2.imwrite(str(broken.file(20, column)), copy)
    found = [finding for finding in broken.findings() if finding.kind == "near-copy"]
    for finding in found:
        assert finding.severity == ("error" if "(photo)" in finding.message else "warning")
    assert {
        kind for kind in ("photo", "touch a", "touch b") if any(f"({kind})" in one.message for one in found)
    } >= found_in(how)
    for finding in found:
        assert set(finding.message.split(": ")[1].split(" and ")) == set(broken.names((3, 20)))
    (note,) = (finding for finding in check_recording(broken.folder) if finding.kind == "compared-copies")
    assert "(touch a)" in note.message


@pytest.mark.parametrize("by", [(6, 6), (-6, 5), (0, 6)])
def test_a_photo_moved_by_several_pixels_is_a_near_copy(broken, by):
    """Photos have 120 x 160 pixels: a sixteenth of the side is 7 pixels."""
    image = cv2.imread(str(broken.file(3, "photo")))
    padded = np.pad(image, ((8, 8), (8, 8), (0, 0)), "edge")
    height, width = image.shape[:2]
    copy = padded[8 - by[0] : 8 - by[0] + height, 8 - by[1] : 8 - by[1] + width]
    cv2.imwrite(str(broken.file(20, "photo")), copy)
    (found,) = (finding for finding in broken.findings() if finding.kind == "near-copy")
    assert found.severity == "error"
    assert set(found.message.split(": ")[1].split(" and ")) == set(broken.names((3, 20)))


def test_the_last_note_counts_the_pictures_compared_for_copies_and_explains_the_others(broken, capsys):
    """Touches hardly differ from the no-contact frame, each with its own noise; two files are broken."""
    from retrieval.commands.main import main

    rng = np.random.default_rng(0)
    gel = cv2.imread(str(broken.file(0, "touch_a_before")))
    total = 8 * GRASPS
    for number in [number for number, row in enumerate(broken.rows) if row["grasped"]]:
        noisy = np.clip(gel + rng.normal(0, 1.5, gel.shape), 0, 255).astype(np.uint8)
        cv2.imwrite(str(broken.file(number, "touch_a")), noisy)
    accepted = [number for number, row in enumerate(broken.rows) if row["grasped"]]
    for number in accepted[:2]:
        broken.file(number, "photo").write_bytes(b"no picture")
    main(["check", str(broken.folder)])
    last = capsys.readouterr().err.splitlines()[-2]
    assert last.startswith(f"{broken.folder}: ")
    assert re.search(rf"searched for in \d+ of {total} images \(photo\), 0 of {total} images \(touch a\)", last)
    assert "show too little to recognise a copy (little contact, or too many similar pictures)" in last
    assert "6 belong to grasps that are named above" in last
