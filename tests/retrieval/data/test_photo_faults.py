"""Faults of a photo that make its object harder to recognise."""

import cv2
import numpy as np
import pytest

from retrieval.data.object_finder import FoundObject, whole_photo
from retrieval.data.photo_faults import BLURRED, CUT_OFF, NO_OBJECT, SMALL, photo_faults

PHOTO = np.full((256, 256, 3), 60, np.uint8)
PHOTO[60:200, 100:180] = np.random.default_rng(0).integers(120, 220, (140, 80, 1))
OBJECT = FoundObject(100, 60, 180, 200, 80 * 140)


@pytest.mark.parametrize(
    ("photo", "found", "faults"),
    [
        (PHOTO, OBJECT, ()),
        (cv2.GaussianBlur(PHOTO, (0, 0), 3), OBJECT, (BLURRED,)),
        (PHOTO, FoundObject(130, 100, 160, 130, 30 * 30), (SMALL,)),
        (PHOTO, FoundObject(0, 60, 180, 200, 120 * 140), (CUT_OFF,)),
        (PHOTO, whole_photo(PHOTO), (NO_OBJECT,)),
    ],
)
def test_the_faults_of_a_photo_are_named(photo, found, faults):
    assert photo_faults(photo, found) == faults
