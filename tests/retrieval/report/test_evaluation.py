"""The report of an evaluation: numbers equal results.json, the page is self-contained, and missing measures or strange
names break nothing."""

import json
import re

import numpy as np
import pytest
from PIL import Image

from retrieval.errors import BadInput
from retrieval.model.posterior import FORMULA
from retrieval.report.document import Details, Document, Listing, Picture, Section, Table, Text, to_html, to_markdown
from retrieval.report.evaluation import write_report
from retrieval.report.numbers import format_number, interval, percent, probability, with_interval
from tests import synthetic
from tests.pages import HtmlPage
from tests.synthetic_evaluation import PROTOCOL, verification, write_synthetic_results

METHODS = ("late_fusion", "cca", "chance")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return synthetic.write_recording(tmp_path_factory.mktemp("r") / "recording", synthetic.make_objects(12), 3)


@pytest.fixture(scope="module")
def report(folder, tmp_path_factory):
    """(files, folder) of a whole report."""
    out = write_synthetic_results(folder, tmp_path_factory.mktemp("out") / "report", METHODS)
    return write_report(out), out


@pytest.fixture
def text_only(monkeypatch):
    """Replace figures by single pixels, for tests that read the text."""

    def draw(path, make):
        path.parent.mkdir(exist_ok=True)
        Image.new("RGB", (1, 1)).save(path)

    monkeypatch.setattr("retrieval.report.document.draw", draw)


def remake(report, tmp_path, change=None):
    """Write the report again after `change(protocol)`."""
    results = json.loads((report[1] / "results.json").read_text())
    if change:
        change(results["protocols"][PROTOCOL])
    (tmp_path / "results.json").write_text(json.dumps(results))
    files = write_report(tmp_path)
    return (tmp_path / "report.html").read_text("utf-8"), (tmp_path / "report.md").read_text("utf-8"), files


def test_returned_files_exist_and_every_figure_opens(report):
    files, out = report
    assert files[:2] == [out / "report.md", out / "report.html"]
    figures = set(files[2:])
    assert figures == set((out / "figures").iterdir())
    names = {path.name for path in figures}
    assert {"overview.png", "guess-curves.png", "grasps.png", "time.png", "reject.png"} <= names
    for method in ("late_fusion", "cca"):
        assert {f"objects-test-{method}.png", f"objects-all-{method}.png", f"reliability-{method}.png"} <= names
    for path in figures:
        with Image.open(path) as image:
            image.load()
            assert 500 < image.width < 2500


def test_the_page_is_self_contained_and_every_picture_has_a_text_alternative(report):
    files, out = report
    page = HtmlPage((out / "report.html").read_text("utf-8"))
    assert {tag for tag, _ in page.tags}.isdisjoint({"link", "iframe", "object"})
    assert page.all("script") == [{}]  # embedded
    assert len(page.all("img")) == len(files) - 2
    for image in page.all("img"):
        assert len(image["alt"]) > 20
        assert image["src"].startswith("data:image/png;base64,")
    targets = {attributes["id"] for _, attributes in page.tags if "id" in attributes}
    assert {link["href"] for link in page.all("a")} == {f"#{name}" for name in targets}


def test_every_measure_of_every_method_is_printed_with_its_interval_and_basis(report):
    _, out = report
    results = json.loads((out / "results.json").read_text())
    page, text = HtmlPage((out / "report.html").read_text("utf-8")).text, (out / "report.md").read_text("utf-8")
    for row in results["protocols"][PROTOCOL]["rows"].values():
        for summary in row["measures"].values():
            cell = f"{100 * summary['value'][0]:.1f} [{100 * summary['low'][0]:.1f}, {100 * summary['high'][0]:.1f}]"
            assert cell in page
            assert cell.replace("[", r"\[").replace("]", r"\]") in text
            assert summary["gallery"] in page
    assert "792 queries of 18 objects" in page


@pytest.mark.usefixtures("text_only")
def test_numbers_are_printed_without_recomputation(report, tmp_path):
    """A value that contradicts all others is printed unchanged."""

    def change(protocol):
        protocol["rows"]["cca"]["measures"]["pair_accuracy"] |= {"value": [0.12345], "low": [0.9], "high": [0.1]}

    page, text, _ = remake(report, tmp_path, change=change)
    assert "12.3 [90.0, 10.0]" in page
    assert r"12.3 \[90.0, 10.0\]" in text


@pytest.mark.usefixtures("text_only")
def test_the_report_cites_published_results_and_names_simulation(report, tmp_path):
    page, _, _ = remake(report, tmp_path)
    assert "64.3 %" in page
    assert "This recording is simulated." in page

    def real(protocol):
        protocol["recording"]["source"] = "billets"

    assert "This recording is simulated." not in remake(report, tmp_path, change=real)[0]


@pytest.mark.usefixtures("text_only")
def test_a_control_states_whether_chance_lies_in_its_interval(report, tmp_path):
    def change(protocol):
        for name, low in (("no_contact", 0.51), ("permuted", 0.49)):
            protocol["controls"][name]["measures"]["pair_accuracy"] |= {"low": [low], "chance": [0.5], "high": [0.6]}

    rows = remake(report, tmp_path, change=change)[1].splitlines()
    assert next(row for row in rows if row.startswith(r"| no\_contact |")).endswith("| no |")
    assert next(row for row in rows if row.startswith("| permuted |")).endswith("| yes |")


@pytest.mark.usefixtures("text_only")
def test_the_decision_is_shown_with_the_formula(report, tmp_path):
    def change(protocol):
        found = protocol["rows"]["cca"]["details"]["reject"]
        found["false_accepts_at_95"] |= {"value": [0.8123], "low": [0.7], "high": [0.9]}

    page, text, _ = remake(report, tmp_path, change=change)
    words = HtmlPage(page).text
    assert "81.2 [70.0, 90.0]" in words
    assert FORMULA in words
    rows = text.splitlines()
    assert not any("threshold" in row for row in rows if row.startswith("| method | AUROC"))


def test_too_few_objects_for_a_posterior_are_reported(report, tmp_path):
    def change(protocol):
        for details in (row["details"] for row in protocol["rows"].values()):
            details["reject"] = None
            details["calibration"]["posteriors"] = {}
            details["reliability"] = {"pairs": details["reliability"]["pairs"]}

    _, text, files = remake(report, tmp_path, change=change)
    assert "at least three validation objects" in text
    assert "reject.png" not in {path.name for path in files}


@pytest.mark.usefixtures("text_only")
def test_intervals_of_too_few_objects_are_marked_and_explained_in_every_table(report, tmp_path):
    def change(protocol):
        for row in protocol["rows"].values():
            row["measures"]["pair_accuracy"]["few_objects"] = True
        protocol["comparisons"][0]["difference"]["few_objects"] = True

    assert "† Fewer than 5 objects" not in remake(report, tmp_path)[1]
    page, text, _ = remake(report, tmp_path, change=change)
    for written in (page, text):
        assert "] †" in written
        # The headline, the comparison of methods, the differences, the controls, and the ceilings.
        assert written.count("† Fewer than 5 objects: the interval is too narrow.") == 5
    row = next(line for line in text.splitlines() if line.startswith("| late fusion |"))
    assert row.count("†") == 1  # only the column from too few objects


def test_missing_measures_are_left_out(report, tmp_path):
    def change(protocol):
        for row in protocol["rows"].values():
            row |= {"details": None, "measures": {"pair_accuracy": row["measures"]["pair_accuracy"]}}
        protocol |= {"controls": {}, "ceilings": {}, "comparisons": []}

    _, text, files = remake(report, tmp_path, change=change)
    assert [path.name for path in files[2:]] == ["overview.png"]
    for heading in (
        "Top-N accuracy",
        "Controls",
        "Ceilings",
        "Accuracy by object",
        "Calibration",
        "Accuracy and time",
    ):
        assert f"## {heading}" not in text
    assert "## Comparison of methods" in text


def test_unknown_methods_are_shown_under_their_names(report, tmp_path):
    def change(protocol):
        protocol["rows"]["brand/new_method"] = protocol["rows"]["cca"]

    page, _, files = remake(report, tmp_path, change=change)
    assert "brand/new method" in page
    assert "objects-test-brand-new_method.png" in {path.name for path in files}


@pytest.mark.parametrize(
    "name", ["<script>alert(1)</script>", "$\\frac{1}$ | *x* [y](z)", "x" * 400, "mug 茶碗 🍵 100 %d {} a&b"]
)
def test_any_name_of_an_object_is_harmless(report, tmp_path, name):
    def change(protocol):
        old = protocol["folds"][0][0]["test"][0]
        renamed = json.dumps(protocol).replace(json.dumps(old)[1:-1], json.dumps(name)[1:-1])
        protocol |= json.loads(renamed)

    page, text, _ = remake(report, tmp_path, change=change)
    assert HtmlPage(page).all("script") == [{}]
    assert name in HtmlPage(page).text
    for line in text.splitlines():
        assert not re.search(r"(?<!\\)<script", line)


@pytest.mark.parametrize("text", ["", "[1]", "{", '{"schema_version": 99}'])
def test_unreadable_results_are_one_clear_error(tmp_path, text):
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(BadInput, match="retrieve evaluate"):
        write_report(tmp_path)


@pytest.mark.usefixtures("text_only")
def test_rates_of_verification_fall_with_the_false_accept_rate_and_refusals_name_the_objects_that_they_need(
    report, tmp_path
):
    found = verification(np.random.default_rng(0))
    one = found["random"]["3"]
    one["eer"] = {"value": 0.0512, "low": 0.02, "high": 0.11, "objects_needed": 35}
    one["frr"] = {
        "0.001": {"value": None, "low": None, "high": None, "objects_needed": 1246},
        "0.01": {"value": 0.2345, "low": 0.1, "high": 0.4, "objects_needed": 78},
        "0.1": {"value": 0.01, "low": 0.0, "high": 0.06, "objects_needed": 25},
    }
    found["similar"]["1"]["eer"] = dict.fromkeys(("value", "low", "high", "objects_needed"))

    def change(protocol):
        protocol["rows"]["late_fusion"]["details"]["verification"] = found

    text = remake(report, tmp_path, change)[1].replace("\\", "")
    assert (
        "| impostors | grasps | EER, % | FRR at a FAR of 10 %, % | FRR at a FAR of 1 %, % | FRR at a FAR of 0.1 %, % |"
    ) in text
    assert (
        "| random | 3 | 5.1 [2.0, 11.0] | 1.0 [0.0, 6.0] | 23.4 [10.0, 40.0] | refused: needs 1,246 objects |" in text
    )
    assert "| most similar object | 1 | refused: no errors |" in text
    assert len(re.findall(r"^\| (random|most similar object) \| [1235] \|", text, re.MULTILINE)) == 8


@pytest.mark.usefixtures("text_only")
def test_protocols_of_real_data_have_low_pass_controls_verdicts_and_a_section_each(report, tmp_path):
    results = json.loads((report[1] / "results.json").read_text())
    protocol = results["protocols"][PROTOCOL]
    low = {"value": 0.1, "low": -0.02, "high": 0.2, "few_objects": False, "p": 0.2}
    for row in protocol["rows"].values():
        row |= {"details": None, "low_pass": row["measures"]}
        row["differences"] = {"low_pass": {"topn_k5": low}}
        row["verdict"] = {"counts_as_touch": False, "above_chance": True}
    protocol |= {"labels": [["topn_k5", "top-1 of 5"]], "main": "topn_k5", "unit": "choice"}
    results |= {"protocols": {"first": protocol, "second": protocol}, "skipped": {"rct": "no folder"}}
    (tmp_path / "results.json").write_text(json.dumps(results))
    write_report(tmp_path)
    text = (tmp_path / "report.md").read_text("utf-8").replace("\\", "")
    assert "rct was skipped: no folder." in text
    assert text.count("\n## Unseen objects\n") == 2
    assert text.count("> Late fusion, top-1 of 5: ".lower()) == 2
    assert "does not count as touch: +10.0 [-2.0, +20.0] points against the low-pass control" in text
    assert "| low-pass control (8 x 6) |" in text
    assert "| late fusion | top-1 of 5 | the low-pass control | +10.0 [-2.0, +20.0] | 0.20 |" in text
    assert "| top-1 of 5, over choices | mean, % | minimum, % | maximum, % | choices |" in text
    assert {path.name for path in (tmp_path / "figures").iterdir()} >= {"first-overview.png", "second-overview.png"}


# Labels ----------------------------------------------------------------------------------------------


def test_numbers_are_written_for_readers():
    assert [format_number(value) for value in (None, 0.0, 3.0, 4.004, 0.0361, 99.95, 123.4, 12345.6)] == [
        *("–", "0", "3", "4.00", "0.0361", "100", "123", "12,346")
    ]
    assert [percent(0.71249), percent(None), percent(0.5, 0)] == ["71.2", "–", "50"]
    assert interval(0.5, 0.4, 0.625) == "50.0 [40.0, 62.5]"
    assert with_interval(None) == "–"
    assert [probability(p) for p in (0.0, 0.00012, 0.0512, 0.5)] == ["< 0.0001", "0.00012", "0.051", "0.50"]


def test_markdown_and_html_have_the_same_content(tmp_path):
    (tmp_path / "figures").mkdir()
    Image.new("RGB", (144, 10)).save(tmp_path / "figures" / "p.png")
    table = Table(("a", "b", "c"), (("1|2", "3", "x"), ("<4>", "5", "y")), ("note",), frozenset({2}))
    blocks = (Text("one *two*", warn=True), table, Listing("{\n}"), Details("more", (Text("inside"),)))
    document = Document("T", (Text("lead"),), (Section("S", (*blocks, Picture("p", "alt", "caption", None))),))
    assert to_markdown(document) == (
        "# T\n\nlead\n\n## S\n\n> one \\*two\\*\n\n| a | b | c |\n| --- | ---: | --- |\n| 1\\|2 | 3 | x |\n"
        "| \\<4\\> | 5 | y |\n\nnote\n\n    {\n    }\n\n### more\n\ninside\n\n![alt](figures/p.png)\n\ncaption\n"
    )
    page = to_html(document, tmp_path)
    for part in (
        '<p class="warn">one *two*</p>',
        "&lt;4&gt;",
        "<summary>more</summary>",
        'width="96"',
    ):
        assert part in page
