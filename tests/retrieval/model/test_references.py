"""Calibration of reference touches, by hand."""

import math
from dataclasses import asdict

import numpy as np
import pytest

from _touch_retrieval.documents import typed
from retrieval.errors import BadInput
from retrieval.model.references import SHARPNESS, ReferenceCalibration, reference_similarity
from tests.reference_model import REFERENCE_CALIBRATION


def test_several_references_are_averaged_as_likelihoods():
    """Compare with two plain loops, over objects with one, three and two references."""
    cosines = np.random.default_rng(0).uniform(-1, 1, (4, 6)).astype(np.float32)
    parts = ([0], [1, 2, 3], [4, 5])
    for grasp, row in enumerate(reference_similarity(cosines, np.array([0, 1, 4]))):
        for part, got in zip(parts, row, strict=True):
            mean = sum(math.exp(SHARPNESS * float(cosines[grasp, place])) for place in part) / len(part)
            assert got == pytest.approx(math.log(mean) / SHARPNESS, abs=1e-6)


@pytest.mark.parametrize(
    "change",
    [{"weight": math.inf}, {"weight": -1.0}, {"weight": None}, {"objects": "many"}, {"touch_only": {}}, {"more": 1}],
)
def test_an_invalid_calibration_is_refused(change):
    with pytest.raises(BadInput):
        typed(asdict(REFERENCE_CALIBRATION) | change, ReferenceCalibration, complete=True, error=BadInput)
