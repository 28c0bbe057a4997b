"""Evidence of the opening of the jaws, by hand, and the values that are refused."""

import math

import numpy as np
import pytest

from retrieval.data.opening import parse_openings
from retrieval.errors import BadInput
from retrieval.model.opening import OpeningCalibration

CALIBRATION = OpeningCalibration(mean=3.4, spread=0.7, width=0.02, floor=0.2, objects=9, touches=9)


def test_ratios_equal_two_plain_loops_and_are_0_where_nothing_was_measured():
    openings, parts = [40.0, math.nan, 2.0], [[41.0, math.nan, 20.0], [math.nan], [300.0]]
    found = CALIBRATION.log_ratios(openings, [each for part in parts for each in part], np.array([0, 3, 4]))
    for opening, row in zip(openings, found, strict=True):
        for part, ratio in zip(parts, row, strict=True):
            known = [math.log(each) for each in part if not math.isnan(each)]
            if math.isnan(opening) or not known:
                assert ratio == 0
                continue
            x = math.log(opening)
            normal = math.exp(-(((x - 3.4) / 0.7) ** 2) / 2) / (0.7 * math.sqrt(2 * math.pi))
            anything = 0.8 * normal + 0.2 / math.log(300 / 0.5)
            same = [0.8 / (math.pi * 0.02 * (1 + ((x - each) / 0.02) ** 2)) + 0.2 * anything for each in known]
            assert ratio == pytest.approx(math.log(sum(same) / len(same) / anything), abs=1e-9)


@pytest.mark.parametrize(
    ("openings", "problem"),
    [
        ([0.041], "from 0.5 to 300; got 0.041; the value looks like metres"),
        ([41, 410.0], "got 410.0"),
        ([math.nan], "got nan"),
        ([10**400, None], "got 1000"),
        ([41], r"got 1 opening\(s\) for 2 grasp"),
    ],
)
def test_an_opening_that_is_no_distance_in_millimetres_is_refused(openings, problem):
    with pytest.raises(BadInput, match=problem):
        parse_openings(openings, 2 if "grasp" in problem else len(openings))
    with pytest.raises(BadInput, match="got '41'"):
        parse_openings("41", 1)  # type: ignore[arg-type]
    assert parse_openings(None, 2) == [None, None]
    assert parse_openings([41, None], 2) == [41.0, None]
