"""The server around the application: it listens, and SIGTERM or Ctrl-C lets it finish what is in flight."""

import asyncio
import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from types import FrameType

import uvicorn
from fastapi import FastAPI

from retrieval.errors import BadInput
from retrieval.serve.connections import IDLE_S, MAX_CONNECTIONS, Connection, ConnectionTable
from retrieval.serve.service import Service

DRAIN_S = 0.5
"""For which, told to end, it still takes requests: those that were sent before, and lie unread in a socket."""
SHUTDOWN_GRACE_S = 4
"""For requests in flight, after the last call."""
MAX_SHUTDOWN_S = 7.5
"""From the signal to the end of the process, whatever hangs."""
_SWEEP_TICKS = 5
"""Ticks of a tenth of a second from one look at the connections' deadlines to the next."""


class Server(uvicorn.Server):
    """Ends when it is told to, and then its process has done what it was asked: no signal is raised again."""

    def __init__(self, config: uvicorn.Config, parts: Service, started: Callable[[int], object]) -> None:
        super().__init__(config)
        self._parts, self._on_started = parts, started

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, and say at which port."""
        await super().startup(sockets)
        if self.started:
            self._on_started(self.servers[0].sockets[0].getsockname()[1])

    async def on_tick(self, counter: int) -> bool:
        """Close connections whose deadline has passed, twice a second; whether to end (uvicorn)."""
        if counter % _SWEEP_TICKS == 0:
            now = asyncio.get_running_loop().time()
            for connection in list(self.server_state.connections):
                if isinstance(connection, Connection):
                    connection.close_if_late(now)
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Answer what was sent until now, and end."""
        await asyncio.sleep(DRAIN_S)
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
    """Serve until SIGTERM or Ctrl-C, which the process outlives by END_S at most, even where a thread hangs. `started`
    is told the port as soon as it listens. Raises BadInput where it cannot listen, and the errors of
    `Searcher.open`.
    """
    parts: Service = app.state.service
    threading.Thread(target=_enforce_shutdown, args=(parts.stopping,), daemon=True).start()
    parts.generations.open()
    host, port = parts.settings.host, parts.settings.port
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server(address[:2], family=family)
    except OSError as error:
        raise BadInput(f"{host}, port {port}, cannot be listened on: {error.strerror or error}") from error
    with listening:
        Server(uvicorn_config(app), parts, started).run([listening])


def _enforce_shutdown(stopping: threading.Event) -> None:
    """End the process END_S after `stopping` is set: the interpreter would wait for threads that hang in a driver, in
    the disk or in a decoder.
    """
    stopping.wait()
    signal.setitimer(
        signal.ITIMER_REAL, MAX_SHUTDOWN_S + 1
    )  # the system ends it, where the interpreter is too busy ending
    time.sleep(MAX_SHUTDOWN_S)
    hanging = ", ".join(
        thread.name for thread in threading.enumerate() if not thread.daemon and thread is not threading.main_thread()
    )
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.write(
            f"did not end within {MAX_SHUTDOWN_S:g} s of the signal, and is cut off; threads that hang: {hanging}\n"
        )
        sys.stderr.flush()
    os._exit(1)


def uvicorn_config(app: FastAPI) -> uvicorn.Config:
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
        http=partial(Connection, table=ConnectionTable()),  # type: ignore[arg-type]  # it is only called
        ws="none",
        backlog=MAX_CONNECTIONS,
        timeout_keep_alive=IDLE_S,
        timeout_graceful_shutdown=SHUTDOWN_GRACE_S,
    )
