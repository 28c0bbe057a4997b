"""The page in a real browser: feedback, the history, the catalogue."""

import json
from urllib.parse import parse_qs, urlsplit

import pytest

from tests import synthetic
from tests.browser import address, ask, page, serious
from tests.serving import with_history

pytestmark = pytest.mark.slow
MANY = 100_000


@pytest.fixture(scope="module")
def url(index, tmp_path_factory):
    with with_history(index, tmp_path_factory.mktemp("history"), serve=address) as found:
        yield found


@pytest.fixture
def opened(browser, url):
    with page(browser, url) as found:
        yield found


def open_view(opened, name):
    """Open a view by its link."""
    opened.get_by_role("navigation").get_by_role("link", name=name).click()


def test_feedback_is_stored_and_shown_in_the_history(opened, files):
    ask(opened, files)
    opened.get_by_role("button", name="It was another object").click()
    name = opened.locator(".photo.object .name").nth(2).inner_text()
    opened.get_by_label("Which object was it?").fill(name)
    opened.get_by_role("list", name="Objects", exact=True).get_by_role("button", name=name).click()
    opened.get_by_text(f"Feedback: {name}.").wait_for()
    open_view(opened, "History")
    opened.get_by_label("Feedback", exact=True).select_option("Another object")
    opened.locator(".query", has_text=f"Feedback: {name}").first.get_by_role("link").click()
    opened.locator(".answer").get_by_text(f"Feedback: {name}.").wait_for()
    assert opened.get_by_alt_text("Gel image").count() == 4


@pytest.mark.parametrize(
    ("button", "text"), [("Right", "Feedback: right."), ("Not in the catalogue", "Feedback: not in the catalogue.")]
)
def test_feedback_right_and_none_take_one_click_and_appear_in_the_history(opened, files, button, text):
    opened.get_by_text("Options").click()
    prior = opened.get_by_label("Prior probability that the catalogue lacks the object")
    prior.fill("0.001")  # so that the answer is an object, which has both buttons
    prior.blur()
    ask(opened, files)
    panel = opened.get_by_role("region", name="Was this right?")
    panel.get_by_role("button", name=button, exact=True).click()
    opened.get_by_text(text).wait_for()
    assert panel.get_by_role("button").count() == 0
    open_view(opened, "History")
    opened.locator(".query").first.get_by_text(text.removesuffix(".")).wait_for()
    opened.get_by_role("searchbox", name="Search").fill("words that never occur")
    opened.get_by_text("No matching queries.").wait_for()
    opened.get_by_role("searchbox", name="Search").fill("")
    opened.locator(".query").first.wait_for()


def test_of_100_000_photos_only_those_on_the_screen_are_requested_and_keys_move_to_the_end(opened):
    offsets = []

    def listed(route):
        parameters = {name: values[0] for name, values in parse_qs(urlsplit(route.request.url).query).items()}
        offset, limit = int(parameters.get("offset", 0)), int(parameters["limit"])
        offsets.append(offset)
        last = min(MANY, offset + limit)
        items = [{"id": f"o{one}/1.jpg", "object_id": f"object {one}", "metadata": {}} for one in range(offset, last)]
        document = {"generation": "g", "total": MANY, "offset": offset, "next": None, "items": items}
        route.fulfill(content_type="application/json", body=json.dumps(document))

    picture = synthetic._jpeg(synthetic.draw_background(1))
    opened.route("**/v1/catalogue*", listed)
    opened.route("**/v1/photos/**", lambda route: route.fulfill(content_type="image/jpeg", body=picture))
    open_view(opened, "Catalogue")
    opened.get_by_text("100,000 photos of").wait_for()
    opened.locator(".grid li").first.wait_for()
    assert opened.locator(".grid li").count() < 100
    for fraction in (0.5, 0.99, 0.2):
        opened.evaluate("(part) => scrollTo(0, part * document.documentElement.scrollHeight)", fraction)
        opened.wait_for_timeout(300)
        opened.locator(".grid li").first.wait_for()
        opened.locator(".grid button").last.get_by_text("object ").wait_for()
        places = [int(one) for one in opened.locator(".grid li").evaluate_all("all => all.map((o) => o.dataset.place)")]
        assert len(places) < 120
        assert max(places) == pytest.approx(fraction * MANY, rel=0.02)
    assert len(set(offsets)) < 12  # of 500 pages
    opened.locator(".grid button").first.focus()
    for key, place in (("Home", 0), ("ArrowRight", 1), ("End", MANY - 1), ("Home", 0)):
        opened.keyboard.press(key)
        opened.locator(f".grid li[aria-posinset='{place + 1}'] button:focus", has_text=f"object {place}").wait_for()


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_axe_finds_nothing_serious_in_any_view_and_none_is_wider_than_the_screen(browser, url, files, width, scheme):
    with page(browser, url, width, color_scheme=scheme) as opened:
        ask(opened, files)
        opened.get_by_role("button", name="It was another object").click()
        opened.locator(".names button").first.wait_for()
        for name, shown in (("", ""), ("Catalogue", ".grid li"), ("History", ".query")):
            if name:
                open_view(opened, name)
                opened.locator(shown).first.wait_for()
            assert serious(opened) == [], name
            assert opened.evaluate("document.documentElement.scrollWidth") <= width, name
