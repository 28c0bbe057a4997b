"""Verification on the page in a real browser: the expected object, the decision, and its error rates."""

import pytest

from retrieval.search.searcher import Searcher
from tests.browser import address, choose, page, serious
from tests.verification import calibration, verified_index


def verify(opened, name, files):
    choose(opened, "Choose gel images", files)
    opened.get_by_label("Expected object").fill(name)
    opened.get_by_text(f"to compare with {name}").wait_for()
    opened.get_by_role("button", name="Verify").click()
    opened.locator(".answer").wait_for()


def text_of(locator):
    """Return a text with plain spaces and minus signs."""
    return locator.inner_text().replace("\u00a0", " ").replace("\u2212", "-")


@pytest.fixture(scope="module")
def names(catalogue):
    return sorted(path.name for path in catalogue.iterdir() if path.is_dir())


@pytest.mark.parametrize(
    ("accept", "reject", "claim", "sentence"),
    [
        (-1e3, -2e3, "Accept", "reaches -1000.0. False-accept rate: 1.0"),
        pytest.param(1e3, 999.0, "Reject", "1000.0 is needed. False-reject rate: ", marks=pytest.mark.slow),
        pytest.param(1e3, -1e3, "Another grasp needed", "lies between -1000.0 (reject) and", marks=pytest.mark.slow),
    ],
)
def test_the_decision_on_the_expected_object_is_shown_with_its_ratio_and_error_rates(
    tmp_path, model, catalogue, browser, files, names, accept, reject, claim, sentence
):
    index, name = verified_index(tmp_path, model, catalogue, calibration(accept, reject)), names[0]
    with Searcher.open(index) as searcher:
        expected = searcher.verify([files[:2]], name)
    with address(index) as url, page(browser, url) as opened:
        verify(opened, name, files[:2])
        assert opened.locator(".above").inner_text() == f"Is it {name}?"
        assert opened.locator(".claim").inner_text() == claim
        below = text_of(opened.locator(".below"))
        assert sentence in below
        ratio = f"{expected.log_ratios[-1]:z.1f}"
        assert ratio in below
        rates = text_of(opened.get_by_label("Error rates"))
        assert f"{ratio} after grasp 1" in rates
        interval = expected.bounds.false_accepts
        assert f"1.0 % [{100 * interval.low:.1f} %, {100 * interval.high:.1f} %]" in rates
        assert claim in opened.get_by_role("status").first.inner_text()  # for screen readers


@pytest.mark.slow
def test_the_expected_object_is_a_suggestion_and_the_false_accept_rate_an_option(
    tmp_path, model, catalogue, browser, files, names
):
    index = verified_index(tmp_path, model, catalogue, calibration(1e3, -1e3))
    with address(index) as url, page(browser, url, 390, color_scheme="dark") as opened:
        opened.get_by_label("Expected object").focus()
        options = opened.locator("#expected-object-names option")
        options.nth(len(names) - 1).wait_for(state="attached")
        assert sorted(options.evaluate_all("all => all.map((one) => one.value)")) == names
        verify(opened, names[0], files[:2])
        assert serious(opened) == []
        assert opened.evaluate("document.documentElement.scrollWidth") <= 390
        opened.get_by_text("Options").click()
        opened.get_by_label("False-accept rate of a verification").fill("0.001")
        opened.get_by_role("button", name="Verify").click()
        opened.get_by_role("alert").get_by_text("a false-accept rate of 0.001 needs 246 validation objects").wait_for()
        opened.get_by_label("Expected object").fill("")
        opened.get_by_role("button", name="Ask", exact=True).click()
        opened.locator(".photos").wait_for()
