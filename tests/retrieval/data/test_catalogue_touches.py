"""Touches in a catalogue: their files, objects and finger order."""

import pytest

from retrieval.data.catalogue import CatalogueTouch, list_catalogue
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
    ("paths", "touches"),
    [
        (["mug/touch_7.png", "mug/touch_7_b.png"], [("mug/touch_7.png", "mug/touch_7_b.png")]),
        (["mug/second/touch_rim_left_a.jpg"], [("mug/second/touch_rim_left_a.jpg",)]),
        (["mug/touch_a.png", "mug/touch_b.png"], [("mug/touch_a.png",), ("mug/touch_b.png",)]),  # names, not fingers
        (["touch_7.png", "mug/touched.png", "touch_1/view.png"], []),  # photos
    ],
)
def test_the_file_name_gives_touch_and_finger(tmp_path, paths, touches):
    found = listed(tmp_path, *paths)
    assert [touch.paths for touch in found.touches] == touches
    assert sorted(found.paths) == sorted(paths)


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
