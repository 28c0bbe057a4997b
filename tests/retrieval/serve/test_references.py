"""Reference touches over HTTP and on the page: their gel images by id, and an object without photos."""

import base64
import io

import pytest
from PIL import Image

from retrieval.data.dataset import load_grasps
from retrieval.indexing.build import build_index
from tests.browser import address, ask, page, serious
from tests.reference_model import NAMES, write_reference_model
from tests.serving import problem, service, with_history


@pytest.fixture
def index(catalogue_with_touches, tmp_path):
    build_index(catalogue_with_touches, write_reference_model(tmp_path / "model.safetensors"), tmp_path / "index")
    return tmp_path / "index"


def body(grasp):
    return {"touches": [[base64.b64encode(path.read_bytes()).decode() for path in grasp]]}


def test_the_reference_gel_images_of_an_answer_are_served(index, catalogue_with_touches, touches):
    with service(index) as client:
        found = client.post("/v1/query", json=body(touches[NAMES[1]][1])).json()
        best = {match["object_id"]: match for match in found["results"]}[NAMES[1]]
        assert best["reference"]["touch"] == [f"{NAMES[1]}/touch_1_{finger}.png" for finger in "ab"]
        for path in best["reference"]["touch"]:
            whole, small = client.get(f"/v1/photos/{path}"), client.get(f"/v1/photos/{path}?px=64")
            assert whole.content == (catalogue_with_touches / path).read_bytes()
            assert max(Image.open(io.BytesIO(small.content)).size) == 64
            assert client.get(f"/v1/photos/{path}", headers={"if-none-match": whole.headers["etag"]}).status_code == 304
        # Files in the catalogue folder that are not references of the index are not served.
        (catalogue_with_touches / NAMES[5]).joinpath("touch_0_a.png").write_bytes(whole.content)
        assert problem(client.get(f"/v1/photos/{NAMES[5]}/touch_0_a.png"), 404, "unknown")


def test_feedback_on_an_object_without_photos_adds_no_photo(index, touches, tmp_path):
    with with_history(index, tmp_path) as client:
        for name in (NAMES[0], NAMES[2]):
            response = client.post("/v1/query", json=body(touches[name][0]))
            feedback = {"query": response.headers["x-query-id"], "feedback": "object", "object_id": name}
            assert client.post("/v1/feedback", json=feedback).status_code == 201
            entry = client.get(f"/v1/history/{feedback['query']}").json()
            assert (entry["feedback"], entry["object_id"]) == ("object", name)
            assert entry["answer"] == response.json()
    assert [grasp.object_id for grasp in load_grasps(tmp_path / "recording")] == [NAMES[0]]


@pytest.mark.slow
def test_the_page_shows_the_nearest_reference_touch_next_to_photo_and_touch(browser, index, touches):
    with address(index) as url, page(browser, url, 390) as opened:
        ask(opened, touches[NAMES[1]][1])
        card = opened.locator(".photo.object", has_text=NAMES[1])
        assert card.locator(".reference img").count() == 2
        opened.get_by_text("How this was found").click()
        opened.get_by_text("8 of 4 objects; calibrated on 40 touches of 20 objects").wait_for()
        card.locator("button").click()
        dialog = opened.get_by_role("dialog", name=NAMES[1])
        dialog.get_by_role("img", name="Gel image: Nearest reference touch, finger A").wait_for()
        dialog.get_by_label("Reference touch next to the photo").select_option("1")
        dialog.get_by_role("img", name="Gel image: Nearest reference touch, finger B").wait_for()
        assert "cosine 1.00; references add" in dialog.inner_text()
        assert serious(opened) == []
        assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")
    with address(index) as url, page(browser, url) as opened:
        ask(opened, touches[NAMES[2]][0])
        opened.locator(".photo.object", has_text=NAMES[2]).locator("button").click()
        opened.get_by_role("dialog", name=NAMES[2]).get_by_text("no photo: scored by its touches only").wait_for()
