"""Limits on client connections that uvicorn lacks.

By itself, uvicorn waits for ever for the rest of a request's headers and for a client that does not read, and at
`limit_concurrency` it answers 503 to every client. h11 limits the size of the headers (`retrieval.serve.server`), and
`retrieval.serve.uploads` the time of a body.
"""

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_CONNECTIONS = 512
"""Above this number, each new connection closes the one that has waited longest for the headers of a request."""
HEADERS_S = 5
"""Time limit from the connection, or from the end of a response, to the end of the next request's headers."""
UNREAD_S = 30.0
"""Time limit for a client that does not read its response."""
MAX_HEADER_BYTES = 16_384
"""Approximate maximum size of the request line and all headers of one request."""


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
