"""The page of an evaluation in a real browser, from the disk."""

import pytest

from retrieval.report.evaluation import write_report
from tests.browser import chromium, page, serious
from tests.synthetic_evaluation import write_synthetic_results

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    out = write_synthetic_results(tmp_path_factory.mktemp("report"), ("late_fusion", "cca", "chance"))
    write_report(out)
    with chromium() as browser, page(browser, (out / "report.html").as_uri(), offline=True) as found:
        yield found


def test_a_heading_sorts_its_table_in_three_orders(opened):
    table = opened.locator("table").first
    first = lambda: [float(text.split()[0]) for text in table.locator("td:nth-child(2)").all_inner_texts()]  # noqa: E731
    before = first()
    heading = table.get_by_role("columnheader").nth(1)
    for direction, order in (
        ("descending", sorted(before, reverse=True)),
        ("ascending", sorted(before)),
        (None, before),
    ):
        heading.get_by_role("button").click()
        assert (heading.get_attribute("aria-sort"), first()) == (direction, order)
    assert before != sorted(before)


def test_axe_finds_nothing_serious(opened):
    assert serious(opened) == []
