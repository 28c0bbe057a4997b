"""The page in a real browser: queries, answers, details of an object, live pictures."""

import base64
import json
import shutil

import pytest

from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint
from tests.browser import address, ask, choose, page, serious

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def url(index):
    with address(index) as found:
        yield found


@pytest.fixture
def opened(browser, url):
    with page(browser, url) as found:
        yield found


def show_answer(document, opened, files):
    """Query a service that answers with this document."""
    opened.route("**/v1/query", lambda route: route.fulfill(json=document))
    ask(opened, files[:2])


def test_dropped_gel_images_become_grasps_by_their_names(opened, files):
    data = [{"name": path.name, "text": base64.b64encode(path.read_bytes()).decode()} for path in reversed(files)]
    opened.evaluate(
        """(files) => {
            const transfer = new DataTransfer();
            for (const {name, text} of files) {
                const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
                transfer.items.add(new File([bytes], name, {type: "image/png"}));
            }
            dispatchEvent(new DragEvent("drop", {dataTransfer: transfer, bubbles: true, cancelable: true}));
        }""",
        data,
    )
    assert opened.locator(".grasp legend").all_inner_texts() == ["Grasp 1", "Grasp 2"]
    assert opened.get_by_alt_text("Gel image").count() == 4


def test_pictures_are_removed_completed_and_their_fingers_swapped(opened, files):
    choose(opened, "Choose gel images", files[:3])
    ask_button = opened.get_by_role("button", name="Ask", exact=True)
    assert ask_button.is_disabled()  # finger b of grasp 2 is missing
    choose(opened, "Choose finger b", files[3:])
    assert ask_button.is_enabled()
    sources = lambda: opened.locator(".grasp").first.locator("img").evaluate_all("all => all.map((one) => one.src)")  # noqa: E731
    before = sources()
    opened.get_by_role("button", name="Swap fingers of grasp 1").click()
    assert sources() == before[::-1]
    opened.get_by_role("button", name="Remove grasp 2").click()
    opened.get_by_role("button", name="Remove finger a of grasp 1").click()
    assert opened.get_by_alt_text("Gel image").count() == 1
    opened.get_by_role("button", name="Start again").click()
    assert opened.get_by_text("Drop gel images here").is_visible()
    assert opened.locator(".grasp").count() == 0


def test_objects_that_are_not_shown_share_one_bar(opened, files):
    opened.get_by_text("Options").click()
    opened.get_by_label("Objects to show").fill("3")
    opened.get_by_label("Objects to show").blur()
    ask(opened, files[:2])
    bars = [float(one) for one in opened.locator("[data-p]").evaluate_all("all => all.map((one) => one.dataset.p)")]
    assert (len(bars), sum(bars)) == (5, pytest.approx(1, abs=1e-6))
    assert opened.get_by_text("5 other objects").is_visible()


@pytest.mark.parametrize(
    ("verdict", "claim", "text"),
    [
        ("none of these", "None of these", "The catalogue lacks the object with probability"),
        ("no contact", "No contact", "The gel images show no contact"),
        ("not a gel image", "Not a gel image", "do not look like the gel images"),
        ("uncalibrated", None, "This model is not calibrated"),
    ],
)
def test_every_verdict_has_its_text(opened, files, searcher, verdict, claim, text):
    document = searcher.query(files[:2]).to_dict() | {"verdict": verdict}
    if verdict != "none of these":
        document |= dict.fromkeys(("none_probability", "unlisted_probability", "posterior"))
    if verdict in ("no contact", "not a gel image"):
        document |= {"results": [], "query": {"touches": [["a.png", "b.png"]], "grasps": [verdict]}}
    show_answer(document, opened, files)
    block = opened.locator(".verdict")
    block.get_by_text(text).wait_for()
    assert block.get_by_role("heading").inner_text() == (claim or opened.locator(".photo .name").first.inner_text())
    marks = {"no contact": "no contact, not scored", "not a gel image": "not a gel image, not scored"}
    assert opened.locator(".mark").all_inner_texts() == ([marks[verdict]] if verdict in marks else [])


def test_probabilities_if_present_and_the_advice_of_the_service_are_shown(opened, files, searcher):
    """The page itself computes neither of them."""
    document = searcher.query(files[:2], none_prior=0.999).to_dict()
    assert document["verdict"] == "none of these"
    document |= {"advice": "Further grasps would help."}
    for place, match in enumerate(document["results"]):
        match["probability_if_present"] = 0.625 / 2**place
    show_answer(document, opened, files)
    best = document["results"][0]["object_id"]
    verdict = opened.locator(".verdict")
    verdict.get_by_text(f"If it contains the object, this is {best} with probability 62.5\u00a0%.").wait_for()
    assert verdict.locator(".advice").inner_text() == "Further grasps would help."
    shown = opened.locator(".photo.object .if-present").all_inner_texts()
    assert shown[:2] == ["62.5\u00a0% if present", "31.3\u00a0% if present"]
    assert len(shown) == len(document["results"])


def test_metadata_of_an_object_are_searched_and_shown(browser, catalogue, model, tmp_path):
    own, name = tmp_path / "catalog", "a mug"
    shutil.copytree(next(path for path in catalogue.iterdir() if path.is_dir()), own / name)
    shutil.copytree(next(path for path in catalogue.iterdir() if path.is_dir()), own / "a tin")
    (own / "metadata.jsonl").write_text(json.dumps({"object_id": name, "maker": "Wedgwood", "price": 3}) + "\n")
    build_index(own, load_checkpoint(model), tmp_path / "index")
    with address(tmp_path / "index") as url, page(browser, url) as opened:
        opened.get_by_role("navigation").get_by_role("link", name="Catalogue").click()
        opened.get_by_role("searchbox", name="Search").fill("wedgwood 1.jpg")
        opened.get_by_text("1 photo found").wait_for()
        opened.locator(".grid button").click()
        facts = opened.get_by_role("dialog", name=name).locator(".facts")
        facts.get_by_text("Wedgwood").wait_for()
        assert facts.locator("dt, dd").all_inner_texts() == ["maker", "Wedgwood", "price", "3"]
        opened.keyboard.press("Escape")
        opened.get_by_role("searchbox", name="Search").fill("no such words")
        opened.get_by_text("No photo of the catalogue matches all these words.").wait_for()
        assert opened.locator(".grid li").count() == 0


def test_the_browsers_camera_takes_pictures_finger_by_finger(opened):
    opened.get_by_role("button", name="Camera").click()
    opened.get_by_role("button", name="Take finger a").click()
    opened.get_by_role("button", name="Take finger b").click()
    opened.get_by_alt_text("Gel image, grasp 1, finger b").wait_for()
    assert opened.get_by_role("button", name="Ask", exact=True).is_enabled()


def test_unavailable_features_have_no_button(opened, files):
    assert opened.get_by_role("button", name="Grasp something").count() == 0
    assert opened.get_by_role("button", name="Live sensors").count() == 0
    ask(opened, files[:2])
    assert opened.get_by_role("button", name="It was another").count() == 0
    assert opened.get_by_role("link", name="History").count() == 0
    assert opened.get_by_label("Expected object").count() == 0  # the model has no error rates
    assert opened.get_by_label("False-accept rate").count() == 0


def test_the_page_requests_the_token_once(browser, index):
    token = "sixteen letters or more"
    with address(index, token=token) as url, page(browser, url) as opened:
        opened.get_by_label("Token", exact=True).last.fill("another one, which is wrong")
        opened.get_by_role("button", name="Continue").click()
        opened.get_by_text("This is not the service's token").wait_for()
        opened.get_by_label("Token", exact=True).last.fill(token)
        opened.get_by_role("button", name="Continue").click()
        opened.get_by_role("heading", name="Which object is in the hand?").wait_for()
        opened.reload()
        opened.get_by_role("heading", name="Which object is in the hand?").wait_for()


def test_a_refused_query_shows_the_message_of_the_service(opened, tmp_path):
    (tmp_path / "a.png").write_bytes(b"\x89PNG but no more")
    choose(opened, "Choose gel images", [tmp_path / "a.png"])
    choose(opened, "Choose finger b", [tmp_path / "a.png"])
    opened.get_by_role("button", name="Ask", exact=True).click()
    opened.get_by_role("alert").get_by_text("grasp 1, finger").wait_for()
    assert opened.get_by_role("button", name="Try again").is_visible()


def test_a_query_works_with_the_keyboard_only(opened, files):
    choose(opened, "Choose gel images", files[:2])  # then Ask has the focus
    opened.keyboard.press("Enter")
    opened.locator(".answer").wait_for()
    card = opened.locator(".photo.object button").first
    for _ in range(30):
        opened.keyboard.press("Tab")
        if card.evaluate("one => one === document.activeElement"):
            break
    opened.keyboard.press("Enter")
    opened.get_by_role("dialog").wait_for()
    opened.keyboard.press("Escape")
    assert card.evaluate("one => one === document.activeElement")


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_axe_finds_nothing_serious_and_nothing_is_wider_than_the_screen(browser, url, files, width, scheme):
    with page(browser, url, width, color_scheme=scheme) as opened:
        assert serious(opened) == []
        opened.get_by_text("Options").click()
        ask(opened, files)
        opened.get_by_text("How this was found").click()
        assert serious(opened) == []
        assert opened.evaluate("document.documentElement.scrollWidth") <= width
        opened.locator(".photo.object button").first.click()
        opened.locator(".film li").first.wait_for()
        assert serious(opened) == []
        assert opened.locator("dialog").evaluate("one => one.scrollWidth <= one.clientWidth")
