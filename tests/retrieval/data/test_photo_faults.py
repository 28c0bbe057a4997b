"""Faults of a photo that make its object harder to recognise."""

import numpy as np
import pytest

from retrieval.data.object_finder import FoundObject, whole_photo
from retrieval.data.photo_faults import BLURRED, CUT_OFF, NO_OBJECT, SMALL, photo_faults

PHOTO = np.full((256, 256, 3), 60, np.uint8)
OBJECT = FoundObject(100, 60, 180, 200, 80 * 140)


@pytest.mark.parametrize(
    ("blur_px", "found", "faults"),
    [
        (0.8, OBJECT, ()),
        (3.0, OBJECT, (BLURRED,)),
        (0.8, FoundObject(130, 100, 160, 130, 30 * 30), (SMALL,)),
        (0.8, FoundObject(0, 60, 180, 200, 120 * 140), (CUT_OFF,)),
        (3.0, whole_photo(PHOTO), (NO_OBJECT,)),
    ],
)
def test_the_faults_of_a_photo_are_named(blur_px, found, faults):
    assert photo_faults(PHOTO, found, blur_px) == faults
