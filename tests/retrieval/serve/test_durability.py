"""Acknowledged feedback survives SIGKILL, once."""

import random
import signal
import threading
import time

import httpx
import pytest

from retrieval.data.dataset import load_grasps
from tests.serving import command, with_history


def kill_during_feedback(index, folder, body, name, after_s):
    """Run the command, send feedback on one query after the other, kill it, and return the acknowledged queries."""
    acknowledged = []
    with command("--index", index, "--port", "0", "--history", folder) as (process, url, _):

        def send_feedback():
            with httpx.Client(base_url=url, timeout=30) as client:
                while True:
                    try:
                        query = client.post("/v1/query", json=body).headers["x-query-id"]
                        response = client.post(
                            "/v1/feedback", json={"query": query, "feedback": "object", "object_id": name}
                        )
                    except httpx.HTTPError:
                        return
                    if response.status_code == 201:
                        acknowledged.append(query)

        sender = threading.Thread(target=send_feedback)
        sender.start()
        while not acknowledged and sender.is_alive():
            time.sleep(0.01)
        time.sleep(after_s)
        process.send_signal(signal.SIGKILL)
        sender.join(60)
    return acknowledged


@pytest.mark.slow
def test_all_acknowledged_feedback_survives_a_kill_once(index, touch, body, tmp_path, searcher):
    name, rng, every = searcher.generation.rows[0].object_id, random.Random(0), []
    for _ in range(2):
        every += kill_during_feedback(index, tmp_path, body, name, rng.random())
    with with_history(index, tmp_path, info=feedback_info(tmp_path)) as client:
        client.get("/v1/history")
        stored = [client.get(f"/v1/history/{query}").json() for query in every]
    assert [(one["feedback"], one["object_id"]) for one in stored] == [("object", name)] * len(every)
    recorded = [grasp.grasp_id for grasp in load_grasps(tmp_path / "recording")]
    assert len(set(recorded)) == len(recorded)
    assert {f"{query}-00" for query in every} <= set(recorded)


def feedback_info(folder):
    """Return the information of the recording that the command began."""
    from robot.recording.folder import read_info

    info = read_info(folder / "recording")
    return {key: info[key] for key in ("source", "sensor")}
