"""Limits on client connections: their number, the time for one request, and the size of its headers.

uvicorn has no such limits: half-sent headers hold a connection for ever, and at its limit of concurrent connections it
answers 503 to every client. This module accepts every new connection. Above a limit, it closes one connection that
waits for its client. It chooses the oldest one that never completed a request. If there is none, it chooses the one
that has waited longest.
"""

import asyncio
from typing import Any

import h11
from uvicorn import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from retrieval.serve.errors import HttpProblem

MAX_CONNECTIONS = 512
MAX_CONNECTIONS_OF_ADDRESS = 128
HEADERS_S = 5.0
"""Time limit from the connection, or from the first byte of a later request, to the end of the headers."""
IDLE_S = 5
"""Time limit between the end of a response and the first byte of the next request."""
UNREAD_S = 30.0
"""Time limit for a client that does not read its response."""
CLOSING_S = 2.0
"""Time limit for a client that does not read the last bytes of a closing connection."""
MAX_HEADER_BYTES = 16_384
"""Maximum size of the request line and all headers of one request."""
MAX_HEADERS = 100
"""Maximum number of headers of one request; one header costs as much work as a hundred bytes."""
FREE_CHUNKS, MIN_CHUNK_BYTES = 1_000, 256
"""A body may have FREE_CHUNKS chunks of any size, and one more for each MIN_CHUNK_BYTES bytes of the body. A chunk
costs as much work as 1 kB."""
_HEADER_PIECE, _BODY_PIECE = 4_096, 65_536


class ConnectionTable:
    """The open connections of one server, counted together and by address."""

    def __init__(self, limit: int = MAX_CONNECTIONS, limit_of_address: int = MAX_CONNECTIONS_OF_ADDRESS) -> None:
        self._all, self._limit_of_address = _Group(limit), limit_of_address
        self._by_address: dict[str, _Group] = {}

    def admit(self, connection: "Connection") -> None:
        """Count a new connection; above a limit, close one that waits for its client, as the module states."""
        groups = (
            self._by_address.setdefault(connection.address, _Group(self._limit_of_address)),
            self._all,
        )
        for group in groups:
            group.waiting_new[connection] = None
            group.count += 1
        for group in groups:
            if group.count > group.limit:
                oldest = next(iter(group.waiting_new or group.waiting_idle))
                self.remove(oldest)
                oldest.transport.abort()

    def update(self, connection: "Connection") -> None:
        """Update whether a connection waits for its client."""
        for group in self._groups(connection):
            if not connection.waits_for_client:
                group.waiting_new.pop(connection, None)
                group.waiting_idle.pop(connection, None)
            elif connection not in group.waiting_new:
                group.waiting_idle.setdefault(connection)

    def remove(self, connection: "Connection") -> None:
        """Stop counting a connection; a second call does nothing."""
        for group in self._groups(connection):
            group.waiting_new.pop(connection, None)
            group.waiting_idle.pop(connection, None)
            group.count -= 1
        if (own := self._by_address.get(connection.address)) is not None and not own.count:
            del self._by_address[connection.address]
        connection.counted = False

    def _groups(self, connection: "Connection") -> tuple["_Group", ...]:
        return (self._by_address[connection.address], self._all) if connection.counted else ()


class _Group:
    """Connections that share a limit.

    Attributes:
        limit: Maximum number of connections.
        count: Current number of connections.
        waiting_new: Ordered set of connections that wait for their client and completed no request, the oldest first.
        waiting_idle: The same for connections that completed a request.
    """

    def __init__(self, limit: int) -> None:
        self.limit, self.count = limit, 0
        self.waiting_new: dict[Connection, None] = {}
        self.waiting_idle: dict[Connection, None] = {}


class Connection(H11Protocol):
    """A uvicorn connection with the limits of this module.

    h11 parses one request at a time, so pipelined requests stay unparsed bytes.
    """

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
        *,
        table: ConnectionTable,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self.conn = _Parser(h11.SERVER, MAX_HEADER_BYTES)
        self.table, self.counted, self.address = table, False, ""
        self._header_lines = 0
        self._headers_since: float | None = None
        self._unread_since: float | None = None
        self._closing_since: float | None = None

    @property
    def waits_for_client(self) -> bool:
        """Whether the connection has no complete, unanswered request."""
        return not self._has_request or bool(self.cycle.more_body)

    @property
    def _has_request(self) -> bool:
        """Whether the headers of an unanswered request have arrived."""
        return self.cycle is not None and not self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Register the connection (asyncio callback)."""
        super().connection_made(transport)
        self.address, self.counted = self.client[0] if self.client else "", True
        self._headers_since = self.loop.time()
        self.table.admit(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection (asyncio callback)."""
        self.table.remove(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse received bytes (asyncio callback), in pieces, to refuse oversized headers early."""
        start = 0
        while start < len(data) and not self.transport.is_closing():
            piece = data[start : start + (_BODY_PIECE if self._has_request else _HEADER_PIECE)]
            start += len(piece)
            if self.conn.their_state is h11.IDLE:
                self._header_lines += piece.partition(b"\r\n\r\n")[0].count(b"\n")
            if self._header_lines > MAX_HEADERS:
                self._refuse(HttpProblem("too-large-headers", f"A request may have at most {MAX_HEADERS} headers."))
                return
            super().data_received(piece)
            if self._has_request:
                self._header_lines = 0
        if not self._has_request and self._headers_since is None:
            self._headers_since = self.loop.time()
        self._note_state()

    def on_response_complete(self) -> None:
        """Update the state after a response (uvicorn callback)."""
        super().on_response_complete()
        self._header_lines = 0
        self._note_state()

    def _note_state(self) -> None:
        """Update the start time of the headers, and whether the connection waits for its client."""
        if self._has_request:
            self._headers_since = None
        elif self._headers_since is None and self.conn.trailing_data[0]:
            self._headers_since = self.loop.time()
        self.table.update(self)

    def pause_writing(self) -> None:
        """Start the time limit of a client that does not read (asyncio callback)."""
        self._unread_since = self.loop.time()
        super().pause_writing()

    def resume_writing(self) -> None:
        """Stop the time limit of a client that does not read (asyncio callback)."""
        self._unread_since = None
        super().resume_writing()

    def send_400_response(self, msg: str) -> None:
        """Refuse invalid HTTP or oversized headers (uvicorn callback)."""
        if self._has_request or len(self.conn.trailing_data[0]) <= MAX_HEADER_BYTES:
            self._refuse(HttpProblem("malformed", msg))
        else:
            self._refuse(
                HttpProblem("too-large-headers", f"A request may have at most {MAX_HEADER_BYTES:,} bytes of headers.")
            )

    def close_if_late(self, now: float) -> None:
        """Close the connection if it exceeds a time limit of this module; `now` is the event loop's time."""
        if self.transport.is_closing():
            self._closing_since = self._closing_since or now
            if now - self._closing_since > CLOSING_S:
                self.transport.abort()
        elif self._unread_since is not None and now - self._unread_since > UNREAD_S:
            self.transport.abort()
        elif self._headers_since is not None and now - self._headers_since > HEADERS_S:
            if self.conn.trailing_data[0]:
                self._refuse(HttpProblem("too-slow", f"The headers of a request must arrive within {HEADERS_S:g} s."))
            self.transport.close()

    def _refuse(self, problem: HttpProblem) -> None:
        """Send a problem document unless a response has begun, and close the connection."""
        if self._has_request:
            self.cycle.disconnected = True  # discard the application's answer
            self.cycle.message_event.set()
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            response = problem.response()
            headers = [*response.raw_headers, (b"connection", b"close")]
            for event in (
                h11.Response(status_code=problem.status, headers=headers),
                h11.Data(data=bytes(response.body)),
                h11.EndOfMessage(),
            ):
                self.transport.write(self.conn.send(event) or b"")
        self.transport.close()


class _Parser(h11.Connection):
    """An h11 parser that refuses bodies of many tiny chunks."""

    _chunks = _chunk_bytes = 0

    def next_event(self) -> Any:
        """Return the next event of h11, or raise RemoteProtocolError."""
        event = super().next_event()
        if isinstance(event, h11.Request):
            self._chunks = self._chunk_bytes = 0
        elif isinstance(event, h11.Data):
            self._chunks += event.chunk_start
            self._chunk_bytes += len(event.data)
            if self._chunks > FREE_CHUNKS + self._chunk_bytes / MIN_CHUNK_BYTES:
                raise h11.RemoteProtocolError("The chunks of the body are too small.")
        return event
