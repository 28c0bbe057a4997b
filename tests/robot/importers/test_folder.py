"""Importer of your own pictures, by patterns; test_importers.py tests the common behaviour."""

import os

import pytest

from robot.errors import ImporterError
from robot.importers.folder import import_folder
from tests.miniatures import picture


def ids_of(recording):
    """Return (grasp, object) in order."""
    return [(grasp.grasp_id, grasp.object_id) for grasp in recording.grasps]


def photo_of(recording, source, number):
    """Return the path of a grasp's photo in the source."""
    data = (recording.folder / recording.grasps[number].photo).read_bytes()
    (path,) = [path for path in source.rglob("*.jpg") if path.read_bytes() == data]
    return path.relative_to(source).as_posix()


def test_the_folder_names_the_object_and_its_touches_get_its_photos_cyclically(source, tmp_path):
    recording = import_folder(source, tmp_path / "out")
    assert ids_of(recording)[:3] == [("mug-1", "mug"), ("mug-2", "mug"), ("mug-10", "mug")]
    assert {grasp.object_id for grasp in recording.grasps} == {"mug", "tin can"}
    photos = [photo_of(recording, source, number) for number in range(3)]
    assert photos == ["mug/photo_1.jpg", "mug/photo_2.jpg", "mug/photo_1.jpg"]
    assert len(list((tmp_path / "out/images").iterdir())) == 6 + 4


def test_words_in_both_patterns_must_have_the_same_value(tmp_path):
    for number in (1, 2, 3):
        picture(tmp_path / f"src/day1/mug/{number}_touch.png", number)
        picture(tmp_path / f"src/day1/mug/{number}_photo.jpg", 10 + number)
    (tmp_path / "src/day1/mug/2_photo.jpg").unlink()
    options = {"touch": "{sequence}/{object}/{n}_touch", "photo": "{sequence}/{object}/{n}_photo"}
    recording = import_folder(tmp_path / "src", tmp_path / "out", **options)
    assert ids_of(recording) == [("mug-day1-1", "mug"), ("mug-day1-3", "mug")]
    assert photo_of(recording, tmp_path / "src", 1) == "day1/mug/3_photo.jpg"
    assert {grasp.sequence_id for grasp in recording.grasps} == {"day1"}
    assert recording.info["skipped"] == {"no photo matches it": 1}


def test_touches_without_photos_are_imported_with_their_sessions_in_the_order_of_their_names(tmp_path):
    for name in ("monday/1_nut_touch", "monday/2_mug_touch", "tuesday/1_mug_touch"):
        picture(tmp_path / f"src/{name}.png", len(name))
    recording = import_folder(tmp_path / "src", tmp_path / "out", touch="{session}/{n}_{object}_touch", photo="")
    assert [(grasp.object_id, grasp.session, grasp.photo) for grasp in recording.grasps] == [
        ("nut", "monday", None),
        ("mug", "monday", None),
        ("mug", "tuesday", None),
    ]


def test_fingers_are_combined_and_a_grasp_with_a_missing_finger_is_skipped(tmp_path):
    for finger in ("left", "right"):
        picture(tmp_path / f"src/rest_{finger}.png", len(finger))
        for number in (1, 2):
            picture(tmp_path / f"src/mug/touch_{number}_{finger}.png", 10 * number + len(finger))
    picture(tmp_path / "src/mug/photo_1.jpg", 5)
    (tmp_path / "src/mug/touch_2_left.png").unlink()
    options = {"touch": "{object}/touch_{n}_{finger}", "background": "rest_{finger}"}
    recording = import_folder(tmp_path / "src", tmp_path / "out", sensor="DIGIT", **options)
    (grasp,) = recording.grasps
    assert grasp.grasp_id == "mug-1"
    left = (tmp_path / "src/mug/touch_1_left.png").read_bytes()
    assert (tmp_path / "out" / grasp.touches["a"]).read_bytes() == left
    right = (tmp_path / "src/rest_right.png").read_bytes()
    assert (tmp_path / "out" / grasp.touches_before["b"]).read_bytes() == right
    assert recording.info["skipped"] == {"a finger has no picture": 1}
    assert (recording.info["sensor"], recording.info["fingers"]) == ("DIGIT", 2)
    assert recording.info["background"] != "none"


def test_a_folder_that_cannot_be_listed_is_an_error(source, tmp_path, monkeypatch):
    scandir = os.scandir

    def refusing_scandir(folder):
        if os.fspath(folder).endswith("tin can"):
            raise PermissionError(13, "Permission denied", folder)
        return scandir(folder)

    with monkeypatch.context() as patch:
        patch.setattr(os, "scandir", refusing_scandir)
        with pytest.raises(ImporterError, match="tin can cannot be listed: Permission denied"):
            import_folder(source, tmp_path / "out")


def test_a_folder_whose_name_is_not_utf8_and_the_second_picture_of_a_grasp_are_skipped(source, tmp_path):
    picture(source / "mug/touch_1.jpg", 77)
    strange = os.fsdecode(b"caf\xe9")
    picture(source / strange / "touch_1.png", 5)
    picture(source / strange / "photo_1.jpg", 6)
    recording = import_folder(source, tmp_path / "out")
    assert {grasp.object_id for grasp in recording.grasps} == {"mug", "tin can"}
    assert ids_of(recording)[0] == ("mug-1", "mug")
    assert list(recording.info["skipped"].values()) == [1, 1]
    assert "another picture of the same grasp and finger was found" in recording.info["skipped"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"touch": "{object}/gel_*"}, r"must contain a touch that matches '\{object\}/gel_\*'.*such as mug/notes\.png"),
        ({"photo": "{object}/camera_*"}, "must contain a photo that matches"),
        ({"touch": "touch_*"}, r"must contain \{object\}"),
        ({"touch": "{object}/{1}"}, "must consist of letters"),
        ({"touch": "{object}/*", "photo": "{object}/*"}, "matches both patterns"),
    ],
)
def test_invalid_patterns_are_refused(source, tmp_path, options, message):
    with pytest.raises(ImporterError, match=message):
        import_folder(source, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()
