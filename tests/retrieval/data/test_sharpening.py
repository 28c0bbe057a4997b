"""The blur of a photo is measured and removed."""

import math

import cv2
import numpy as np
import pytest
from PIL import Image

from retrieval.data.object_finder import FoundObject
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.sharpening import BLURRED_PX, blur_px, sharpen
from tests.retrieval.data.simulated import photo_of

OBJECT = FoundObject(60, 60, 200, 200, 140 * 140)


def a_box(side=256):
    photo = np.full((side, side, 3), 0.2, np.float32)
    photo[side // 4 : 3 * side // 4, side // 4 : 3 * side // 4] = 0.8
    return photo


def blurred(photo, sigma):
    return cv2.GaussianBlur(photo, (0, 0), sigma)


@pytest.mark.parametrize("sigma", [1.0, 1.5, 2.5])
def test_the_blur_is_measured_at_an_edge(sigma):
    sobel_px = 0.75  # the blur of the operator itself
    assert blur_px(blurred(a_box(), sigma), OBJECT) == pytest.approx(math.hypot(sigma, sobel_px), rel=0.05)


def test_the_blur_of_a_large_photo_is_in_pixels_of_a_view():
    large = cv2.resize(blurred(a_box(), 2.0), (1024, 1024))
    assert blur_px(large, OBJECT.scaled(4)) == pytest.approx(math.hypot(2.0, 0.75), rel=0.1)


@pytest.mark.parametrize("factor", [1, 4])
def test_a_blurred_photo_is_nearer_to_the_sharp_one_after_it_was_sharpened(factor):
    sharp, found = photo_of(0)
    soft = blurred(sharp, 1.5)
    soft_large = cv2.resize(soft, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    made, box = sharpen(soft_large, found.scaled(factor), blur_px(soft_large, found.scaled(factor)), is_lossy=False)
    made = cv2.resize(made, sharp.shape[:2], interpolation=cv2.INTER_AREA)
    assert box.side / len(soft_large) <= found.side / len(sharp)
    left, top, right, bottom = map(int, found[:4])
    before, after = (np.abs(each - sharp)[top:bottom, left:right].mean() for each in (soft, made))
    assert after < 0.7 * before


def test_an_ordinary_photo_stays_as_it_is():
    photo, found = photo_of(0)
    measured = blur_px(photo, found)
    assert measured < BLURRED_PX
    assert sharpen(photo, found, measured, is_lossy=False)[0] is photo


def test_artefacts_of_a_compressed_photo_are_not_amplified(tmp_path):
    sharp, _ = photo_of(0)
    soft = np.rint(255 * blurred(sharp, 1.5)).astype(np.uint8)
    Image.fromarray(soft).save(tmp_path / "soft.png")
    Image.fromarray(soft).save(tmp_path / "soft.jpg", quality=75)
    settings = Preprocessing(photo_px=160, views=("grey",))
    expected = settings.photo(sharp)
    errors = {name: np.abs(settings.load_photo(tmp_path / name) - expected).mean() for name in ("soft.png", "soft.jpg")}
    assert errors["soft.jpg"] < 1.5 * errors["soft.png"]


def test_a_plain_photo_is_not_changed_into_nothing():
    photo = np.full((64, 64, 3), 0.5, np.float32)
    found = FoundObject(10, 10, 50, 50, 1600)
    np.testing.assert_allclose(sharpen(photo, found, blur_px(photo, found), is_lossy=True)[0], photo, atol=1e-5)
