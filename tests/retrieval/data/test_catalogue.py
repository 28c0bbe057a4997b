"""Listing a catalogue folder and its metadata."""

import io
import json
import os

import pytest
from PIL import Image

from retrieval.data.camera import PhotoCamera, stated_camera
from retrieval.data.catalogue import SkippedPhoto, list_catalogue
from retrieval.data.images import EXTENSIONS
from retrieval.data.naming import Naming
from retrieval.errors import DatasetError


def photo(colour=(255, 0, 0)):
    buffer = io.BytesIO()
    Image.new("RGB", (2, 1), colour).save(buffer, "PNG")
    return buffer.getvalue()


def fill(folder, *paths):
    """Write a small picture, or other content if the extension is of another kind, at every path below `folder`."""
    for path in paths:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        is_picture = (folder / path).suffix.lower() in EXTENSIONS
        (folder / path).write_bytes(photo() if is_picture else b"other content")
    return folder


def write_metadata(folder, *rows):
    lines = [row if isinstance(row, str) else json.dumps(row) for row in rows]
    (folder / "metadata.jsonl").write_text("\n".join(lines) + "\n", "utf-8")
    return folder


def found(folder):
    return {item.path: item.object_id for item in list_catalogue(folder).photos}


def test_the_first_folder_or_the_file_name_names_the_object(tmp_path):
    fill(tmp_path, "mug/2.jpg", "mug/1.png", "cup.webp", "red ball/side/deep/x.PNG", "v1.2.tif", "a.JpEg", "b.HEIC")
    assert found(tmp_path) == {
        "a.JpEg": "a",
        "b.HEIC": "b",
        "cup.webp": "cup",
        "mug/1.png": "mug",
        "mug/2.jpg": "mug",
        "red ball/side/deep/x.PNG": "red ball",
        "v1.2.tif": "v1.2",
    }


def test_photos_are_sorted_by_id_which_is_their_path_in_the_catalogue(tmp_path, monkeypatch):
    fill(tmp_path / "one", "b/1.png", "a/2.png", "a/10.png", "a.png")
    assert list(found(tmp_path / "one")) == ["a.png", "a/10.png", "a/2.png", "b/1.png"]
    (tmp_path / "one").rename(tmp_path / "two")
    (tmp_path / "link").symlink_to(tmp_path / "two")
    monkeypatch.chdir(tmp_path)
    assert found("two") == found(tmp_path / "two") == found("link")
    assert list_catalogue("two").object_ids == ("a", "b")  # a has a folder and a file


def test_other_files_are_ignored_or_skipped_with_a_reason_and_dotfiles_not_listed(tmp_path):
    fill(tmp_path, "mug/1.png", "mug/notes.txt", "readme", ".DS_Store", "mug/.hidden.png", ".git/x.png", "cup/2.DNG")
    catalogue = list_catalogue(write_metadata(tmp_path, {"object_id": "mug"}))
    assert [item.path for item in catalogue.photos] == ["mug/1.png"]
    assert catalogue.ignored == ("mug/notes.txt", "readme")
    assert catalogue.skipped == (SkippedPhoto("cup/2.DNG", ".dng pictures are not read: save it as PNG or JPEG"),)


def test_what_an_index_and_the_history_of_its_service_contain_is_no_part_of_the_catalogue(tmp_path):
    own = "index/CURRENT", "index/views.png", "index/gen-1/rows.jsonl", "shards/SHARDS.json", "shards/enrolled/x/1.png"
    fill(tmp_path, "mug/1.png", *own, "index-history/history.sqlite", "index-history/recording/images/a.png")
    catalogue = list_catalogue(tmp_path)
    assert ([item.path for item in catalogue.photos], catalogue.ignored, catalogue.notes) == (["mug/1.png"], (), ())


def test_a_missing_folder_a_file_and_an_empty_folder_give_different_errors(tmp_path):
    fill(tmp_path, "file.png")
    (tmp_path / "empty" / "mug").mkdir(parents=True)
    fill(tmp_path / "wrong", "a.gif", "b.txt")
    for name, message in {
        "none": r"does not exist: put photos in <object_id>/<photo>",
        "file.png": "is a file",
        "empty": r"no photo \(\.avif, \.bmp, .*/empty: put",
        "wrong": r"only 1 other file\(s\) such as b\.txt; a\.gif: \.gif pictures are not read",
    }.items():
        with pytest.raises(DatasetError, match=message):
            list_catalogue(tmp_path / name)


def test_a_naming_names_objects_and_skips_photos_that_do_not_fit(tmp_path):
    fill(tmp_path, "train/mug/0.png", "train/mug/1.png", "test/cup/0.png", "cover.png", "train/notes.txt")
    catalogue = list_catalogue(tmp_path, Naming("{split}/{object}/{photo}"))
    assert {item.path: item.object_id for item in catalogue.photos} == {
        "test/cup/0.png": "cup",
        "train/mug/0.png": "mug",
        "train/mug/1.png": "mug",
    }
    assert catalogue.skipped == (SkippedPhoto("cover.png", "does not fit --objects-from {split}/{object}/{photo}"),)
    assert catalogue.ignored == ("train/notes.txt",)
    with pytest.raises(DatasetError, match=r"fits --objects-from stem; the first of 2: cup/0\.png"):
        list_catalogue(fill(tmp_path / "none", "mug/0.png", "cup/0.png"), Naming("stem"))


def test_links_to_outside_folders_are_followed_once_and_loops_do_not_hang(tmp_path):
    root, outside = fill(tmp_path / "c", "mug/1.png", "cup/1.png"), fill(tmp_path / "o", "1.png")
    (root / "mug" / "up").symlink_to(root)
    (root / "mug" / "across").symlink_to(root / "cup")
    (root / "self").symlink_to(root / "self")
    (root / "top").symlink_to("/")
    (root / "out").symlink_to(outside)
    (root / "same").symlink_to(outside)
    (outside / "again").symlink_to(outside)
    (outside / "back").symlink_to(root)
    catalogue = list_catalogue(root)
    assert [item.path for item in catalogue.photos] == ["cup/1.png", "mug/1.png", "out/1.png"]
    skipped = {item.path: item.reason for item in catalogue.skipped}
    assert set(skipped) == {"mug/across", "mug/up", "out/again", "out/back", "same", "top"}
    assert "another link has listed" in skipped["same"]
    assert catalogue.ignored == ("self",)


def test_a_name_that_is_not_utf8_is_skipped_and_reported(tmp_path):
    fill(tmp_path, "mug/1.png", "mug/größe.png")
    try:
        (tmp_path / "mug" / os.fsdecode(b"\xff.png")).write_bytes(photo())
    except OSError:
        pytest.skip("this file system takes no such name")
    catalogue = list_catalogue(tmp_path)
    assert [item.path for item in catalogue.photos] == ["mug/1.png", "mug/größe.png"]
    assert catalogue.skipped == (SkippedPhoto("mug/\\xff.png", "the name is not valid UTF-8; rename it"),)
    json.dumps([item.path for item in catalogue.skipped], ensure_ascii=False).encode()


def test_a_photos_own_metadata_takes_precedence_over_its_objects(tmp_path):
    fill(tmp_path, "mug/1.png", "mug/2.png", "cup.png")
    write_metadata(
        tmp_path,
        {"object_id": "mug", "price": 5, "colour": "red"},
        "",
        {"file_name": "mug/2.png", "colour": "blue", "tags": ["a", {"b": None}]},
        {"file_name": "./cup.png", "object_id": "cup", "name": "Straße \U0001f600"},
    )
    catalogue = list_catalogue(tmp_path)
    assert {item.path: item.metadata for item in catalogue.photos} == {
        "cup.png": {"name": "Straße \U0001f600"},
        "mug/1.png": {"price": 5, "colour": "red"},
        "mug/2.png": {"price": 5, "colour": "blue", "tags": ["a", {"b": None}]},
    }
    assert catalogue.notes == ()


def test_metadata_goes_to_objects_by_the_same_naming(tmp_path):
    fill(tmp_path, "mug_0.png", "mug_1.png")
    write_metadata(
        tmp_path, {"object_id": "mug", "price": 5}, {"file_name": "mug_1.png", "object_id": "mug", "colour": "red"}
    )
    found = {item.path: item.metadata for item in list_catalogue(tmp_path, Naming("stem")).photos}
    assert found == {"mug_0.png": {"price": 5}, "mug_1.png": {"price": 5, "colour": "red"}}
    with pytest.raises(DatasetError, match=r"mug_1\.png belongs to object mug_1, but the line names mug"):
        list_catalogue(tmp_path)


def test_metadata_of_a_missing_photo_or_object_is_a_note_and_no_error(tmp_path):
    write_metadata(fill(tmp_path, "mug/1.png"), {"file_name": "mug/9.png"}, {"object_id": "cup"})
    notes = list_catalogue(tmp_path).notes
    assert notes == (
        "metadata.jsonl names mug/9.png, which is not in the catalogue",
        "metadata.jsonl names cup, which is not in the catalogue",
    )
    write_metadata(fill(tmp_path, "cover.png"), {"file_name": "cover.png"})
    assert "metadata.jsonl names cover.png" in list_catalogue(tmp_path, Naming("{object}/{photo}")).notes[0]


BAD_LINES = {
    '{"object_id": "mug"': "truncated",
    '{"price": 5}': "must name a photo .*it has price",
    '{"object_id": 5}': "object_id must be a non-empty string, got 5",
    '{"object_id": "mug", "x": NaN}': "malformed",
    '{"object_id": "first"}': "first has two lines; merge them",
    '{"object_id": ' + "[" * 100_000: "nested too deep",
    r'{"object_id": "mug", "deep": [{"\udfff": 1}]}': "surrogate|malformed|truncated",
}


@pytest.mark.parametrize("line", BAD_LINES, ids=BAD_LINES.values())
def test_a_bad_metadata_line_is_named_by_its_number(tmp_path, line):
    write_metadata(fill(tmp_path, "mug/1.png"), {"object_id": "first"}, line)
    with pytest.raises(DatasetError, match=r"metadata\.jsonl, line 2: .*" + BAD_LINES[line]) as caught:
        list_catalogue(tmp_path)
    assert caught.value.exit_code == 2


def test_metadata_that_is_not_utf8_is_an_error(tmp_path):
    (fill(tmp_path, "mug/1.png") / "metadata.jsonl").write_bytes(b'{"object_id": "\xff"}\n')
    with pytest.raises(DatasetError, match="line 1: "):
        list_catalogue(tmp_path)


@pytest.mark.parametrize(
    ("paths", "touches", "rule"),
    [
        (["mug/1.jpg", "mug/touch_0_b.png", "mug/touch_0_a.png"], ["mug: mug/touch_0_a.png mug/touch_0_b.png"], ""),
        (["mug/second/touch_rim_left_a.jpg"], ["mug: mug/second/touch_rim_left_a.jpg"], ""),
        (["mug/touch_a.png", "mug/touch_b.png"], ["mug: mug/touch_a.png", "mug: mug/touch_b.png"], ""),  # no fingers
        (["touch_7.png", "mug/touched.png", "touch_1/view.png", "tin/touch.jpg"], [], ""),  # photos
        (["all/touch_1.png"], [], "stem"),  # every picture is a photo if file stems name the objects
        (["test/mug/touch_1.png"], ["mug: test/mug/touch_1.png"], "{split}/{object}/{photo}"),
    ],
)
def test_gel_images_next_to_photos_are_touches_and_the_file_name_gives_touch_and_finger(tmp_path, paths, touches, rule):
    found = list_catalogue(fill(tmp_path, *paths), Naming(rule or "folder"))
    assert [f"{touch.object_id}: {' '.join(touch.paths)}" for touch in found.touches] == touches
    assert sorted(found.paths) == sorted(paths)


def test_objects_may_have_only_touches_and_these_have_metadata(tmp_path):
    found = list_catalogue(write_metadata(fill(tmp_path, "mug/touch_1.png"), {"object_id": "mug", "shelf": 3}))
    assert (len(found.photos), found.object_ids, found.notes) == (0, ("mug",), ())
    assert found.touches[0].metadata == {"shelf": 3}


def test_the_camera_of_a_photo_is_its_own_its_objects_or_that_of_all_photos(tmp_path):
    fill(tmp_path, "mug/0.jpg", "mug/1.jpg", "cup/0.jpg", "tin/0.jpg")
    write_metadata(
        tmp_path,
        {"field_mm": 320, "roll_deg": 90},
        {"object_id": "mug", "field_mm": 200},
        {"file_name": "mug/1.jpg", "field_mm": 150.5, "roll_deg": 0},
        {"object_id": "tin", "price": 5},
    )
    catalogue = list_catalogue(tmp_path)
    cameras = {photo.path: stated_camera(photo.metadata, PhotoCamera(1, 2)) for photo in catalogue.photos}
    assert cameras == {"cup/0.jpg": (320, 90), "mug/0.jpg": (200, 90), "mug/1.jpg": (150.5, 0), "tin/0.jpg": (320, 90)}
    assert catalogue.notes == ()


def test_what_is_not_stated_of_a_camera_is_assumed(tmp_path):
    write_metadata(fill(tmp_path, "mug/0.jpg", "cup/0.jpg"), {"object_id": "mug", "roll_deg": 0})
    cup, mug = list_catalogue(tmp_path).photos
    assert [stated_camera(each.metadata, PhotoCamera(400, 90)) for each in (mug, cup)] == [(400, 0), (400, 90)]


@pytest.mark.parametrize(
    ("key", "value", "what"),
    [
        *(("field_mm", value, "the millimetres") for value in ("0.2", "5", '"190"', "true", "1e5")),
        ("roll_deg", "270", "the degrees"),
    ],
)
def test_values_of_a_camera_that_are_impossible_are_refused(tmp_path, key, value, what):
    fill(tmp_path, "mug/0.jpg")
    (tmp_path / "metadata.jsonl").write_text(f'{{"{key}": {value}}}')
    with pytest.raises(DatasetError, match=rf"mug/0\.jpg: {key} must be {what}"):
        list_catalogue(tmp_path)
