"""Acknowledged feedback survives SIGKILL, once."""

import random
import threading
from contextlib import suppress

import httpx
import pytest

from retrieval.data.dataset import load_grasps
from robot.recording.folder import read_info
from tests.serving import INFO, command, with_history


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
def test_all_acknowledged_feedback_survives_a_kill_once(index, touch, body, tmp_path, searcher):
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
