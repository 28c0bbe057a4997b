"""Is it a gel image, and is there a contact? Thresholds by hand, and a fit on synthetic features."""

import numpy as np
import pytest

from retrieval.model.gel_check import CONTACT, NO_CONTACT, NOT_A_GEL, GelCheck, contact_level

CHECK = GelCheck(foreign_above=1.0, contact_above=0.5, level_above=4.0, rates={"touches_rejected_as_foreign": 0.0})


def readings(*grasps):
    """Return readings (G, 2 fingers, 2) from ((foreign, contact), (foreign, contact)) of each grasp."""
    return np.array(grasps, dtype=np.float32)


def test_one_finger_in_contact_is_a_contact_and_one_foreign_picture_is_not_a_gel():
    contact, no_contact, foreign = (-3, 2), (-3, -2), (5, 2)
    grasps = (
        (contact, contact),
        (no_contact, contact),
        (no_contact, no_contact),
        (contact, foreign),
        (foreign, no_contact),
    )
    assert CHECK.classify(readings(*grasps)) == [CONTACT, CONTACT, NO_CONTACT, NOT_A_GEL, NOT_A_GEL]


def test_a_no_contact_frame_overrides_the_features():
    contact, no_contact = ((-3, 2), (-3, 2)), ((-3, -2), (-3, -2))
    levels = np.array([[0.9, 1.1], [0.8, 30.0]], dtype=np.float32)
    assert CHECK.classify(readings(contact, no_contact), levels) == [NO_CONTACT, CONTACT]


def test_the_level_is_the_largest_difference_of_block_means_in_grey_levels():
    no_contact = np.full((32, 32, 3), 0.5, dtype=np.float32)
    touch = no_contact.copy()
    touch[4:6, 8:10, 1] += 20 / 255  # a whole block of 2 x 2
    touch[20, 20, 0] -= 40 / 255  # a quarter of one
    assert contact_level(touch, no_contact) == pytest.approx(20, abs=1e-3)
    assert contact_level(no_contact, no_contact) == 0
    # The two files may have different sizes.
    assert contact_level(touch, no_contact[:16]) == pytest.approx(20, abs=1e-3)
