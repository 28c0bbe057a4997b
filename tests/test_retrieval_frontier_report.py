"""`retrieve frontier` as users meet it: plots, a page, exit codes."""

import json
from pathlib import Path

import pytest

from retrieval.commands.main import main
from retrieval.lab import reports as frontier_report
from retrieval.lab.frontier import APPROXIMATIONS
from retrieval.lab.frontier.points import Panel, Row, Tradeoff
from retrieval.lab.frontier.report import figure, write_frontier
from retrieval.lab.hard_cases import run
from retrieval.lab.hard_cases.case import HardCase

GOOD = HardCase("top k", "a <NaN>", "is refused", "ranked first", "refused", True, False)
BAD = HardCase("losses", "a logit of 1000", "1000", "inf", "inf", False, False)


def document(*panels, skipped=None):
    row = Row("Candidates", "What is measured.", panels, skipped)
    return {
        "software": "1",
        "machine": {"processor": "a <fast> one", "cores": 2, "system": "Linux"},
        "model": "0" * 64,
        "scale": {"quick": True},
        "rows": {"candidates": row.to_dict()},
    }


def points(errors):
    return tuple(
        Tradeoff("a", f"k = {k}", error, 0.0, error + 1, seconds=1e-3 * (k + 1)) for k, error in enumerate(errors)
    )


@pytest.mark.parametrize("errors", [(3.0, 1.0, 0.0), (0.0, 0.0), (5.0,)], ids=["falling", "none seen", "one point"])
def test_a_page_has_the_plot_the_lines_and_every_point(errors, tmp_path):
    made = Panel("missed", "one query", "%", "every photo judged", 1.5, points(errors), 0.5)
    page, plot = write_frontier(tmp_path, document(made))
    text = page.read_text()
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert text.count("data:image/png;base64,") == 1
    assert "every photo judged" in text
    assert "a &lt;fast&gt; one" in text
    assert "A quick run" in text
    assert all(f"k = {k}" in text for k in range(len(errors)))


def test_a_row_that_was_left_out_says_why_and_has_no_plot(tmp_path):
    (page,) = write_frontier(tmp_path, document(skipped="nothing to measure"))
    assert "Left out: nothing to measure." in page.read_text()


def test_the_page_of_performance_says_how_many_approximations_there_are():
    said = (Path(__file__).parents[1] / "docs" / "performance.md").read_text()
    assert f"for {len(APPROXIMATIONS)} approximations" in said


def test_labels_of_points_that_stand_together_stand_above_and_below():
    near = (Tradeoff("a", "one", 1.0, seconds=1.0), Tradeoff("a", "other", 0.98, seconds=1.01))
    far = Tradeoff("a", "third", 0.01, seconds=9.0)
    (axes,) = figure([Panel("missed", "one query", "%", "all", 0.5, (*near, far), 0.01)]).axes
    heights = {text.get_text(): text.xyann[1] for text in axes.texts}
    assert heights["one"] > 0 > heights["other"]
    assert heights["third"] > 0


def test_the_command_writes_a_page_and_says_a_line_for_each_panel(model, tmp_path, capsys):
    command = ["frontier", "--out", str(tmp_path), "--model", str(model), "--quick", "--json"]
    assert main([*command, "--only", "closing"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["rows"].keys() == {"closing"}
    assert "closing: closing step (against closed form of a spring)" in said.err
    assert (tmp_path / "figures" / "closing.png").is_file()
    assert (tmp_path / "frontier.html").is_file()
    assert not (tmp_path / "recording").exists()


def test_wrong_names_are_one_line_and_exit_code_2(model, tmp_path, capsys):
    assert main(["frontier", "--out", str(tmp_path), "--model", str(model), "--only", "speed"]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("retrieve frontier: an approximation must be one of")


def test_without_a_recording_a_small_one_is_collected_once(model, tmp_path, capsys):
    first = frontier_report._recording(None, tmp_path, quick=True)
    lines = (first / "metadata.jsonl").read_bytes()
    assert frontier_report._recording(None, tmp_path, quick=True) == first
    assert (first / "metadata.jsonl").read_bytes() == lines
    assert "of 6 simulated objects" in capsys.readouterr().err


# Stability -------------------------------------------------------------------------------------------------


@pytest.fixture
def few_cases(monkeypatch):
    """Packages that have no hard case but what a test gives the robot."""

    def give(*cases):
        monkeypatch.setattr(run, "hard_cases", lambda package: cases if package == "robot" else ())

    return give


def test_hard_cases_that_hold_are_shown_and_the_exit_code_is_0(few_cases, tmp_path, capsys):
    few_cases(GOOD)
    assert main(["frontier", "--stability", "--out", str(tmp_path)]) == 0
    assert "holds  top k, a <NaN>: must hold: is refused; naive ranked first; ours refused" in capsys.readouterr().err
    page = (tmp_path / "stability.html").read_text()
    assert "a &lt;NaN&gt;" in page
    assert "What must hold does" in page
    assert json.loads((tmp_path / "stability.json").read_text())["failed"] == 0


def test_a_hard_case_that_does_not_hold_is_exit_code_1(few_cases, tmp_path, capsys):
    few_cases(GOOD, BAD)
    assert main(["frontier", "--stability", "--out", str(tmp_path), "--json"]) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["failed"] == 1
    assert said.err.splitlines()[-1] == "retrieve frontier: 1 of 2 hard cases do not hold; see the page"
    assert "DOES NOT HOLD" in (tmp_path / "stability.html").read_text()


def test_cases_name_the_package_that_they_are_of(monkeypatch):
    monkeypatch.setattr(run, "hard_cases", lambda package: {"robot": [BAD], "indexes": [GOOD]}.get(package, []))
    made = run.run_hard_cases(quiet=True)
    assert [case["package"] for case in made["cases"]] == ["indexes", "robot"]
    assert made["failed"] == 1
