"""The camera that is assumed for the photos of a catalogue."""

import numpy as np
import pytest
from PIL import Image

from retrieval.data.camera import FEWEST, USUAL_CAMERA, PhotoCamera
from retrieval.data.camera import assumed_camera as camera_of
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.views import FIELD_MM
from tests.retrieval.data.simulated import photo_of, rolled, square


def write(folder, photos):
    """Write photos into a new folder, and return their files."""
    folder.mkdir()
    for number, photo in enumerate(photos):
        Image.fromarray(photo).save(folder / f"{number:02}.png")
    return sorted(folder.iterdir())


def squares(folder, share, count=FEWEST):
    return write(folder, [square(number, share) for number in range(count)])


def turned_photos(folder, roll_deg):
    return write(folder, [rolled(number, roll_deg) for number in range(FEWEST)])


def assumed_camera(photos):
    """Return the camera of photos of an object each, nothing stated."""
    return camera_of((path.stem, path, ()) for path in photos)


@pytest.mark.parametrize(("share", "factor"), [(0.32, 1), (0.16, 2), (0.64, 0.5)])
def test_objects_of_half_the_usual_size_are_photographed_with_twice_the_field(tmp_path, share, factor):
    assumed = assumed_camera(squares(tmp_path / "photos", share))
    assert assumed.field_mm == pytest.approx(FIELD_MM * factor, rel=0.2)


def test_few_objects_or_a_small_difference_do_not_change_the_camera(tmp_path):
    assert assumed_camera(squares(tmp_path / "nearly", 0.38)) == USUAL_CAMERA
    few = squares(tmp_path / "few", 0.16, FEWEST - 1)
    assert camera_of((path.stem, path, ()) for path in [*few, *few]) == USUAL_CAMERA
    assert assumed_camera([]) == USUAL_CAMERA


def test_what_was_assumed_stays_when_an_object_is_removed_but_not_when_all_photos_state_it(tmp_path):
    few, before = squares(tmp_path / "few", 0.16, FEWEST - 1), PhotoCamera(380, 90)
    assert camera_of(((path.stem, path, ()) for path in few), before) == before
    assert camera_of(((path.stem, path, {"roll_deg"}) for path in few), before) == (380, 0)


def test_the_next_photo_of_an_object_stands_in_for_one_that_cannot_be_read(tmp_path):
    photos = squares(tmp_path / "photos", 0.16)
    damaged = tmp_path / "damaged.png"
    damaged.write_text("no picture")
    listed = [(photos[0].stem, damaged, ()), *((path.stem, path, ()) for path in photos)]
    assert camera_of(listed).field_mm == 2 * FIELD_MM
    assert camera_of(listed[:-1]) == USUAL_CAMERA


def test_photos_whose_field_is_stated_do_not_tell_that_of_the_others(tmp_path):
    far, usual = squares(tmp_path / "far", 0.16), squares(tmp_path / "usual", 0.32, 5)
    listed = [(path.stem, path, {"field_mm"}) for path in far] + [(f"usual {path.stem}", path, ()) for path in usual]
    assert camera_of(listed).field_mm == FIELD_MM


@pytest.mark.parametrize("roll_deg", [0, 90, 180, -90, 50])
def test_the_roll_that_all_photos_share_is_found(tmp_path, roll_deg):
    photos = turned_photos(tmp_path / "photos", roll_deg)
    assert abs(assumed_camera(photos).roll_deg) == pytest.approx(abs(roll_deg), abs=8)


def test_the_views_of_turned_photos_are_those_of_the_upright_ones(tmp_path):
    settings = Preprocessing(photo_px=64, views=("crop", "grey"))
    errors = []
    for number, path in enumerate(turned_photos(tmp_path / "photos", 90)):
        views = settings.load_photo(path, PhotoCamera(roll_deg=90))
        errors.append(np.abs(views - settings.photo(photo_of(number)[0])).mean())
    assert np.median(errors) < 0.01
