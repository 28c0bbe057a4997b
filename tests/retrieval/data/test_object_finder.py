"""The object's place in a photo, from the mask of a network."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from retrieval.data.object_finder import FoundObject, ObjectFinder, find_object, whole_photo

PHOTO = np.zeros((300, 600, 3), np.uint8)


def finder_with(monkeypatch, *regions):
    """Return a finder whose network marks these regions (top, bottom, left, right, logit) of its 64 x 64 mask."""
    logits = np.full((64, 64), -5, np.float32)
    for top, bottom, left, right, logit in regions:
        logits[top:bottom, left:right] = logit
    monkeypatch.setattr(ObjectFinder, "logits", lambda self, photo: logits)
    return ObjectFinder()


def test_box_and_area_are_in_the_pixels_of_the_photo(monkeypatch):
    found = finder_with(monkeypatch, (16, 48, 24, 40, 5)).find(PHOTO)
    assert found[:4] == pytest.approx((225, 75, 375, 225), abs=3)
    assert found.area == pytest.approx(150 * 150, rel=0.03)
    assert found.scaled(2) == pytest.approx((*(2 * edge for edge in found[:4]), 4 * found.area))


def test_parts_of_an_object_count_together_and_other_things_at_the_margin_do_not(monkeypatch):
    parts = (20, 30, 20, 30, 5), (34, 44, 34, 44, 5)
    both = finder_with(monkeypatch, *parts).find(PHOTO)
    assert both[:4] == pytest.approx((20 * 600 / 64, 20 * 300 / 64, 44 * 600 / 64, 44 * 300 / 64), abs=3)
    assert finder_with(monkeypatch, *parts, (0, 10, 0, 10, 5), (50, 64, 50, 64, 0.2)).find(PHOTO) == pytest.approx(both)


def test_specks_are_no_object(monkeypatch):
    assert finder_with(monkeypatch, (20, 21, 20, 21, 5), (40, 41, 50, 51, 5)).find(PHOTO) == whole_photo(PHOTO)
    assert whole_photo(PHOTO) == FoundObject(0, 0, 600, 300, 600 * 300)


def test_several_threads_find_the_same():
    photo = np.full((128, 128, 3), 200, np.uint8)
    photo[40:100, 50:90] = (20, 60, 160)
    with ThreadPoolExecutor(4) as pool:
        assert set(pool.map(find_object, [photo] * 12)) == {find_object(photo)}
