"""Calibration of reference touches, by hand."""

import math

import numpy as np
import pytest

from retrieval.model.references import SHARPNESS, reference_similarity


def test_several_references_are_averaged_as_likelihoods():
    """Compare with two plain loops, over objects with one, three and two references."""
    cosines = np.random.default_rng(0).uniform(-1, 1, (4, 6)).astype(np.float32)
    parts = ([0], [1, 2, 3], [4, 5])
    for grasp, row in enumerate(reference_similarity(cosines, np.array([0, 1, 4]))):
        for part, got in zip(parts, row, strict=True):
            mean = sum(math.exp(SHARPNESS * float(cosines[grasp, place])) for place in part) / len(part)
            assert got == pytest.approx(math.log(mean) / SHARPNESS, abs=1e-6)
