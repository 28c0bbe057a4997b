"""What was acknowledged is there after SIGKILL, once."""

import random
import signal
import threading
import time

import httpx
import pytest

from retrieval.data.dataset import load_grasps
from retrieval.serve.store import HistoryStore
from tests.serving import command, with_history


def kill_during_feedback(index, folder, body, name, after_s):
    """Starts the command, says of one query after the other what it was, and kills it; the words acknowledged."""
    acknowledged = []
    with command("--index", index, "--port", "0", "--history", folder) as (process, url, _):

        def speak():
            with httpx.Client(base_url=url, timeout=30) as client:
                while True:
                    try:
                        query = client.post("/v1/query", json=body).headers["x-query-id"]
                        said = client.post(
                            "/v1/feedback", json={"query": query, "feedback": "object", "object_id": name}
                        )
                    except httpx.HTTPError:
                        return
                    if said.status_code == 201:
                        acknowledged.append(query)

        speaker = threading.Thread(target=speak)
        speaker.start()
        while not acknowledged and speaker.is_alive():
            time.sleep(0.01)
        time.sleep(after_s)
        process.send_signal(signal.SIGKILL)
        speaker.join(60)
    return acknowledged


@pytest.mark.slow
def test_every_word_that_was_acknowledged_before_a_kill_is_there_once(index, touch, body, tmp_path, searcher):
    name, draw, every = searcher.generation.rows[0]["object_id"], random.Random(0), []
    for _ in range(3):
        every += kill_during_feedback(index, tmp_path, body, name, draw.random())
    with with_history(index, tmp_path, info=feedback_info(tmp_path)) as client:
        client.get("/v1/history")
        kept = [client.get(f"/v1/history/{query}").json() for query in every]
    assert [(one["feedback"], one["object_id"]) for one in kept] == [("object", name)] * len(every)
    recorded = [grasp.grasp_id for grasp in load_grasps(tmp_path / "recording")]
    assert len(set(recorded)) == len(recorded)
    assert {f"{query}-00" for query in every} <= set(recorded)


def feedback_info(folder):
    """What the recording that the command began says of itself."""
    from robot.recording.folder import read_info

    info = read_info(folder / "recording")
    return {key: info[key] for key in ("source", "sensor")}


def test_a_database_whose_writer_was_killed_has_all_that_it_said_it_has(tmp_path, searcher, touch):
    """A copy of the files as they lie while the database is open is what a kill leaves."""
    import shutil

    store = HistoryStore(tmp_path / "a" / "history.sqlite", 10, 2**30)
    store.keep("1", [[path.read_bytes() for path in touch]], None, searcher.query(touch), "m")
    store.add_feedback("1", "object", "mug", b"photo")
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    left = HistoryStore(tmp_path / "b" / "history.sqlite", 10, 2**30)
    assert left.recordable() == [("1", "mug")]
    assert left.picture("1", 1, "a") == touch[0].read_bytes()
    assert left.photo("1") == b"photo"
    left.close()
    store.close()
