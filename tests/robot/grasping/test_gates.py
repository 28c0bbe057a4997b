"""The contact-area gate, and the valid scores of any gate."""

import math

import numpy as np
import pytest

from robot.errors import RobotConfigError, RobotError
from robot.grasping.gates import ContactAreaGate, GraspFrames, apply_gate

SHAPE = (60, 80, 3)
GATE = ContactAreaGate()


def gel(seed=0, level=100.0, noise=2.0):
    """Return a no-contact frame with sensor noise."""
    values = level + np.random.default_rng(seed).normal(0, noise, SHAPE)
    return np.clip(values + 0.5, 0, 255).astype(np.uint8)


def pressed(seed=1, change=(40, -30, 10)):
    """Return a frame of the same gel with a square of 20 px that changed its colour."""
    values = gel(seed).astype(float)
    values[20:40, 20:40] += change
    return np.clip(values, 0, 255).astype(np.uint8)


HELD, EMPTY = GraspFrames(gel(0), pressed()), GraspFrames(gel(0), gel(1))


def test_a_no_contact_gel_is_rejected_and_a_pressed_one_accepted_unless_it_slipped():
    assert GATE({"a": EMPTY}) is False
    assert GATE({"a": HELD}) is True
    assert not GATE({"a": GraspFrames(gel(0), pressed(1), gel(2))})
    assert GATE({"a": GraspFrames(gel(0), pressed(1), pressed(2))})
    for level in (0.0, 255.0):  # saturated
        assert not GATE({"a": GraspFrames(gel(0, level), gel(1, level))})


def test_the_fraction_is_that_of_the_changed_area_darker_or_lighter():
    fraction = GATE.changed_fraction(GraspFrames(gel(0, noise=0), pressed()))
    assert 20**2 <= fraction * 60 * 80 <= 24**2  # a blur of 5 px moves the edge by 2 px at most
    up, down = (GATE.changed_fraction(GraspFrames(gel(0), pressed(1, [level] * 3))) for level in (30, -30))
    assert up == pytest.approx(down, abs=0.01)


def test_one_finger_is_sufficient_and_none_is_read_after_the_decision():
    class Never:
        @property
        def before(self):
            raise AssertionError("it was read")

    assert GATE({"a": EMPTY, "b": HELD})
    assert GATE({"a": HELD, "b": Never()})


@pytest.mark.parametrize(("setting", "value"), [("noise_levels", 0), ("least_share", 1.1), ("blur_px", 0)])
def test_a_setting_out_of_range_is_refused(setting, value):
    with pytest.raises(RobotConfigError, match=setting):
        ContactAreaGate(**{setting: value})


def test_a_gate_returns_true_false_or_a_probability_and_no_logit():
    for score, decision in [(True, True), (False, False), (0.5, True), (0.49, False), (np.float32(0.9), True)]:
        assert apply_gate(lambda touches, score=score: score, {}) == (decision, pytest.approx(float(score)))
    for score in (math.nan, -0.1, 17.0):
        with pytest.raises(RobotError, match="true, false or a probability"):
            apply_gate(lambda touches, score=score: score, {})
