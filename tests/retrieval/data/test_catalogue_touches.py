"""Touches in a catalogue: their files, objects and finger order."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from retrieval.data.catalogue import CatalogueTouch, group_touches, list_catalogue, touch_name
from retrieval.data.naming import Naming
from retrieval.errors import DatasetError

FOLDER = Naming()


def listed(tmp_path, *names, metadata=b"", naming=FOLDER):
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "metadata.jsonl").write_bytes(metadata)
    return list_catalogue(tmp_path, naming)


def test_gel_images_next_to_photos_are_touches_and_not_photos(tmp_path):
    found = listed(
        tmp_path, "mug/1.jpg", "mug/touch_0_b.png", "mug/touch_0_a.png", "mug/touch_1_a.png", "tin/touch.jpg"
    )
    assert [photo.path for photo in found.photos] == ["mug/1.jpg", "tin/touch.jpg"]
    assert found.touches == (
        CatalogueTouch("mug", ("mug/touch_0_a.png", "mug/touch_0_b.png")),
        CatalogueTouch("mug", ("mug/touch_1_a.png",)),
    )


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("mug/touch_7.png", ("mug/touch_7", "")),
        ("mug/touch_7_b.png", ("mug/touch_7", "b")),
        ("mug/second/touch_rim_left_a.jpg", ("mug/second/touch_rim_left", "a")),
        ("mug/touch_a.png", ("mug/touch_a", "")),  # the name of a touch is never empty
        ("touch_7.png", None),  # the only photo of an object of that name
        ("mug/touched.png", None),
        ("touch_1/view.png", None),
    ],
)
def test_the_file_name_gives_touch_and_finger(path, name):
    assert touch_name(path, FOLDER) == name


def test_every_picture_is_a_photo_if_file_stems_name_the_objects(tmp_path):
    found = listed(tmp_path, "all/touch_1.png", naming=Naming("stem"))
    assert [photo.object_id for photo in found.photos] == ["touch"]
    assert found.touches == ()


def test_a_pattern_names_the_object_of_a_touch(tmp_path):
    found = listed(tmp_path, "test/mug/touch_1.png", naming=Naming("{split}/{object}/{photo}"))
    assert [touch.object_id for touch in found.touches] == ["mug"]


def test_objects_may_have_only_touches_and_these_have_metadata(tmp_path):
    found = listed(tmp_path, "mug/touch_1.png", metadata=b'{"object_id": "mug", "shelf": 3}\n')
    assert (len(found.photos), found.object_ids, found.notes) == (0, ("mug",), ())
    assert found.touches[0].metadata == {"shelf": 3}


def test_a_folder_without_photos_and_touches_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(DatasetError, match="no photo"):
        list_catalogue(tmp_path)


@given(st.lists(st.from_regex(r"[a-c]{1,2}/(touch_[0-9_a-c]{0,4})\.png", fullmatch=True), unique=True, max_size=20))
def test_every_gel_image_belongs_to_exactly_one_touch(paths):
    images = [(path, path.split("/")[0]) for path in paths]
    assert sorted(path for touch in group_touches(images, FOLDER) for path in touch.paths) == sorted(paths)
