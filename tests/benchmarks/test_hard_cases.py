"""The hard inputs of every numerical kernel: ours holds, and the naive formula fails on the same input."""

import json
from functools import cache

import pytest

from benchmarks import hard_cases as command
from benchmarks.hard_cases import KERNELS, hard_cases
from tests.documents import ROOT
from tests.hard_case import HardCase


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


def test_the_page_of_results_has_the_number_of_cases(rows):
    found = [row for package in KERNELS for row in rows(package)]
    page = " ".join((ROOT / "docs" / "results.md").read_text("utf-8").split())
    kernels = {(package, row.kernel) for package in KERNELS for row in rows(package)}
    assert f"{len(found)} stiff, extreme or degenerate inputs of {len({name for _, name in kernels})} numerical" in page
