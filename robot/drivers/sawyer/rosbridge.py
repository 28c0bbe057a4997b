"""Client of rosbridge: ROS topics and services as JSON over a websocket (port 9090), without a ROS install.

It uses `websockets` instead of roslibpy, because a motion command must not arrive late, and a failure must raise
an error. Observed with roslibpy 2.1: a message published during a connection loss raises nothing and is sent seconds
later, after automatic reconnection; rosbridge's "status" errors are dropped; after `terminate`, the same process
cannot connect again.

Operations (rosbridge protocol 2.1): advertise, publish, subscribe, call_service and service_response (its id echoed),
status. `decode` and `encode` use no socket; a thread of `RosbridgeLink` reads messages. Nothing is sent twice and
nothing is queued: a lost connection stays closed, and a new link must be opened.
"""

import contextlib
import itertools
import json
import logging
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from robot.devices import Clock
from robot.errors import DeviceError

Message = Mapping[str, Any]
T = TypeVar("T")

_LOG = logging.getLogger(__name__)
_MAX_MESSAGES = 200
"""Number of buffered messages of each topic: two seconds at 100 Hz."""
_MAX_CHARACTERS = 2**19
"""Limit of a topic's buffered JSON characters; parsed, they take up to 30 times as many bytes."""
_MAX_MESSAGE_BYTES = 2**20
"""A larger message closes the connection; a robot's state is about a thousandth of this."""
_MAX_QUEUE = 16
"""Number of unread messages at which reading from the network pauses."""
_MAX_ERROR_CHARACTERS = 300
"""Number of characters of an error message that are passed on."""
_PING_S = 5.0


@dataclass(frozen=True)
class ReceivedMessage:
    """A message of a topic, and its time of arrival on the link's clock."""

    message: Message
    time_s: float


class _MessageBuffer:
    """The newest messages of a topic, limited in number and total length; the last one is always stored."""

    def __init__(self) -> None:
        self._arrivals: deque[tuple[ReceivedMessage, int]] = deque()
        self._characters = 0

    def add(self, arrival: ReceivedMessage, characters: int) -> None:
        """Store a message of this length in JSON, and drop the oldest ones if necessary."""
        self._arrivals.append((arrival, characters))
        self._characters += characters
        while len(self._arrivals) > 1 and (len(self._arrivals) > _MAX_MESSAGES or self._characters > _MAX_CHARACTERS):
            self._characters -= self._arrivals.popleft()[1]

    def all(self) -> list[ReceivedMessage]:
        """Return the messages, oldest first."""
        return [arrival for arrival, _ in self._arrivals]

    def newest(self) -> ReceivedMessage | None:
        """Return the last message, or None."""
        return self._arrivals[-1][0] if self._arrivals else None


def encode(operation: Message) -> str:
    """Return an operation as JSON; raise DeviceError for values that JSON cannot express, such as NaN."""
    try:
        return json.dumps(operation, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise DeviceError(f"rosbridge accepts only plain finite values: {error}") from error


def decode(text: str | bytes) -> Message | None:
    """Return the operation in one websocket message, or None if it is invalid."""
    try:
        found = json.loads(text)
    except ValueError:
        return None
    return found if isinstance(found, dict) and isinstance(found.get("op"), str) else None


class RosbridgeLink:
    """A connection to `ws://host:port`; every wait ends after `timeout_s` at the latest.

    Attributes:
        counts: Numbers of "noise" (invalid operations), "late" (unexpected replies) and "status" (errors of rosbridge).
    """

    def __init__(self, url: str, *, timeout_s: float = 2.0, clock: Clock = time.monotonic) -> None:
        self.url, self.timeout_s, self.clock = url, timeout_s, clock
        self.counts: Counter[str] = Counter()
        self._changed = threading.Condition()
        self._numbers = itertools.count(1)
        self._topics: dict[str, _MessageBuffer] = {}
        self._awaited: dict[str, str] = {}
        self._replies: dict[str, Message] = {}
        self._contexts = contextlib.ExitStack()
        self._socket: Any = None
        self._reader: threading.Thread | None = None
        self._closed_reason = "it was never opened"

    @property
    def is_open(self) -> bool:
        """Whether the connection is open, as far as this side has noticed."""
        return not self._closed_reason

    def open(self) -> None:
        """Connect, once only, or raise DeviceError; a closed link cannot be opened again."""
        try:
            from websockets.sync.client import connect
        except ImportError as error:
            raise DeviceError(
                "rosbridge requires websockets, which is missing; run pip install 'touch-retrieval[sawyer]'"
            ) from error
        try:
            connection = connect(
                self.url,
                sock=_tcp(self.url, self.timeout_s),
                open_timeout=self.timeout_s,
                close_timeout=1.0,
                ping_interval=_PING_S,
                ping_timeout=_PING_S,
                compression=None,  # latency matters more than size
                max_size=_MAX_MESSAGE_BYTES,
                max_queue=_MAX_QUEUE,
                proxy=None,
            )
            self._socket = self._contexts.enter_context(connection)  # websockets 17 requires a context
        except Exception as error:  # websockets raises its own exceptions and OSError
            raise DeviceError(
                f"rosbridge must answer at {self.url}, got {str(error) or type(error).__name__}; start it on the "
                "robot's ROS machine with: roslaunch rosbridge_server rosbridge_websocket.launch"
            ) from error
        self._closed_reason = ""
        self._reader = threading.Thread(target=self._listen, name=f"rosbridge {self.url}", daemon=True)
        self._reader.start()

    def close(self) -> None:
        """Close the connection; a second call does nothing."""
        self._mark_closed("it was closed")
        with contextlib.suppress(Exception):  # errors of the closing handshake
            self._contexts.close()
        if self._reader is not None:
            self._reader.join(self.timeout_s)

    def check(self) -> None:
        """Raise DeviceError unless the connection is open."""
        if self._closed_reason:
            raise DeviceError(f"the connection to rosbridge at {self.url} is closed: {self._closed_reason}")

    def subscribe(self, topic: str, kind: str) -> None:
        """Subscribe to a topic of ROS type `kind`; if the link is slow, older messages are dropped."""
        self._topics[topic] = _MessageBuffer()
        self._send({"op": "subscribe", "topic": topic, "type": kind, "throttle_rate": 0, "queue_length": 1})

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """Advertise a topic of ROS type `kind`; with `latch`, ROS sends the last message to later subscribers."""
        self._send({"op": "advertise", "topic": topic, "type": kind, "latch": latch})

    def publish(self, topic: str, message: Message) -> None:
        """Send a message now; raise DeviceError if this fails."""
        self._send({"op": "publish", "topic": topic, "msg": message})

    def call(self, service: str, arguments: Message, timeout_s: float | None = None) -> Message:
        """Call a ROS service once and return its values; raise DeviceError if it fails or does not answer in time."""
        identity = f"{service}#{next(self._numbers)}"
        with self._changed:
            self._awaited[identity] = service
        try:
            self._send({"op": "call_service", "id": identity, "service": service, "args": arguments})
            reply = self._wait(lambda: self._replies.get(identity), timeout_s, f"answer of {service}")
        finally:
            with self._changed:
                del self._awaited[identity]
                self._replies.pop(identity, None)
        values = reply.get("values")
        if reply.get("result", True) is not True or not isinstance(values, dict):
            raise DeviceError(f"{service} failed: {_shorten(values)}")
        return values

    def history(self, topic: str) -> list[ReceivedMessage]:
        """Return the buffered messages of a subscribed topic, oldest first."""
        with self._changed:
            buffer = self._topics.get(topic)
            return buffer.all() if buffer else []

    def wait_for(
        self, topic: str, *, since_s: float = float("-inf"), timeout_s: float | None = None
    ) -> ReceivedMessage:
        """Wait for a message of a topic after `since_s` and return the newest; raise DeviceError if none arrives."""

        def fresh() -> ReceivedMessage | None:
            buffer = self._topics.get(topic)
            newest = buffer.newest() if buffer else None
            return newest if newest and newest.time_s > since_s else None

        return self._wait(fresh, timeout_s, f"message on {topic}")

    def _wait(self, found: Callable[[], T | None], timeout_s: float | None, what: str) -> T:
        limit = self.timeout_s if timeout_s is None else timeout_s
        with self._changed:
            self._changed.wait_for(lambda: self._closed_reason or found() is not None, limit)
            answer = found()
        if answer is None:
            self.check()
            raise DeviceError(f"rosbridge at {self.url}: no {what} within {limit:g} s; is the robot's node running?")
        return answer

    def _send(self, operation: Message) -> None:
        text = encode(operation)
        self.check()
        try:
            self._socket.send(text)
        except Exception as error:
            self._mark_closed(str(error) or type(error).__name__)
            raise DeviceError(f"the connection to rosbridge at {self.url} is closed: {self._closed_reason}") from error

    def _listen(self) -> None:
        reason = "the other side closed it"
        try:
            for text in self._socket:
                self._handle(text)
        except Exception as error:
            reason = str(error) or type(error).__name__
        self._mark_closed(reason)

    def _mark_closed(self, reason: str) -> None:
        with self._changed:
            self._closed_reason = self._closed_reason or reason
            self._changed.notify_all()

    def _handle(self, text: str | bytes) -> None:
        operation = decode(text) or {"op": "noise"}
        handlers = {
            "publish": self._handle_publish,
            "service_response": self._handle_response,
            "status": self._handle_status,
        }
        with self._changed:
            handler = handlers.get(operation["op"])
            if handler is None or not handler(operation, len(text)):
                self.counts["noise"] += 1
            self._changed.notify_all()

    def _handle_publish(self, operation: Message, characters: int) -> bool:
        topic, message = operation.get("topic"), operation.get("msg")
        buffer = self._topics.get(topic) if isinstance(topic, str) else None
        if buffer is None or not isinstance(message, dict):
            return False
        buffer.add(ReceivedMessage(message, self.clock()), characters)
        return True

    def _handle_response(self, operation: Message, _: int) -> bool:
        identity = operation.get("id")
        service = self._awaited.get(identity) if isinstance(identity, str) else None
        if service is None or operation.get("service", service) != service:
            self.counts["late"] += 1
        else:
            self._replies[str(identity)] = operation
        return True

    def _handle_status(self, operation: Message, _: int) -> bool:
        """Pass an error to the waiting call with its id; log all other messages."""
        identity, text = operation.get("id"), operation.get("msg")
        self.counts["status"] += 1
        if isinstance(identity, str) and identity in self._awaited and operation.get("level") == "error":
            self._replies[identity] = {"result": False, "values": text}
        else:
            _LOG.warning("rosbridge at %s reports: %s", self.url, _shorten(text))
        return True


def _shorten(text: object) -> str:
    """Return the truncated text with unprintable characters escaped."""
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in str(text)[:_MAX_ERROR_CHARACTERS])


def _tcp(url: str, timeout_s: float) -> socket.socket:
    """Return a connected socket that fails when the peer acknowledges nothing for `timeout_s`; raise OSError."""
    host, _, port = url.removeprefix("ws://").rpartition(":")
    found = socket.create_connection((host.strip("[]"), int(port)), timeout_s)
    found.settimeout(None)
    if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux; elsewhere the pings detect it later
        found.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, max(1, round(1000 * timeout_s)))
    return found
