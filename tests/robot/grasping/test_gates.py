"""The contact-area gate, and the valid scores of any gate."""

import math

import numpy as np
import pytest

from robot.errors import RobotConfigError, RobotError
from robot.grasping.gates import ContactAreaGate, GraspFrames, apply_gate

SHAPE = (60, 80, 3)


def gel(seed=0, level=100.0, noise=2.0):
    """Return a no-contact frame with sensor noise."""
    values = level + np.random.default_rng(seed).normal(0, noise, SHAPE)
    return np.clip(values + 0.5, 0, 255).astype(np.uint8)


def pressed(seed=1, side=20, change=(40, -30, 10), level=100.0):
    """Return a frame of the same gel with a square of side `side` px that changed its colour."""
    values = gel(seed, level).astype(float)
    values[20 : 20 + side, 20 : 20 + side] += change
    return np.clip(values, 0, 255).astype(np.uint8)


GATE = ContactAreaGate()


def test_a_no_contact_gel_is_rejected_and_a_pressed_one_accepted_unless_it_slipped():
    assert GATE({"a": GraspFrames(gel(0), gel(1))}) is False
    assert GATE({"a": GraspFrames(gel(0), pressed())}) is True
    assert not GATE({"a": GraspFrames(gel(0), pressed(1), gel(2))})
    assert GATE({"a": GraspFrames(gel(0), pressed(1), pressed(2))})


def test_the_fraction_is_that_of_the_changed_area_darker_or_lighter():
    fraction = GATE.changed_fraction(GraspFrames(gel(0, noise=0), pressed(1, 20)))
    assert 20**2 <= fraction * 60 * 80 <= 24**2  # a blur of 5 px moves the edge by 2 px at most
    up = GATE.changed_fraction(GraspFrames(gel(0), pressed(1, change=(30, 30, 30))))
    down = GATE.changed_fraction(GraspFrames(gel(0), pressed(1, change=(-30, -30, -30))))
    assert up == pytest.approx(down, abs=0.01)


def test_uint8_subtraction_turns_noise_into_contact():
    """The naive difference wraps round: half of the no-contact pixels change by about 255 levels."""
    before, after = gel(0), gel(1)
    assert ((after - before) > GATE.noise_levels).mean() > 0.4
    assert GATE.changed_fraction(GraspFrames(before, after)) < 0.02


def test_one_finger_is_sufficient_unless_every_finger_is_required():
    one = {"a": GraspFrames(gel(0), gel(1)), "b": GraspFrames(gel(2), pressed(3))}
    assert GATE(one)
    assert not ContactAreaGate(every_finger=True)(one)
    assert ContactAreaGate(every_finger=True)({"b": one["b"]})


def test_no_finger_is_read_after_the_decision():
    class Never:
        @property
        def before(self):
            raise AssertionError("it was read")

    held, empty = GraspFrames(gel(0), pressed(1)), GraspFrames(gel(0), gel(1))
    assert GATE({"a": held, "b": Never()})
    assert not ContactAreaGate(every_finger=True)({"a": empty, "b": Never()})
    with pytest.raises(AssertionError, match="it was read"):
        GATE({"a": empty, "b": Never()})


@pytest.mark.parametrize("level", [0.0, 255.0])
def test_a_saturated_gel_is_no_contact(level):
    assert not GATE({"a": GraspFrames(gel(0, level), gel(1, level))})


def test_a_gate_without_a_no_contact_frame_raises():
    with pytest.raises(RobotConfigError, match="requires no-contact frames"):
        GATE({"a": GraspFrames(None, gel())})


@pytest.mark.parametrize(
    "setting", [{"noise_levels": 0}, {"noise_levels": 255}, {"least_share": 0}, {"least_share": 1.1}, {"blur_px": 0}]
)
def test_a_setting_out_of_range_is_refused(setting):
    with pytest.raises(RobotConfigError, match=next(iter(setting))):
        ContactAreaGate(**setting)


def test_a_gate_returns_true_false_or_a_probability_and_no_logit():
    for score, decision in [(True, True), (False, False), (0.5, True), (0.49, False), (np.float32(0.9), True)]:
        assert apply_gate(lambda touches, score=score: score, {}) == (decision, pytest.approx(float(score)))
    for score in (math.nan, -0.1, 17.0):
        with pytest.raises(RobotError, match="true, false or a probability"):
            apply_gate(lambda touches, score=score: score, {})
