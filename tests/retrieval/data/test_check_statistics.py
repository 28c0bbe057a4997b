"""Statistics of the checks of a recording, compared with plain loops and with hand-made images."""

import cv2
import numpy as np
import pytest

from retrieval.data.check.appearance import CHANGES, changed_layout, swapped_fingers
from retrieval.data.check.drift import nearest_grasp_accuracy
from tests.data import touch_data


def test_similar_fingers_cannot_be_checked_and_are_not_reported_as_swapped():
    frames = np.random.default_rng(0).normal(0.5, 0.02, (2, 40, 6, 8, 3)).astype(np.float32)
    assert swapped_fingers(*frames) is None
    assert swapped_fingers(frames[0], frames[0]) is None
    assert swapped_fingers(frames[0], frames[1] + np.float32([0.1, 0, -0.1])).tolist() == []


def gels(count=20):
    """Red is bright above, blue on the right; contact and noise have a tenth of this contrast."""
    down, right = np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 1, 8), indexing="ij")
    layout = np.stack([1 - 0.8 * down, np.full((6, 8), 0.4), 0.6 * right], axis=-1)
    return (layout + 0.05 * np.random.default_rng(0).standard_normal((count, 6, 8, 3))).astype(np.float32)


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("rows", [[3], [4, 6, 8, 10, 12, 14, 16, 18, 19]])
def test_a_minority_of_changed_images_is_named_with_its_change(change, rows):
    images = gels()
    images[rows] = images[rows][CHANGES[change]]
    found = changed_layout(images)
    assert (found[0], found[1].tolist()) == (change, rows)


def grey_with_noise():
    grey = np.repeat(gels()[..., :1], 3, axis=-1)
    return (grey + 0.01 * np.random.default_rng(1).standard_normal(grey.shape)).astype(np.float32)


def some_of_another_sensor():
    """Each difference of red and blue has the other sign, but no change makes them fit."""
    images = gels()
    images[:5] = 1 - images[:5]
    return images


@pytest.mark.parametrize("images", [gels, lambda: gels()[..., ::-1], grey_with_noise, some_of_another_sensor])
def test_unchanged_images_and_images_that_cannot_be_checked_give_nothing(images):
    assert changed_layout(images()) is None


def test_real_touches_with_exchanged_channels_are_found_and_unchanged_ones_are_not():
    paths = sorted(touch_data("billets").glob("*/*_touch.png"))
    images = np.array([cv2.resize(cv2.imread(str(path)), (8, 6), interpolation=cv2.INTER_AREA) for path in paths]) / 255
    images = images[..., ::-1].astype(np.float32)
    assert changed_layout(images) is None
    images[40:50] = images[40:50, ..., ::-1]
    assert changed_layout(images)[1].tolist() == list(range(40, 50))


def test_equal_values_have_exactly_the_accuracy_of_chance():
    objects = np.array([0, 0, 0, 1, 1, 2])
    result = nearest_grasp_accuracy(np.ones((6, 4)), objects)
    assert result.value == result.chance == [pytest.approx((2 / 5 + 1 / 5) / 2)]
    assert (result.queries, result.objects) == (5, 2)
