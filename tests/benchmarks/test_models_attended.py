"""Occlusion maps of real touches."""

import numpy as np
import pytest

from benchmarks.models import attended


class FirstPixel:
    """Encodes a touch as the brightness of its first pixel."""

    def encode(self, touches, frame):
        return np.array([[image[0, 0, 0]] for image in touches])


def test_only_the_square_that_the_code_depends_on_decreases_the_cosine():
    touch, frame = np.ones((24, 24, 3), np.float32), np.full((24, 24, 3), 0.25, np.float32)
    expected = np.zeros((attended.SQUARES, attended.SQUARES))
    expected[0, 0] = 0.75
    assert attended.decreases(FirstPixel(), touch, frame, np.ones(1)) == pytest.approx(expected)


def test_the_nearest_other_row_is_not_the_row_itself():
    codes = attended.unit(np.array([[1, 0], [2, 0.1], [0, 1], [-1, 3]], np.float32))
    assert attended.nearest_other(codes).tolist() == [1, 0, 3, 2]


def test_at_most_six_rows_are_shown_from_first_to_last():
    assert attended.spread(np.arange(10, 21)).tolist() == [10, 12, 14, 16, 18, 20]
    assert attended.spread(np.array([3, 7])).tolist() == [3, 7]
    assert attended.spread(np.array([], np.int64)).tolist() == []
