"""The table of hard inputs of rig and simulation: ours holds, and the naive formula fails on the same input."""

import math

import numpy as np
import pytest

from retrieval.lab.hard_cases.gel_pictures import _columns, _grams, naive_ridge, refused
from retrieval.lab.hard_cases.rig import _exact_depth, _picture, _points, hard_cases, naive_circle
from retrieval.lab.optics.least_squares import solve
from robot.errors import SceneError

KERNELS = (
    "layer kernel",
    "contact solver",
    "gripper closing",
    "cylinder fit",
    "table fit",
    "depth",
    "contact gate",
    "photometric fit",
    "gel picture",
)


@pytest.fixture(scope="module")
def rows():
    return hard_cases()


@pytest.mark.parametrize("kernel", KERNELS)
def test_what_must_hold_does_and_the_naive_formula_fails(rows, kernel):
    of_kernel = [row for row in rows if row.kernel == kernel]
    assert of_kernel
    assert [f"{row.case}: {row.ours}" for row in of_kernel if not row.holds] == []
    assert [f"{row.case}: {row.naive}" for row in of_kernel if row.naive_holds] == []


def test_every_row_says_all_of_it_and_comes_once(rows):
    assert {row.kernel for row in rows} == set(KERNELS)
    assert len({(row.kernel, row.case) for row in rows}) == len(rows)
    assert all(row.case and row.must_hold and row.naive and row.ours for row in rows)


def test_what_is_accepted_does_not_count_as_refused():
    def raising():
        raise SceneError("row 7 is NaN")

    assert refused(raising, "row 7") == ("refused: row 7 is NaN", True)
    assert refused(raising, "row 8") == ("refused: row 7 is NaN", False)
    assert refused(lambda: 3) == ("accepted: 3", False)


# The naive formulae are right where nothing is hard: they fail by their arithmetic, not by a mistake ----------


def test_the_can_is_drawn_where_it_stands():
    points = _points(_picture(_exact_depth()))
    assert points[:, 2].max() == pytest.approx(120, abs=1e-3)
    side = points[points[:, 2] < 119]
    # float32 depth of 800 mm is good to 6e-5 mm
    assert np.hypot(side[:, 0], side[:, 1]) == pytest.approx(np.full(len(side), 33), abs=1e-3)
    assert side[:, 1].max() < 0


def test_the_naive_circle_is_right_on_a_whole_circle_without_noise():
    angle = np.linspace(0, 2 * math.pi, 50)
    plan = np.stack([3 + 7 * np.cos(angle), -2 + 7 * np.sin(angle)], axis=1)
    assert naive_circle(plan) == pytest.approx((3, -2, 7))


def test_the_naive_ridge_is_ours_on_features_of_one_size():
    columns, wanted = _columns()
    assert naive_ridge(columns, wanted) == pytest.approx(solve(_grams(columns, wanted), 1e-4), abs=1e-2)
