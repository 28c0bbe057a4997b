"""`retrieve frontier` from the command line: plots, page, exit codes."""

import json
from pathlib import Path

import pytest

from benchmarks.frontier import APPROXIMATIONS as KERNELS
from retrieval.commands.frontier import recording_of as collected
from retrieval.commands.main import main
from retrieval.frontier import APPROXIMATIONS
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff
from retrieval.frontier.report import figure, write_frontier


def document(*panels, skipped=None):
    row = ApproximationResult("Candidates", "What is measured.", panels, skipped)
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


@pytest.mark.parametrize("errors", [(3.0, 1.0, 0.0), (0.0, 0.0), (5.0,)], ids=["falling", "no errors", "one point"])
def test_a_page_has_the_plot_the_lines_and_every_point(errors, tmp_path):
    made = Panel("missed", "one query", "%", "every photo reranked", 1.5, points(errors))
    _, page, plot = write_frontier(tmp_path, document(made))
    text = page.read_text()
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert text.count("data:image/png;base64,") == 1
    assert "every photo reranked" in text
    assert "a &lt;fast&gt; one" in text
    assert "A quick run" in text
    assert all(f"k = {k}" in text for k in range(len(errors)))


def test_a_skipped_row_has_a_reason_and_no_plot(tmp_path):
    _, page = write_frontier(tmp_path, document(skipped="nothing to measure"))
    assert "Left out: nothing to measure." in page.read_text()


def test_the_performance_page_has_the_number_of_approximations():
    text = (Path(__file__).parents[3] / "docs" / "performance.md").read_text()
    assert f" {len(APPROXIMATIONS)} approximations of a search" in " ".join(text.split())
    assert f" {len(KERNELS)} approximations of our kernels" in " ".join(text.split())


def test_labels_of_near_points_are_above_and_below():
    near = (Tradeoff("a", "one", 1.0, seconds=1.0), Tradeoff("a", "other", 0.98, seconds=1.01))
    far = Tradeoff("a", "third", 0.01, seconds=9.0)
    (axes,) = figure([Panel("missed", "one query", "%", "all", 0.5, (*near, far))]).axes
    heights = {text.get_text(): text.xyann[1] for text in axes.texts}
    assert heights["one"] > 0 > heights["other"]
    assert heights["third"] > 0


def test_the_command_writes_a_page_and_prints_a_line_for_each_panel(model, recording, tmp_path, capsys):
    command = ["frontier", "--out", str(tmp_path), "--model", str(model), "--recording", str(recording)]
    assert main([*command, "--only", "partials", "--json"]) == 0
    output = capsys.readouterr()
    assert json.loads(output.out)["rows"].keys() == {"partials"}
    assert "partials: largest error of a match logit (against partial activations in float32)" in output.err
    assert (tmp_path / "figures" / "partials.png").is_file()
    assert (tmp_path / "frontier.html").is_file()
    assert not (tmp_path / "recording").exists()


def test_wrong_names_are_one_line_and_exit_code_2(model, tmp_path, capsys):
    assert main(["frontier", "--out", str(tmp_path), "--model", str(model), "--only", "speed"]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("retrieve frontier: approximation must be one of")


def test_without_a_recording_a_small_one_is_collected_once(model, tmp_path, capsys):
    first = collected(None, tmp_path, quick=True)
    lines = (first / "metadata.jsonl").read_bytes()
    assert collected(None, tmp_path, quick=True) == first
    assert (first / "metadata.jsonl").read_bytes() == lines
    assert "of 6 simulated objects" in capsys.readouterr().err
