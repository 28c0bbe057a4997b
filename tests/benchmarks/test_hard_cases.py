"""The hard inputs of every numerical kernel: ours holds, and the naive formula fails on the same input."""

import json
import math
from functools import cache

import numpy as np
import pytest

from benchmarks import hard_cases as command
from benchmarks.hard_cases import KERNELS, hard_cases
from benchmarks.optics.least_squares import solve
from tests.documents import ROOT
from tests.hard_case import HardCase
from tests.robot.sight.hard_sight import naive_circle
from tests.robot.sim.hard_gel_pictures import _columns, _grams, naive_ridge


@pytest.fixture(scope="module")
def rows():
    """Package -> its hard cases, run on first use."""
    return cache(hard_cases)


@pytest.mark.parametrize("package", KERNELS)
def test_our_results_hold_and_the_naive_formulae_fail_on_the_same_inputs(rows, package):
    found = rows(package)
    assert [f"{row.kernel}, {row.case}: {row.ours}" for row in found if not row.holds] == []
    assert [f"{row.kernel}, {row.case}: {row.naive}" for row in found if row.naive_holds] == []
    assert len({(row.kernel, row.case) for row in found}) == len(found)
    assert all(row.case and row.must_hold and row.naive and row.ours for row in found)


# The naive formulae are right on easy inputs: they fail by their arithmetic, not by a mistake -----------------


def test_the_naive_circle_is_right_on_a_whole_circle_without_noise():
    angle = np.linspace(0, 2 * math.pi, 50)
    plan = np.stack([3 + 7 * np.cos(angle), -2 + 7 * np.sin(angle)], axis=1)
    assert naive_circle(plan) == pytest.approx((3, -2, 7))


def test_the_naive_ridge_equals_ours_on_features_of_one_scale():
    columns, target = _columns()
    assert naive_ridge(columns, target) == pytest.approx(solve(_grams(columns, target), 1e-4), abs=1e-2)


# The command ---------------------------------------------------------------------------------------------------

GOOD = HardCase("top k", "a <NaN>", "is refused", "ranked first", "refused", True, False)
BAD = HardCase("losses", "a logit of 1000", "1000", "inf", "inf", False, False)


@pytest.mark.parametrize(("cases", "code"), [((GOOD,), 0), ((GOOD, BAD), 1)])
def test_cases_are_printed_and_written_and_the_exit_code_states_whether_all_hold(
    cases, code, monkeypatch, tmp_path, capsys
):
    monkeypatch.setattr(command, "hard_cases", lambda package: cases if package == "robot" else ())
    assert command.main(["--out", str(tmp_path)]) == code
    output = capsys.readouterr().out
    assert "holds  top k, a <NaN>: must hold: is refused; naive ranked first; ours refused\n" in output
    assert ("FAILS  losses, a logit of 1000" in output) == code
    page = (tmp_path / "stability.html").read_text()
    assert "a &lt;NaN&gt;" in page
    assert ("DOES NOT HOLD" in page) == code
    assert json.loads((tmp_path / "stability.json").read_text())["failed"] == code


def test_the_performance_page_has_the_number_of_cases(rows):
    found = [row for package in KERNELS for row in rows(package)]
    page = " ".join((ROOT / "docs" / "performance.md").read_text("utf-8").split())
    kernels = {(package, row.kernel) for package in KERNELS for row in rows(package)}
    assert f"{len(found)} stiff, extreme or degenerate inputs of {len({name for _, name in kernels})} numerical" in page
