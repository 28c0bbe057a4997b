"""The report of an evaluation: numbers equal results.json, the page is self-contained, and missing measures or strange
names break nothing."""

import json
import re

import pytest
from PIL import Image

from retrieval.errors import BadInput
from retrieval.model.posterior import FORMULA
from retrieval.report.document import Card, Cards, Document, Picture, Section, Table, Text, to_html, to_markdown
from retrieval.report.evaluation import write_report
from tests.browser import chromium, page, serious
from tests.pages import HtmlPage
from tests.synthetic_evaluation import OBJECTS, PROTOCOL, write_synthetic_results

STRANGE = ["<script>alert(1)</script>", "$\\frac{1}$ | *x* [y](z)", "x" * 400, "mug 茶碗 🍵 100 %d {} a&b"]
"""Names of the test objects."""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """(files, folder) of a whole report on objects with strange names, with a method that the report does not know."""
    out = write_synthetic_results(tmp_path_factory.mktemp("report"), ("late_fusion", "cca", "chance"))
    results = (out / "results.json").read_text("utf-8")
    for old, name in zip(OBJECTS[8:], STRANGE, strict=True):
        results = results.replace(f'"{old}"', json.dumps(name))
    results = json.loads(results)
    rows = results["protocols"][PROTOCOL]["rows"]
    rows["brand/new_method"] = rows["cca"]
    (out / "results.json").write_text(json.dumps(results))
    return write_report(out), out


@pytest.fixture
def remake(report, tmp_path, monkeypatch):
    """Write the report again after `change(results)`, with figures of one pixel; return page, text without escapes and
    names of figures."""

    def draw(path, make):
        path.parent.mkdir(exist_ok=True)
        Image.new("RGB", (1, 1)).save(path)

    def run(change):
        results = json.loads((report[1] / "results.json").read_text())
        change(results)
        (tmp_path / "results.json").write_text(json.dumps(results))
        text, page, *figures = write_report(tmp_path)
        plain = text.read_text("utf-8").replace("\\", "")
        return HtmlPage(page.read_text("utf-8")).text, plain, [path.name for path in figures]

    monkeypatch.setattr("retrieval.report.document.draw", draw)
    return run


def test_returned_files_exist_and_every_figure_opens(report):
    files, out = report
    assert files[:2] == [out / "report.md", out / "report.html"]
    assert set(files[2:]) == set((out / "figures").iterdir())
    expected = {f"{name}.png" for name in ("overview", "guess-curves", "grasps", "reject")}
    for method in ("late_fusion", "cca", "brand-new_method"):
        expected |= {f"objects-test-{method}.png", f"objects-all-{method}.png", f"reliability-{method}.png"}
    assert {path.name for path in files[2:]} == expected
    for path in files[2:]:
        with Image.open(path) as image:
            image.load()
            assert 500 < image.width < 2500


def test_the_page_is_self_contained_and_no_name_of_an_object_is_obeyed(report):
    files, out = report
    page = HtmlPage((out / "report.html").read_text("utf-8"))
    assert {tag for tag, _ in page.tags}.isdisjoint({"link", "iframe", "object"})
    assert page.all("script") == []
    assert len(page.all("img")) == len(files) - 2
    assert all(len(image["alt"]) > 20 for image in page.all("img"))
    assert all(image["src"].startswith("data:image/png;base64,") for image in page.all("img"))
    targets = {attributes["id"] for _, attributes in page.tags if "id" in attributes}
    assert {link["href"] for link in page.all("a")} == {f"#{name}" for name in targets}
    assert all(name in page.text for name in (*STRANGE, "brand/new method"))
    assert not re.search(r"(?<!\\)<script", (out / "report.md").read_text("utf-8"))


def test_every_measure_of_every_method_is_printed_with_its_interval_and_basis(report):
    _, out = report
    results = json.loads((out / "results.json").read_text())
    page, text = HtmlPage((out / "report.html").read_text("utf-8")).text, (out / "report.md").read_text("utf-8")
    for row in results["protocols"][PROTOCOL]["rows"].values():
        for summary in row["measures"].values():
            cell = f"{100 * summary['value'][0]:.1f} [{100 * summary['low'][0]:.1f}, {100 * summary['high'][0]:.1f}]"
            assert cell in page
            assert cell.replace("[", r"\[").replace("]", r"\]") in text
    assert "792 queries of 18 objects. Gallery: 18 unseen objects, 792 photos." in page
    assert "64.3 %" in page
    assert "This recording is simulated." in page
    assert "results.json has the whole configuration" in page


def test_numbers_are_printed_without_recomputation(remake):
    """Values that contradict all others are printed unchanged, and a control's chance is compared with its interval."""

    def change(results):
        protocol = results["protocols"][PROTOCOL]
        row = protocol["rows"]["cca"]
        row["measures"]["pair_accuracy"] |= {"value": [0.12345], "low": [0.9], "high": [0.1]}
        row["details"]["reject"]["balanced_accuracy"] |= {"value": [0.8123], "low": [0.7], "high": [0.9]}
        for name, low in (("no_contact", 0.51), ("permuted", 0.49)):
            protocol["controls"][name]["measures"]["pair_accuracy"] |= {"low": [low], "high": [0.6]}
        protocol["recording"]["source"] = "billets"

    page, text, _ = remake(change)
    for written in (page, text):
        assert "12.3 [90.0, 10.0]" in written
        assert "81.2 [70.0, 90.0]" in written
        assert "This recording is simulated." not in written
    assert FORMULA in page
    rows = text.splitlines()
    assert next(row for row in rows if row.startswith("| no_contact |")).endswith("| no |")
    assert next(row for row in rows if row.startswith("| permuted |")).endswith("| yes |")


def test_refused_rates_of_verification_name_the_objects_that_they_need(remake):
    text = remake(lambda results: None)[1]
    assert "| 5.1 [2.0, 11.0] | 1.0 [0.0, 6.0] | 23.4 [10.0, 40.0] | refused: needs 1,246 objects |" in text
    assert "| most similar object | 1 | refused: no errors |" in text
    assert len(re.findall(r"^\| (random|most similar object) \| [13] \|", text, re.MULTILINE)) == 4


def test_intervals_of_too_few_objects_are_marked_and_explained_in_every_table(remake):
    def change(results):
        protocol = results["protocols"][PROTOCOL]
        for row in protocol["rows"].values():
            row["measures"]["pair_accuracy"]["few_objects"] = True
        protocol["comparisons"][0]["difference"]["few_objects"] = True

    assert "† Fewer than 5 objects" not in remake(lambda results: None)[1]
    page, text, _ = remake(change)
    for written in (page, text):
        assert "] †" in written
        # The headline, the comparison of methods, the differences, the controls, and the ceilings.
        assert written.count("† Fewer than 5 objects: the interval is too narrow.") == 5
    row = next(line for line in text.splitlines() if line.startswith("| late fusion |"))
    assert row.count("†") == 1  # only the column from too few objects


def test_what_was_not_measured_is_left_out_or_explained(remake):
    def without_posterior(results):
        for row in results["protocols"][PROTOCOL]["rows"].values():
            row["details"] |= {"reject": None, "reliability": {}}

    def nearly_empty(results):
        protocol = results["protocols"][PROTOCOL]
        for row in protocol["rows"].values():
            row |= {"details": None, "measures": {"pair_accuracy": row["measures"]["pair_accuracy"]}}
        protocol |= {"controls": {}, "ceilings": {}, "comparisons": []}

    _, text, figures = remake(without_posterior)
    assert "at least three validation objects" in text
    assert not [name for name in figures if name.startswith(("reject", "reliability"))]
    _, text, figures = remake(nearly_empty)
    assert figures == ["overview.png"]
    assert re.findall("^## (.*)$", text, re.M) == ["Comparison of methods", "Recording", "Settings"]


@pytest.mark.parametrize("text", ["", "[1]", "{", '{"schema_version": 99}'])
def test_unreadable_results_are_one_clear_error(tmp_path, text):
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(BadInput, match="retrieve evaluate"):
        write_report(tmp_path)


def test_protocols_of_real_data_have_low_pass_controls_verdicts_and_a_section_each(remake):
    def change(results):
        protocol = results["protocols"][PROTOCOL]
        low = {"value": 0.1, "low": -0.02, "high": 0.2, "few_objects": False, "p": 0.2}
        for row in protocol["rows"].values():
            row |= {"details": None, "low_pass": row["measures"]}
            row["differences"] = {"low_pass": {"topn_k5": low}}
            row["verdict"] = {"counts_as_touch": False, "above_chance": True}
        protocol |= {"labels": [["topn_k5", "top-1 of 5"]], "main": "topn_k5", "unit": "choice"}
        results |= {"protocols": {"first": protocol, "second": protocol}, "skipped": {"rct": "no folder"}}

    _, text, figures = remake(change)
    assert "rct was skipped: no folder." in text
    assert text.count("\n## Unseen objects\n") == 2
    assert text.count("> late fusion, top-1 of 5: ") == 2
    assert "does not count as touch: +10.0 [-2.0, +20.0] points against the low-pass control" in text
    assert "| low-pass control (8 x 6) |" in text
    assert "| late fusion − the low-pass control | top-1 of 5 | +10.0 [-2.0, +20.0] | 0.20 |" in text
    assert "intervals that cover the choice of test and training objects" in text
    assert {"first-overview.png", "second-overview.png"} <= set(figures)


def test_markdown_and_html_have_the_same_content(tmp_path):
    (tmp_path / "figures").mkdir()
    Image.new("RGB", (144, 10)).save(tmp_path / "figures" / "p.png")
    table = Table(("a", "b", "c"), (("1|2", "3", "x"), ("<4>", "5", "y")), ("note",), frozenset({2}))
    cards = Cards((Card((("", "blank"),), "first", ("line", "more"), is_marked=True),))
    blocks = (Text("one *two*", warn=True), table, cards, Section("folded", (Text("inside"),)))
    document = Document("T", (Text("lead"), Section("S", (*blocks, Picture("p", "alt", "caption", None)))))
    assert to_markdown(document) == (
        "# T\n\nlead\n\n## S\n\n> one \\*two\\*\n\n| a | b | c |\n| --- | ---: | --- |\n| 1\\|2 | 3 | x |\n"
        "| \\<4\\> | 5 | y |\n\nnote\n\n* **first** line; more\n\n### folded\n\ninside\n\n![alt](figures/p.png)\n\n"
        "caption\n"
    )
    page = to_html(document, tmp_path)
    for part in ('<p class="warn">one *two*</p>', "&lt;4&gt;", "<summary>folded</summary>", 'width="96"', "no picture"):
        assert part in page


@pytest.mark.slow
def test_axe_finds_nothing_serious(tmp_path):
    out = write_synthetic_results(tmp_path, ("late_fusion", "cca", "chance"))
    write_report(out)
    with chromium() as browser, page(browser, (out / "report.html").as_uri(), offline=True) as opened:
        assert serious(opened) == []
