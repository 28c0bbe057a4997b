"""Enrolment over HTTP and on the page: the next answer uses the touches, and undoing removes only what was added."""

import base64
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import quote

import httpx
import pytest

import retrieval
from retrieval.indexing.build import build_index
from retrieval.indexing.sharded import build_sharded
from tests.browser import address, ask, page, serious
from tests.reference_model import NAMES, write_reference_model
from tests.serving import listening, problem, service, with_history

NEW = "Größe/neues Teil"
PATH = f"/v1/objects/{quote(NEW)}/touches"


@pytest.fixture
def known(catalogue, tmp_path):
    """An index whose model compares reference touches."""
    build_index(catalogue, write_reference_model(tmp_path / "model.safetensors"), tmp_path / "index")
    return tmp_path / "index"


def body(*grasps, **options):
    return {"touches": [[base64.b64encode(path.read_bytes()).decode() for path in grasp] for grasp in grasps]} | options


def test_an_enrolled_object_is_found_and_shown_until_its_touches_are_removed(known, touches, tmp_path):
    first, second, other = touches[NAMES[0]]
    with with_history(known, tmp_path, serve=listening) as (url, _), httpx.Client(base_url=url) as client:
        before = client.post("/v1/query", json=body(second)).json()["results"]
        assert client.post(PATH, json=body(first, opening_mm=[30])).json()["touches"] == 1
        with retrieval.open(known) as searcher:
            searcher.enrol(NEW, other)  # as another process does
        made = client.post(PATH, json=body(second))
        assert (made.status_code, made.json()["object_id"], made.json()["touches"]) == (201, NEW, 3)
        about = client.get("/v1/index").json()
        assert (about["objects"], about["photos"], about["enrolled_touches"], about["can_enrol"]) == (9, 24, 3, True)
        answer = client.post("/v1/query", json=body(second))
        best = answer.json()["results"][0]
        assert best["object_id"] == NEW
        assert client.get(f"/v1/photos/{quote(best['photo'])}").content == second[0].read_bytes()
        whole = client.get("/v1/catalogue", params={"offset": 23, "limit": 2}).json()
        assert (whole["total"], [one["object_id"] for one in whole["items"]]) == (27, [NAMES[-1], NEW])
        assert client.get("/v1/catalogue", params={"search": "größe", "object": NEW}).json()["total"] == 3
        assert client.delete(PATH, params={"touch": made.json()["added"]}).json() == {"object_id": NEW, "removed": 1}
        assert client.delete(PATH).json()["removed"] == 2
        problem(client.delete(PATH), 404, "unknown")
        assert client.post("/v1/query", json=body(second)).json()["results"] == before
        assert client.get(f"/v1/history/{answer.headers['x-query-id']}").json()["answer"] == answer.json()


def test_touches_that_cannot_be_enrolled_are_refused_with_the_reason(client, known, touches, monkeypatch):
    touch = touches[NAMES[0]][0]
    assert "no calibration of reference touches" in problem(client.post(PATH, json=body(touch)), 422, "bad-input")
    assert not client.get("/v1/index").json()["can_enrol"]
    with service(known) as client:
        assert client.post(PATH, json=body(touch)).status_code == 201
        assert f"already, for {NEW}" in problem(client.post(PATH, json=body(touch)), 422, "bad-input")
        monkeypatch.setattr("os.access", lambda path, mode: False)
        for request in (client.post(PATH, json=body(touch)), client.delete(PATH)):
            assert "may not write to" in problem(request, 403, "refused")


def test_clients_of_a_sharded_index_enrol_at_once(catalogue, touches, tmp_path):
    index = tmp_path / "shards"
    build_sharded(catalogue, write_reference_model(tmp_path / "model.safetensors"), index, 2)
    with listening(index) as (url, _), retrieval.Client(url) as client, ThreadPoolExecutor(4) as threads:
        made = list(threads.map(lambda name: client.enrol(f"new/../{name}", touches[name]), NAMES))
        assert made == [(f"new/../{name}", 3, 3) for name in NAMES]
        found = client.query(touches[NAMES[3]][1], top=99).top
        assert (found.object_id, client.photo(found)) == (f"new/../{NAMES[3]}", touches[NAMES[3]][1][0].read_bytes())


@pytest.mark.slow
def test_the_page_remembers_a_touch_and_undoes_it(browser, known, touches):
    with address(known) as url, page(browser, url, 390) as opened:
        ask(opened, touches[NAMES[0]][0])
        opened.get_by_label("Remember this touch as").fill(NEW)
        for press, focused in (("Remember", "Undo"), ("Undo", "")):
            opened.get_by_role("button", name=press, exact=True).focus()
            opened.keyboard.press("Enter")
            opened.get_by_role("button", name={"Remember": "Undo", "Undo": "Remember"}[press], exact=True).wait_for()
            assert opened.evaluate("document.activeElement.textContent") == focused
            assert serious(opened) == []
            assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert opened.evaluate("document.activeElement.value") == NEW
