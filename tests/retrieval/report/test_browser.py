"""The page of an evaluation in a real browser, from the disk: sorting, filters, and grasps of clicked pictures."""

import pytest

from retrieval.report.evaluation import write_report
from tests import synthetic
from tests.browser import chromium, page, serious
from tests.synthetic_evaluation import write_synthetic_results

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    recording = synthetic.write_recording(folder / "recording", synthetic.make_objects(12), 3)
    out = write_synthetic_results(recording, folder / "out", ("late_fusion", "cca", "chance"))
    write_report(out, recording)
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


def test_the_filter_shows_the_rows_that_contain_all_words(opened):
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


def test_a_click_on_a_confusion_shows_its_touches_with_pictures(opened):
    pair = opened.get_by_role("button", name="mistaken for").first
    label = pair.get_attribute("aria-label")
    pair.click()
    shown = opened.get_by_role("region", name="Grasps of the clicked place")
    assert shown.get_by_role("heading").inner_text() == label
    cards = shown.locator(".cards li")
    names = cards.locator("figcaption").filter(has_text="the object: ").all_inner_texts()
    assert set(names) == {f"the object: {label.split(' mistaken for ')[0]}"}
    pictures = shown.locator("img")
    assert (cards.count(), pictures.count()) == (2, 8)  # two gels, the object and the found photo of each
    assert pictures.evaluate_all("all => all.every((one) => one.complete && one.naturalWidth > 0)")
    pair.click()
    assert shown.count() == 0


def test_a_point_of_a_top_n_curve_is_clickable_at_its_place_and_shows_grasps(opened):
    figure = opened.locator("figure", has=opened.get_by_alt_text("Rising curves")).first
    points = figure.get_by_role("button", name="late fusion: rank")
    assert points.count() == 15  # for five candidates and for ten
    colour = (0, 114, 178)  # the method's
    for point in (points.nth(0), points.nth(3), points.nth(14)):
        point.click()
        assert figure.locator(".shown h3").inner_text() == point.get_attribute("aria-label")
        assert figure.locator(".shown img").count() > 0
        opened.keyboard.press("Escape")
        pixels = opened.evaluate(PIXELS, point.element_handle())
        assert any(max(abs(a - b) for a, b in zip(pixel, colour, strict=True)) < 40 for pixel in pixels)
    points.nth(0).focus()
    opened.keyboard.press("ArrowRight")
    assert "rank 2 of 5" in opened.evaluate("document.activeElement.ariaLabel")


PIXELS = """(spot) => {
    const image = spot.parentElement.querySelector("img");
    const [at, of] = [spot.getBoundingClientRect(), image.getBoundingClientRect()];
    const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight).getContext("2d");
    canvas.drawImage(image, 0, 0);
    const scale = image.naturalWidth / of.width;
    const x = (at.x + at.width / 2 - of.x) * scale, y = (at.y + at.height / 2 - of.y) * scale;
    const found = canvas.getImageData(x - 3, y - 3, 7, 7).data;
    return Array.from({ length: 49 }, (_, n) => [...found.slice(4 * n, 4 * n + 3)]);
}"""
"""Returns the colours of the picture under the centre of a place."""


def test_axe_finds_nothing_serious(opened):
    opened.get_by_role("button", name="mistaken for").first.click()
    assert serious(opened) == []
