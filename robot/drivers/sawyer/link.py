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
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from robot.devices import Clock
from robot.drivers.packages import import_package
from robot.errors import DeviceError

Message = Mapping[str, Any]
T = TypeVar("T")

_LOG = logging.getLogger(__name__)
_MAX_MESSAGES = 200
"""Number of buffered messages of each topic: two seconds at 100 Hz."""
_MAX_ERROR_CHARACTERS = 300
"""Number of characters of an error message that are passed on."""
_PING_S = 5.0


@dataclass(frozen=True)
class ReceivedMessage:
    """A message of a topic, and its time of arrival on the link's clock."""

    message: Message
    time_s: float


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
    """A connection to `ws://host:port`; every wait ends after `timeout_s` at the latest."""

    def __init__(self, url: str, *, timeout_s: float = 2.0, clock: Clock = time.monotonic) -> None:
        self.url, self.timeout_s, self.clock = url, timeout_s, clock
        self._changed = threading.Condition()
        self._numbers = itertools.count(1)
        self._topics: dict[str, deque[ReceivedMessage]] = {}
        self._awaited: dict[str, str] = {}
        self._replies: dict[str, Message] = {}
        self._contexts = contextlib.ExitStack()
        self._socket: Any = None
        self._reader: threading.Thread | None = None
        self._closed_reason = "it was never opened"

    def open(self) -> None:
        """Connect, once only, or raise DeviceError; a closed link cannot be opened again."""
        connect = import_package("websockets.sync.client", "rosbridge", "sawyer").connect
        try:
            connection = connect(
                self.url,
                sock=_tcp(self.url, self.timeout_s),
                open_timeout=self.timeout_s,
                close_timeout=1.0,
                ping_interval=_PING_S,
                ping_timeout=_PING_S,
                compression=None,  # latency matters more than size
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
        self._topics[topic] = deque(maxlen=_MAX_MESSAGES)
        self._send({"op": "subscribe", "topic": topic, "type": kind, "throttle_rate": 0, "queue_length": 1})

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """Advertise a topic of ROS type `kind`; with `latch`, ROS sends the last message to later subscribers."""
        self._send({"op": "advertise", "topic": topic, "type": kind, "latch": latch})

    def publish(self, topic: str, message: Message) -> None:
        """Send a message now; raise DeviceError if this fails."""
        self._send({"op": "publish", "topic": topic, "msg": message})

    def call(self, service: str, arguments: Message) -> Message:
        """Call a ROS service once and return its values; raise DeviceError if it fails or does not answer in time."""
        identity = f"{service}#{next(self._numbers)}"
        with self._changed:
            self._awaited[identity] = service
        try:
            self._send({"op": "call_service", "id": identity, "service": service, "args": arguments})
            reply = self._wait(lambda: self._replies.get(identity), f"answer of {service}")
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
            return list(self._topics.get(topic, ()))

    def wait_for(self, topic: str, *, since_s: float = float("-inf")) -> ReceivedMessage:
        """Wait for a message of a topic after `since_s` and return the newest; raise DeviceError if none arrives."""

        def fresh() -> ReceivedMessage | None:
            arrivals = self._topics.get(topic)
            return arrivals[-1] if arrivals and arrivals[-1].time_s > since_s else None

        return self._wait(fresh, f"message on {topic}")

    def _wait(self, found: Callable[[], T | None], what: str) -> T:
        with self._changed:
            self._changed.wait_for(lambda: self._closed_reason or found() is not None, self.timeout_s)
            answer = found()
        if answer is None:
            self.check()
            raise DeviceError(
                f"rosbridge at {self.url}: no {what} within {self.timeout_s:g} s; is the robot's node running?"
            )
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
        """Store a message of a topic or the answer of a call; log errors of rosbridge; ignore all else."""
        operation = decode(text) or {}
        kind, identity, message = operation.get("op"), operation.get("id"), operation.get("msg")
        with self._changed:
            service = self._awaited.get(identity) if isinstance(identity, str) else None
            if kind == "publish" and isinstance(message, dict) and operation.get("topic") in self._topics:
                self._topics[operation["topic"]].append(ReceivedMessage(message, self.clock()))
            elif kind == "service_response" and service and operation.get("service", service) == service:
                self._replies[str(identity)] = operation
            elif kind == "status" and service and operation.get("level") == "error":
                self._replies[str(identity)] = {"result": False, "values": message}
            elif kind == "status":
                _LOG.warning("rosbridge at %s reports: %s", self.url, _shorten(message))
            self._changed.notify_all()


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
