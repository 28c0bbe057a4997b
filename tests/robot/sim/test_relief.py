"""Relief families on an unrolled wall: range, seam, pitch, direction, edges."""

import cv2
import numpy as np
import pytest

from robot.sim.objects.relief import RELIEFS, Relief, Sheet

SHEET = Sheet(120.0, 60.0, 401, 800)
NOT_SMOOTH = [name for name in RELIEFS if name != "smooth"]


def height(name, sheet=SHEET, **settings):
    return Relief(name, **{"amplitude_mm": 1.0, "pitch_mm": 6.0, "seed": 3, **settings}).height(sheet)


@pytest.mark.parametrize("name", NOT_SMOOTH)
def test_heights_use_most_of_the_amplitude_and_meet_at_the_seam(name):
    for settings in ({}, {"angle_rad": 0.6, "aspect": 1.7, "sharpness": 0.8}):
        found = height(name, amplitude_mm=0.8, **settings)
        assert (found.shape, found.dtype) == ((401, 800), np.float32)
        assert found.min() >= 0
        assert found.max() <= 0.8 + 1e-6
        assert np.ptp(found) > 0.4
        across = np.abs(np.diff(found, axis=1)).max()
        assert np.abs(found[:, 0] - found[:, -1]).max() <= 1.3 * across + 1e-3, settings


@pytest.mark.parametrize("name", NOT_SMOOTH)
def test_a_relief_depends_on_its_seed_and_pitch_and_not_on_the_number_of_threads(name):
    threads, found = cv2.getNumThreads(), []
    try:
        for number in (1, 2, 3):
            cv2.setNumThreads(number)
            found.append(height(name))
    finally:
        cv2.setNumThreads(threads)
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_array_equal(found[2], found[0])
    assert np.abs(found[0] - height(name, pitch_mm=9.0, seed=4)).max() > 0.1


def test_ribs_repeat_after_their_pitch_in_their_direction():
    found = height("ribs", pitch_mm=6.0, angle_rad=0.0)
    np.testing.assert_allclose(found[:, 0], found[:, 40], atol=1e-4)  # 40 nodes of 0.15 mm are 6 mm
    assert np.ptp(found, axis=0).max() < 1e-4
    upright = height("ribs", pitch_mm=6.0, angle_rad=np.pi / 2)
    np.testing.assert_allclose(upright[0], upright[40], atol=1e-4)
    assert np.ptp(upright, axis=1).max() < 1e-4


def test_glyphs_can_be_read_from_outside():
    """An L on an unrolled wall has its foot to the right of its stem, and at the bottom."""
    sheet = Sheet(30.0, 16.0, 161, 300)

    class Only:
        def choice(self, letters, count):
            return ["L"] * count

    image = RELIEFS["glyphs"](Relief("glyphs", 1.0, 10.0), sheet, Only())
    rows = image.mean(axis=1)
    inked = np.flatnonzero(rows > 0.02)
    assert rows[inked[0] : inked[0] + 12].max() > 1.8 * rows[inked[0] + 40 : inked[0] + 60].max()
    stem = image[inked[0] + 50] > 0.5
    foot = image[inked[0] + 10] > 0.5
    start = np.flatnonzero(stem)[0]
    assert foot[start + 40]
    assert not stem[start + 40]
