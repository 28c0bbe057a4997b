"""The history: stored queries and feedback as a recording for training."""

import base64
import random
import sqlite3
import threading
from contextlib import suppress

import httpx
import pytest

from retrieval.data.check.recording import check_recording
from retrieval.data.dataset import load_grasps
from retrieval.errors import BadInput
from retrieval.serve.store import HistoryStore
from robot.recording.folder import RecordingWriter, read_info
from tests.serving import INFO, command, problem, service, with_history


@pytest.fixture(scope="module")
def touches(touches):
    """The image files of two grasps of each of three catalogue objects, by object."""
    return {
        name: [[path.read_bytes() for path in grasp] for grasp in touches[name][:2]] for name in sorted(touches)[:3]
    }


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "history"


@pytest.fixture
def client(index, folder):
    with with_history(index, folder) as client:
        yield client


def ask(client, grasps, **options):
    encoded = [[base64.b64encode(image).decode() for image in grasp] for grasp in grasps]
    response = client.post("/v1/query", json={"touches": encoded, **options})
    assert response.status_code == 200, response.text
    return response.headers["x-query-id"], response.json()


def add_feedback(client, query, feedback, object_id=None):
    return client.post("/v1/feedback", json={"query": query, "feedback": feedback, "object_id": object_id})


def test_the_history_stores_answers_and_gel_images_and_is_paged_from_the_newest_and_searched(client, touches):
    asked = [ask(client, grasps) for grasps in touches.values()]
    queries = [query for query, _ in asked]
    for (query, answer), grasps in zip(asked, touches.values(), strict=True):
        entry = client.get(f"/v1/history/{query}").json()
        assert (entry["id"], entry["answer"], entry["feedback"]) == (query, answer, None)
        assert entry["best"] == answer["results"][0]["object_id"]
        assert [[client.get(path).content for path in paths] for paths in entry["touches"]] == grasps
    add_feedback(client, queries[0], "object", sorted(touches)[0])
    first = client.get("/v1/history", params={"limit": 2}).json()
    rest = client.get("/v1/history", params={"limit": 2, "offset": first["next"]}).json()
    assert [item["id"] for item in first["items"] + rest["items"]] == queries[::-1]
    assert (first["total"], rest["next"]) == (3, None)
    for filters, found in (
        ({"search": f"object {sorted(touches)[0].upper()}"}, queries[:1]),
        ({"feedback": "missing"}, queries[:0:-1]),
        ({"feedback": "object"}, queries[:1]),
        ({"feedback": "none"}, []),
    ):
        assert [item["id"] for item in client.get("/v1/history", params=filters).json()["items"]] == found


def test_feedback_becomes_a_readable_recording(client, touches, folder, catalogue):
    names = sorted(touches)
    for name, grasps in touches.items():
        query, _ = ask(client, grasps, opening_mm=[31.5, None])
        response = add_feedback(client, query, "object", name)
        assert (response.status_code, response.json()["recorded"]) == (201, True)
    recorded = load_grasps(folder / "recording")
    assert sorted(grasp.object_id for grasp in recorded) == sorted(names * 2)
    for grasp in recorded:
        place = int(grasp.grasp_id[-2:])
        assert [path.read_bytes() for path in grasp.touches] == touches[grasp.object_id][place]
        assert grasp.opening_mm == [31.5, None][place]
        assert grasp.photo.read_bytes() in [path.read_bytes() for path in (catalogue / grasp.object_id).iterdir()]
    assert not [found for found in check_recording(folder / "recording") if found.severity == "error"]


def test_feedback_right_records_the_found_object_once_and_is_not_changed(client, touches, folder):
    query, answer = ask(client, next(iter(touches.values())), none_prior=0.001)
    assert answer["verdict"] in ("match", "uncalibrated")
    best = answer["results"][0]["object_id"]
    responses = [add_feedback(client, query, "right") for _ in range(3)]
    assert [response.status_code for response in responses] == [201, 200, 200]
    assert responses[0].json() == {"query": query, "feedback": "right", "object_id": best, "recorded": True}
    assert "has different feedback already: right" in problem(add_feedback(client, query, "none"), 409, "conflict")
    assert [grasp.object_id for grasp in load_grasps(folder / "recording")] == [best, best]


def test_feedback_on_an_uncatalogued_object_is_stored_but_not_recorded_and_invalid_feedback_refused(
    client, touches, folder
):
    query, _ = ask(client, next(iter(touches.values())))
    problem(add_feedback(client, "no such query", "none"), 404, "unknown")
    for feedback, object_id, words in (
        ("object", None, "requires object_id"),
        ("object", "nobody's", "The index has no object"),
        ("right", "x", "takes no object_id"),
    ):
        assert words in problem(add_feedback(client, query, feedback, object_id), 422, "bad-input")
    assert add_feedback(client, query, "none", "a new mug").json()["recorded"] is False
    assert client.get(f"/v1/history/{query}").json()["object_id"] == "a new mug"
    assert (folder / "recording" / "metadata.jsonl").read_bytes() == b""


def test_unrecorded_feedback_is_recorded_at_the_next_start(index, touches, folder):
    class Full(RecordingWriter):
        def append(self, *args, **fields):
            raise OSError("the disk is full")

    name, grasps = next(iter(touches.items()))
    with Full(folder / "recording", INFO) as writer, service(index, None, writer, history=folder) as client:
        query, _ = ask(client, grasps)
        response = add_feedback(client, query, "object", name)
        assert (response.status_code, response.json()["recorded"]) == (201, False)
    with with_history(index, folder):
        pass
    assert [grasp.object_id for grasp in load_grasps(folder / "recording")] == [name, name]


def test_a_query_is_answered_without_an_id_while_the_disk_is_full(client, body, searcher):
    store = client.app.state.service.history_writer.store
    first = client.post("/v1/query", json=body).headers["x-query-id"]
    (pages,) = store._database.execute("PRAGMA page_count").fetchone()
    store._database.execute(f"PRAGMA max_page_count = {pages}")
    response = client.post("/v1/query", json=body)
    assert (response.status_code, "x-query-id" in response.headers) == (200, False)
    response = add_feedback(client, first, "object", searcher.generation.rows[0].object_id)
    assert "database or disk is full" in problem(response, 500, "failed")
    store._database.execute("PRAGMA max_page_count = 1000000")
    second = client.post("/v1/query", json=body).headers["x-query-id"]
    assert [item["id"] for item in client.get("/v1/history").json()["items"]] == [second, first]


def test_oldest_queries_without_feedback_are_deleted(touches, tmp_path, searcher):
    result, store = searcher.query(next(iter(touches.values()))), HistoryStore(tmp_path / "h.sqlite", max_queries=2)
    for number in range(10):
        store.add_query(str(number), [[b"a"]], None, result)
        if number == 3:
            store.add_feedback("3", "none", None, None)
    assert [stored.id for stored in store.history()[1]] == ["9", "8", "3"]
    assert store.pictures("7") == {}
    store.close()


def test_a_file_of_another_program_is_no_history(tmp_path):
    (tmp_path / "x").write_bytes(b"not a database, for sure" * 100)
    other = sqlite3.connect(tmp_path / "y")
    other.execute("CREATE TABLE mine (x)")
    other.close()
    for name in "xy":
        with pytest.raises(BadInput, match="must be the history of a service"):
            HistoryStore(tmp_path / name, 1)


def test_service_without_history_reports_it(index, touches):
    with service(index) as client:
        encoded = [[base64.b64encode(image).decode() for image in next(iter(touches.values()))[0]]]
        assert "x-query-id" not in client.post("/v1/query", json={"touches": encoded}).headers
        for path in ("/v1/history", "/v1/history/x"):
            problem(client.get(path), 404, "unknown")


def kill_during_feedback(index, folder, body, name, after_s):
    """Run the command, send feedback on one query after the other, kill it, and return the acknowledged queries."""
    acknowledged = []
    with (
        command("--index", index, "--port", "0", "--history", folder) as (process, url, _),
        httpx.Client(base_url=url, timeout=30) as client,
        suppress(httpx.HTTPError),  # the process is killed
    ):
        while True:
            query = client.post("/v1/query", json=body).headers["x-query-id"]
            feedback = {"query": query, "feedback": "object", "object_id": name}
            assert client.post("/v1/feedback", json=feedback).status_code == 201
            if not acknowledged:
                threading.Timer(after_s, process.kill).start()
            acknowledged.append(query)
    return acknowledged


@pytest.mark.slow
def test_all_acknowledged_feedback_survives_a_kill_once(index, body, tmp_path, searcher):
    name, rng, every = searcher.generation.rows[0].object_id, random.Random(0), []
    for _ in range(2):
        every += kill_during_feedback(index, tmp_path, body, name, rng.random())
    info = {name: value for name, value in read_info(tmp_path / "recording").items() if name in INFO}
    with with_history(index, tmp_path, info=info) as client:
        client.get("/v1/history")
        stored = [client.get(f"/v1/history/{query}").json() for query in every]
    assert [(one["feedback"], one["object_id"]) for one in stored] == [("object", name)] * len(every)
    recorded = [grasp.grasp_id for grasp in load_grasps(tmp_path / "recording")]
    assert len(set(recorded)) == len(recorded)
    assert {f"{query}-00" for query in every} <= set(recorded)
