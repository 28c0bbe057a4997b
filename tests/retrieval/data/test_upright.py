"""The roll of a camera, and photos turned upright."""

import math

import numpy as np
import pytest

from retrieval.data.upright import ROLLS, probable_roll, turn


def test_a_photo_turns_clockwise_and_keeps_its_shorter_side():
    photo = np.zeros((40, 60, 3), np.float32)
    photo[:10] = 1  # a bright upper edge
    right, oblique = turn(photo, 90), turn(photo, 30)
    assert right.shape == (60, 40, 3)
    assert (right[:, -10:] == 1).all()
    assert oblique.shape == photo.shape
    assert oblique[5, 55].mean() > 0.9 > 0.1 > oblique[35, 5].mean()
    assert turn(photo, 80).shape == right.shape


@pytest.mark.parametrize(
    ("likely", "degrees"),
    [
        ({6: 0.6, 0: 0.4}, 90.0),
        ({18: 0.6, 19: 0.4}, -90.0),  # 6 degrees from a right angle
        ({2: 0.5, 3: 0.5}, 38.0),
        ({6: 0.35, 0: 0.3, 12: 0.35}, 0.0),  # no roll is probable enough
        ({0: 0.5, 1: 0.5}, 0.0),  # too small
    ],
)
def test_a_probable_roll_is_used(likely, degrees):
    probabilities = np.zeros(ROLLS)
    probabilities[list(likely)] = list(likely.values())
    assert probable_roll(probabilities) == pytest.approx(degrees, abs=0.51)
    assert math.remainder(probable_roll(probabilities), 360) == probable_roll(probabilities)
