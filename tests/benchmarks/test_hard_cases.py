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
from tests.retrieval.metrics import hard_probability as probability
from tests.retrieval.metrics import hard_ranking as ranking
from tests.retrieval.training import hard_linear as linear
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


def test_the_naive_canonical_correlations_equal_ours_on_easy_features():
    touch, photo = linear._views(200, 4)
    ours = linear._correlations(touch, photo).correlations
    assert linear.naive_correlations(touch, photo) == pytest.approx(ours, abs=1e-9)
    assert linear._by_eigenvectors(touch, photo) == pytest.approx(ours, abs=1e-5)


def test_the_naive_fits_equal_ours_on_overlapping_pairs():
    rng = np.random.default_rng([8])
    logits, labels = np.append(rng.normal(1, 1, 20_000), rng.normal(-1, 1, 20_000)), np.repeat([1, 0], 20_000)
    fitted = probability.fit_calibration(logits, labels)
    # Platt's targets differ from 0 and 1 by 1 in 20,000.
    assert probability.naive_fit(logits, labels) == pytest.approx(fitted, rel=1e-3, abs=1e-3)
    scores = rng.normal(0, 1, (5000, 5)) + 1.5 * np.eye(5)[0]
    fitted = probability.fit_posterior(probability.scored_choices(scores))
    assert probability.naive_slope(scores) == pytest.approx(fitted.slope, rel=2e-2)


def test_the_naive_interval_is_the_t_interval_of_many_values():
    values = np.random.default_rng([9]).normal(0.5, 0.1, 400)
    low, high = ranking.naive_interval(values)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)


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
