"""A service for tests: in this process, or as the command on a port of its own."""

import queue
import re
import signal
import socket
import sys
import threading
from contextlib import contextmanager, suppress

from fastapi.testclient import TestClient

from retrieval.serve.app import create_app
from retrieval.serve.server import Server, uvicorn_config
from retrieval.serve.settings import ServiceSettings
from robot.recording.folder import RecordingWriter
from tests.waiting import run_process

INFO = {"source": "feedback on queries", "sensor": "drawn gel"}
"""Information of the feedback recording."""


@contextmanager
def service(index, rig=None, recorder=None, **settings):
    """Yield a client of the application, which runs in this process."""
    app = create_app(ServiceSettings(index=index, **settings), rig, recorder)
    with TestClient(app, base_url="http://127.0.0.1:8000", raise_server_exceptions=False) as client:
        yield client


@contextmanager
def with_history(index, folder, rig=None, serve=service, info=INFO):
    """Run `serve` (`service`, `listening` or `browser.address`) with a history in `folder`; yield its result."""
    with (
        RecordingWriter(folder / "recording", info) as writer,
        serve(index, rig, writer, history=folder) as found,
    ):
        yield found


@contextmanager
def listening(index, rig=None, recorder=None, **settings):
    """Serve the application in a thread on a free port; yield its address and its parts."""
    app = create_app(ServiceSettings(index=index, port=0, **settings), rig, recorder)
    ports = queue.Queue()
    server = Server(uvicorn_config(app), app.state.service, ports.put)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        yield f"http://127.0.0.1:{ports.get(timeout=60)}", app.state.service
    finally:
        server.handle_exit(signal.SIGTERM, None)
        thread.join(60)
        assert not thread.is_alive()


@contextmanager
def command(*options, **popen):
    """Run `retrieve serve` as a process; yield the process, its address, and the list of its stderr lines."""
    line = [sys.executable, "-m", "retrieval", "serve", *map(str, options)]
    with run_process(line, **popen) as process:
        output, listening = [], threading.Event()

        def listen():
            with suppress(ValueError):  # the killed process's pipe was closed in the meantime
                for text in process.stderr:
                    output.append(text)
                    if "listening on" in text:
                        listening.set()
            listening.set()

        threading.Thread(target=listen, daemon=True).start()
        assert listening.wait(120), "it did not listen within two minutes"
        found = re.search(r"listening on (\S+)", "".join(output))
        assert found, "".join(output)
        yield process, found[1], output


def connect(url, sent=b""):
    """Return a connection to the service at this address, on which `sent` is sent."""
    host, port = url.removeprefix("http://").split(":")
    line = socket.create_connection((host, int(port)), timeout=30)
    line.sendall(sent)
    return line


def received(line):
    """Return all bytes that arrive until the connection ends."""
    data = b""
    with suppress(ConnectionResetError):
        while more := line.recv(65536):
            data += more
    return data


def problem(response, status, kind):
    """Return the detail of a response that must be a problem document of this kind."""
    assert (response.status_code, response.headers["content-type"]) == (status, "application/problem+json"), (
        response.text
    )
    document = response.json()
    assert set(document) == {"type", "title", "status", "detail"}
    assert (document["type"], document["status"]) == (f"urn:touch-retrieval:problem:{kind}", status)
    return document["detail"]
