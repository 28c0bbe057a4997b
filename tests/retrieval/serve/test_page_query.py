"""A query and its answer in a real browser: the page tests that are fast enough for every test run."""

import pytest

from tests.browser import address, ask, page


@pytest.fixture(scope="module")
def opened(index, browser, files):
    """The page after a query of two grasps."""
    with address(index) as url, page(browser, url) as found:
        ask(found, files)
        yield found


def test_the_bars_of_the_answer_including_none_of_these_add_up_to_1(opened):
    bars = [float(one) for one in opened.locator("[data-p]").evaluate_all("all => all.map((one) => one.dataset.p)")]
    assert len(bars) == 9  # eight objects, none of these
    assert sum(bars) == pytest.approx(1, abs=1e-6)
    assert bars == sorted(bars, reverse=True)
    assert opened.locator(".photo .name", has_text="None of these").is_visible()
    verdicts = ("Most likely", "Best match", "No object is named")
    assert opened.locator(".above").inner_text() in verdicts
    claim = opened.locator(".claim").inner_text()
    assert claim in opened.get_by_role("status").first.inner_text()  # for screen readers
    assert opened.locator(".photo img").count() == 8
    assert opened.locator(".photo img").evaluate_all("all => all.every((one) => one.loading === 'lazy')")


def test_a_click_shows_all_photos_of_an_object_next_to_the_touch_and_enlarges_them(opened):
    name = opened.locator(".photo.object .name").first.inner_text()
    opened.locator(".photo.object button").first.click()
    dialog = opened.get_by_role("dialog", name=name)
    dialog.locator(".film").first.locator("li").nth(2).wait_for()
    assert dialog.get_by_label("Photos of this object").get_by_role("button").count() == 3
    assert dialog.get_by_alt_text("Gel image: Grasp 1, finger a").is_visible()
    dialog.get_by_label("Touch next to the photo").select_option("Grasp 2, finger b")
    assert dialog.get_by_alt_text("Gel image: Grasp 2, finger b").is_visible()
    dialog.get_by_role("button", name="Photo 2 of 3").click()
    assert dialog.get_by_alt_text(f"Photo {name}/2.jpg").is_visible()
    small = dialog.get_by_alt_text(f"Photo {name}/2.jpg").bounding_box()["height"]
    dialog.get_by_role("button", name="Enlarge the photo").click()
    assert dialog.get_by_alt_text(f"Photo {name}/2.jpg").bounding_box()["height"] > small
    assert not dialog.get_by_alt_text("Gel image").is_visible()
    opened.keyboard.press("Escape")
    assert dialog.count() == 0
