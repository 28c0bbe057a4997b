"""The rosbridge client with scripted servers on a real websocket: each failure is a DeviceError within its timeout."""

import contextlib
import json
import math
import threading

import pytest

from robot.drivers.sawyer.codec import encode
from robot.drivers.sawyer.driver import RosbridgeLink
from robot.errors import DeviceError


@contextlib.contextmanager
def scripted(answer):
    """Run a websocket server; `answer(operation)` returns the replies, or None to break the connection."""
    from websockets.sync.server import serve as listen

    received = []

    def handle(socket):
        with contextlib.suppress(Exception):
            for text in socket:
                received.append(json.loads(text))
                replies = answer(received[-1])
                if replies is None:
                    return
                for reply in replies:
                    socket.send(reply if isinstance(reply, str | bytes) else json.dumps(reply))

    server = listen(handle, "127.0.0.1", 0, compression=None, close_timeout=0.2)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}", received
    finally:
        server.shutdown()
        thread.join()


@contextlib.contextmanager
def linked(answer, timeout_s=5.0):
    """Yield a link to a scripted server."""
    with scripted(answer) as (url, _), contextlib.closing(RosbridgeLink(url, timeout_s=timeout_s)) as link:
        link.open()
        yield link
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("rosbridge ")]


def reply_to(operation, **changes):
    return {"op": "service_response", "id": operation["id"], "values": {"x": 1}, "result": True} | changes


@pytest.mark.parametrize("value", [math.nan, object()])
def test_values_that_json_cannot_express_are_not_sent(value):
    with pytest.raises(DeviceError, match="plain finite values"):
        encode({"op": "publish", "msg": value})


def test_noise_or_a_late_answer_is_never_that_of_the_next_call():
    calls = []

    def answer(operation):
        calls.append(operation)
        noise = [reply_to(operation, id=["other"]), "noise", b"\xff", "[]", '{"op": "dance"}']
        return [] if len(calls) == 1 else [reply_to(calls[0], values={"x": "old"}), *noise, reply_to(operation)]

    with linked(answer) as link:
        link.timeout_s = 0.05
        with pytest.raises(DeviceError, match=r"no answer of /s within 0\.05 s"):
            link.call("/s", {})
        link.timeout_s = 5.0
        assert link.call("/s", {}) == {"x": 1}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"result": False, "values": "no such thing"}, "/s failed: no such thing"),
        ({"values": [1]}, r"/s failed: \[1\]"),
    ],
)
def test_a_failed_call_raises_with_the_reason(changes, message):
    with linked(lambda operation: [reply_to(operation, **changes)]) as link, pytest.raises(DeviceError, match=message):
        link.call("/s", {})


def test_a_status_error_that_names_a_call_fails_it_and_others_are_logged(caplog):
    def answer(operation):
        return [
            {"op": "status", "level": "warning", "msg": "slow", "id": operation["id"]},
            {"op": "status", "level": "error", "msg": "type unknown", "id": operation["id"]},
        ]

    with linked(answer) as link, pytest.raises(DeviceError, match="/s failed: type unknown"):
        link.call("/s", {})
    assert "slow" in caplog.text


def test_a_connection_that_breaks_ends_every_wait_at_once():
    with linked(lambda _: None, timeout_s=60.0) as link:
        with pytest.raises(DeviceError, match=r"the connection to rosbridge at .* is closed"):
            link.call("/s", {})
        uses = (link.publish, "/t", {}), (link.wait_for, "/t"), (link.call, "/s", {}), (link.check,)
        for use, *arguments in uses:
            with pytest.raises(DeviceError, match="is closed"):
                use(*arguments)


def test_nothing_published_on_a_lost_connection_is_sent_later():
    """With clients that reconnect automatically, an old motion command arrives seconds later."""
    with scripted(lambda operation: None if operation["op"] == "call_service" else []) as (url, received):
        link = RosbridgeLink(url, timeout_s=5.0)
        link.open()
        with pytest.raises(DeviceError):
            link.call("/break", {})
        with pytest.raises(DeviceError):
            link.publish("/robot/limb/right/joint_command", {"position": [1.0]})
        link.close()
        again = RosbridgeLink(url, timeout_s=5.0)
        again.open()
        again.publish("/t", {})
        with pytest.raises(DeviceError):
            again.call("/break", {})
        again.close()
        assert [operation["op"] for operation in received] == ["call_service", "publish", "call_service"]
        assert received[1]["topic"] == "/t"


def test_a_silent_server_a_closed_port_and_an_invalid_name_are_device_errors():
    import socket

    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(DeviceError, match="roslaunch rosbridge_server"):
            RosbridgeLink(f"ws://127.0.0.1:{port}", timeout_s=0.1).open()
    for url in (f"ws://127.0.0.1:{port}", "ws://no such host:9090", "ws://[::1:9090"):
        with pytest.raises(DeviceError, match="rosbridge must answer at"):
            RosbridgeLink(url, timeout_s=0.5).open()
