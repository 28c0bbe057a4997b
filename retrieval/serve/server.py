"""The HTTP server; on SIGTERM or Ctrl-C it finishes the requests in flight and ends.

h11 limits the size of the headers, `retrieval.serve.uploads` size and time of a body. Clients that send headers slowly,
or do not read, are the task of a reverse proxy (docs/service.md).
"""

import asyncio
import faulthandler
import signal
import socket
import threading
from collections.abc import Callable
from types import FrameType

import uvicorn
from fastapi import FastAPI

from retrieval.errors import BadInput
from retrieval.serve.service import Service

MAX_HEADER_BYTES = 16_384
"""Approximate maximum size of the request line and all headers of one request."""
DRAIN_S = 0.5
"""Time after the signal in which requests are still accepted: those sent before may be unread in a socket."""
SHUTDOWN_GRACE_S = 4
"""Time limit for requests in flight, after `DRAIN_S`."""
MAX_SHUTDOWN_S = 7.5
"""Maximum time from the signal to the end of the process, even if a thread hangs."""


class Server(uvicorn.Server):
    """A uvicorn server that calls `on_started` with the port when it listens, and says when it ends."""

    def __init__(self, config: uvicorn.Config, parts: Service, on_started: Callable[[int], object]) -> None:
        super().__init__(config)
        self._parts, self._on_started = parts, on_started

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, and pass the port to `on_started`."""
        await super().startup(sockets)
        if self.started:
            self._on_started(self.servers[0].sockets[0].getsockname()[1])

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Answer the requests sent so far, and end."""
        await asyncio.sleep(DRAIN_S)
        await super().shutdown(sockets)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """End the server; from now on it is not ready."""
        self._parts.stopping.set()
        super().handle_exit(sig, frame)


def serve(app: FastAPI, on_started: Callable[[int], object]) -> None:
    """Serve until SIGTERM or Ctrl-C; the process then ends within `MAX_SHUTDOWN_S`, even if a thread hangs.

    Args:
        app: Application of `create_app`.
        on_started: Called with the port when the server listens.

    Raises:
        BadInput: The server cannot listen at the host and port.
    """
    parts: Service = app.state.service
    host, port = parts.settings.host, parts.settings.port
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server(address[:2], family=family)
    except OSError as error:
        raise BadInput(f"Cannot listen on {host}, port {port}: {error.strerror or error}") from error
    for number in (signal.SIGINT, signal.SIGTERM):  # uvicorn raises the signal again at its end
        signal.signal(number, lambda *_: None)
    threading.Thread(target=_enforce_shutdown, args=(parts.stopping,), daemon=True).start()
    with listening:
        Server(uvicorn_config(app), parts, on_started).run([listening])


def _enforce_shutdown(stopping: threading.Event) -> None:
    """End the process `MAX_SHUTDOWN_S` after `stopping` is set, with the calls in which its threads hang on stderr.

    The interpreter itself would wait for threads that hang in a driver, in the disk or in a decoder.
    """
    stopping.wait()
    faulthandler.dump_traceback_later(MAX_SHUTDOWN_S, exit=True)


def uvicorn_config(app: FastAPI) -> uvicorn.Config:
    """Return the configuration of uvicorn for the application."""
    settings = app.state.service.settings
    return uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        http="h11",
        h11_max_incomplete_event_size=MAX_HEADER_BYTES,
        ws="none",
        timeout_graceful_shutdown=SHUTDOWN_GRACE_S,
    )
