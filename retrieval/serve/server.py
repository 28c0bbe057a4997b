"""The HTTP server; on SIGTERM or Ctrl-C it finishes the requests in flight and ends.

By itself, uvicorn waits for ever for the rest of a request's headers and for a client that does not read, and at
`limit_concurrency` it answers 503 to every client. h11 limits the size of the headers, `retrieval.serve.uploads` the
time of a body.
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
from uvicorn.protocols.http.h11_impl import H11Protocol

from retrieval.errors import BadInput
from retrieval.serve.service import Service

MAX_CONNECTIONS = 512
"""Above this number, each new connection closes the one that has waited longest for the headers of a request."""
HEADERS_S = 5
"""Time limit from the connection, or from the end of a response, to the end of the next request's headers."""
UNREAD_S = 30.0
"""Time limit for a client that does not read its response."""
MAX_HEADER_BYTES = 16_384
"""Approximate maximum size of the request line and all headers of one request."""
DRAIN_S = 0.5
"""Time after the signal in which requests are still accepted: those sent before may be unread in a socket."""
SHUTDOWN_GRACE_S = 4
"""Time limit for requests in flight, after `DRAIN_S`."""
MAX_SHUTDOWN_S = 7.5
"""Maximum time from the signal to the end of the process, even if a thread hangs."""


class Connection(H11Protocol):
    """A uvicorn connection whose keep-alive timer also runs until the headers of a request are complete."""

    _unread: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timer; above `MAX_CONNECTIONS`, close another connection (asyncio callback)."""
        super().connection_made(transport)
        if len(self.connections) > MAX_CONNECTIONS:
            timers = {one: one.timeout_keep_alive_task for one in self.connections if isinstance(one, Connection)}
            waiting = {one: timer.when() for one, timer in timers.items() if timer is not None}
            if waiting:
                oldest = min(waiting, key=waiting.__getitem__)
                oldest._unset_keepalive_if_required()
                oldest.transport.abort()
        self.timeout_keep_alive_task = self.loop.call_later(self.timeout_keep_alive, self.timeout_keep_alive_handler)

    def data_received(self, data: bytes) -> None:
        """Parse received bytes (asyncio callback); in pieces, because h11 accepts any headers that arrive at once."""
        timer = self.timeout_keep_alive_task
        self.timeout_keep_alive_task = None  # uvicorn would stop the timer
        for start in range(0, len(data), MAX_HEADER_BYTES):
            if not self.transport.is_closing():
                super().data_received(data[start : start + MAX_HEADER_BYTES])
        is_incomplete = self.cycle is None or self.cycle.response_complete
        if timer is not None and is_incomplete and self.timeout_keep_alive_task is None:
            self.timeout_keep_alive_task = timer
        elif timer is not None:
            timer.cancel()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timers (asyncio callback)."""
        self._unset_keepalive_if_required()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Start the time limit of a client that does not read (asyncio callback)."""
        self._unread = self.loop.call_later(UNREAD_S, self.transport.abort)
        super().pause_writing()

    def resume_writing(self) -> None:
        """Stop the time limit of a client that does not read (asyncio callback)."""
        if self._unread is not None:
            self._unread.cancel()
        super().resume_writing()


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
        http=Connection,
        h11_max_incomplete_event_size=MAX_HEADER_BYTES,
        ws="none",
        backlog=MAX_CONNECTIONS,
        timeout_keep_alive=HEADERS_S,
        timeout_graceful_shutdown=SHUTDOWN_GRACE_S,
    )
