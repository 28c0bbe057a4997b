"""The server around the application: it listens, and SIGTERM or Ctrl-C lets it finish what is in flight."""

import asyncio
import contextlib
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from types import FrameType

import uvicorn
from fastapi import FastAPI

from retrieval.errors import BadInput
from retrieval.serve.service import Service

KEEP_ALIVE_S = 5
MOST_CONNECTIONS = 512
LAST_CALL_S = 0.5
"""For which, told to end, it still takes requests: those that were sent before, and lie unread in a socket."""


class Server(uvicorn.Server):
    """Ends when it is told to, and then its process has done what it was asked: no signal is raised again."""

    def __init__(self, config: uvicorn.Config, parts: Service, started: Callable[[int], object]) -> None:
        super().__init__(config)
        self._parts, self._say_started = parts, started

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, and say at which port."""
        await super().startup(sockets)
        if self.started:
            self._say_started(self.servers[0].sockets[0].getsockname()[1])

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Answer what was sent until now, and end."""
        await asyncio.sleep(LAST_CALL_S)
        await super().shutdown(sockets)

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Both signals end it while it serves; what they were before is put back."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self.handle_exit) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Streams, which never end by themselves, end now."""
        self._parts.stopping.set()
        super().handle_exit(sig, frame)


def serve(app: FastAPI, started: Callable[[int], object]) -> None:
    """Serve until SIGTERM or Ctrl-C; `started` is told the port as soon as it listens. Raises BadInput where it cannot
    listen, and the errors of `Searcher.open`."""
    parts: Service = app.state.service
    parts.generations.open()
    host, port = parts.settings.host, parts.settings.port
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server(address[:2], family=family)
    except OSError as error:
        raise BadInput(f"{host}, port {port}, cannot be listened on: {error.strerror or error}") from error
    with listening:
        Server(configured(app), parts, started).run([listening])


def configured(app: FastAPI) -> uvicorn.Config:
    """How the application is served."""
    settings = app.state.service.settings
    return uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        ws="none",
        limit_concurrency=MOST_CONNECTIONS,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=round(settings.deadline_s) + 5,
    )
