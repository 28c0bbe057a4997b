"""The page of an evaluation in a real browser, from the disk: its tables sort and filter."""

import pytest

from retrieval.report.evaluation import write_report
from tests import synthetic
from tests.browser import chromium, page, serious
from tests.made_up_evaluation import write_made_up

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    recording = synthetic.write_recording(folder / "recording", synthetic.make_objects(12), 3)
    out = write_made_up(recording, folder / "out", ("late_fusion", "cca", "plsca", "chance"))
    write_report(out, None)
    with chromium() as browser, page(browser, (out / "report.html").as_uri(), offline=True) as found:
        yield found


def test_a_heading_sorts_its_table_down_up_and_as_it_was(opened):
    table = opened.locator("table").first
    first = lambda: [float(text.split()[0]) for text in table.locator("td:nth-child(2)").all_inner_texts()]  # noqa: E731
    before = first()
    heading = table.get_by_role("columnheader").nth(1)
    for turn, order in (("descending", sorted(before, reverse=True)), ("ascending", sorted(before)), (None, before)):
        heading.get_by_role("button").click()
        assert (heading.get_attribute("aria-sort"), first()) == (turn, order)
    assert before != sorted(before)


def test_words_leave_the_rows_that_hold_them_all(opened):
    opened.get_by_text("Every measure of every method").click()
    field = opened.get_by_label("Filter the rows of this table").last
    rows = opened.locator("details[open] tbody tr:visible")
    before = rows.count()
    field.fill("CCA pair")
    texts = [text.lower() for text in rows.all_inner_texts()]
    assert 0 < len(texts) < before
    assert all("cca" in text and "pair" in text for text in texts)
    field.fill("")
    assert rows.count() == before


def test_axe_finds_nothing_serious(opened):
    assert serious(opened) == []
