"""A client of rosbridge: ROS topics and services as JSON over a websocket (port 9090), without a ROS install.

It stands on `websockets` and not on roslibpy, because a motion command must reach the robot now or never, and a
failure must be an exception. Seen with roslibpy 2.1: what is published while the link is gone raises nothing and is
sent seconds later, when it has reconnected by itself; rosbridge's own "status" errors are dropped; after `terminate` no
second connection can be made in the same process.

Operations (rosbridge protocol 2.1): advertise, publish, subscribe, call_service and service_response (its id echoed),
status. `decode` and `encode` know no socket; a thread of `RosbridgeLink` reads what comes. Nothing is sent twice and
nothing is queued: a link that is gone stays gone until it is opened again.
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
"""Messages kept of each topic: two seconds of one at 100 Hz."""
_MAX_CHARACTERS = 2**19
"""And no more than these, of JSON, all together: the oldest go. Read, they take up to 30 times as many bytes."""
_MAX_MESSAGE_BYTES = 2**20
"""Who sends a larger message loses the connection; a robot's state is a thousandth of that."""
_MAX_QUEUE = 16
"""Messages that may wait to be read; then nothing is taken from the network, and the other side has to wait."""
_MAX_ERROR_CHARACTERS = 300
"""Characters of a complaint that are passed on."""
_PING_S = 5.0


@dataclass(frozen=True)
class ReceivedMessage:
    """A message of a topic, and when it came by the link's clock."""

    message: Message
    time_s: float


class _MessageBuffer:
    """The newest messages of a topic, few enough and short enough together; the last one whatever its length."""

    def __init__(self) -> None:
        self._arrivals: deque[tuple[ReceivedMessage, int]] = deque()
        self._characters = 0

    def add(self, arrival: ReceivedMessage, characters: int) -> None:
        """Keep a message that was so long as JSON, and drop the oldest for it."""
        self._arrivals.append((arrival, characters))
        self._characters += characters
        while len(self._arrivals) > 1 and (len(self._arrivals) > _MAX_MESSAGES or self._characters > _MAX_CHARACTERS):
            self._characters -= self._arrivals.popleft()[1]

    def all(self) -> list[ReceivedMessage]:
        """Oldest first."""
        return [arrival for arrival, _ in self._arrivals]

    def newest(self) -> ReceivedMessage | None:
        """The last that came."""
        return self._arrivals[-1][0] if self._arrivals else None


def encode(operation: Message) -> str:
    """One operation as JSON. Raises DeviceError for what JSON cannot hold, NaN among it."""
    try:
        return json.dumps(operation, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise DeviceError(f"rosbridge takes plain finite values only: {error}") from error


def decode(text: str | bytes) -> Message | None:
    """The operation in one websocket message; None for what is none."""
    try:
        found = json.loads(text)
    except ValueError:
        return None
    return found if isinstance(found, dict) and isinstance(found.get("op"), str) else None


class RosbridgeLink:
    """A connection to `ws://host:port`; every wait ends after `timeout_s` at the latest.

    counts: of "noise" (not an operation), "late" (a reply nobody waits for), "status" (complaints of rosbridge).
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
        """Whether messages can be sent, as far as is known."""
        return not self._closed_reason

    def open(self) -> None:
        """Connect, once: a closed link is replaced by a new one. Raises DeviceError."""
        try:
            from websockets.sync.client import connect
        except ImportError as error:
            raise DeviceError(
                "a robot behind rosbridge needs websockets, which is missing; run pip install 'touch-retrieval[sawyer]'"
            ) from error
        try:
            connection = connect(
                self.url,
                sock=_tcp(self.url, self.timeout_s),
                open_timeout=self.timeout_s,
                close_timeout=1.0,
                ping_interval=_PING_S,
                ping_timeout=_PING_S,
                compression=None,  # on a cable, time matters and size does not
                max_size=_MAX_MESSAGE_BYTES,
                max_queue=_MAX_QUEUE,
                proxy=None,
            )
            self._socket = self._contexts.enter_context(connection)  # websockets 17 wants a context, 15 allows one
        except Exception as error:  # websockets has a tree of its own beside OSError
            raise DeviceError(
                f"rosbridge must answer at {self.url}, got {str(error) or type(error).__name__}; start it on the "
                "robot's ROS machine with: roslaunch rosbridge_server rosbridge_websocket.launch"
            ) from error
        self._closed_reason = ""
        self._reader = threading.Thread(target=self._listen, name=f"rosbridge {self.url}", daemon=True)
        self._reader.start()

    def close(self) -> None:
        """Close; does nothing where it is closed."""
        self._mark_closed("it was closed")
        with contextlib.suppress(Exception):  # closed it is, whatever the goodbye met
            self._contexts.close()
        if self._reader is not None:
            self._reader.join(self.timeout_s)

    def check(self) -> None:
        """Raise DeviceError unless the connection stands."""
        if self._closed_reason:
            raise DeviceError(f"the connection to rosbridge at {self.url} is gone: {self._closed_reason}")

    def subscribe(self, topic: str, kind: str) -> None:
        """Ask for the messages of a topic of this ROS type, the newest first when the link is slow."""
        self._topics[topic] = _MessageBuffer()
        self._send({"op": "subscribe", "topic": topic, "type": kind, "throttle_rate": 0, "queue_length": 1})

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """Say that messages of this ROS type will be published. latch: ROS shows the last one to who comes later."""
        self._send({"op": "advertise", "topic": topic, "type": kind, "latch": latch})

    def publish(self, topic: str, message: Message) -> None:
        """Send a message now. Raises DeviceError."""
        self._send({"op": "publish", "topic": topic, "msg": message})

    def call(self, service: str, arguments: Message, timeout_s: float | None = None) -> Message:
        """Call a ROS service once and return its values. Raises DeviceError, also when no answer comes in time."""
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
        """The messages kept of a subscribed topic, oldest first."""
        with self._changed:
            buffer = self._topics.get(topic)
            return buffer.all() if buffer else []

    def wait_for(
        self, topic: str, *, since_s: float = float("-inf"), timeout_s: float | None = None
    ) -> ReceivedMessage:
        """The newest message of a topic once there is one that came after `since_s`. Raises DeviceError."""

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
            raise DeviceError(f"the connection to rosbridge at {self.url} is gone: {self._closed_reason}") from error

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
        """An error that names a call fails it; others can only be logged."""
        identity, words = operation.get("id"), operation.get("msg")
        self.counts["status"] += 1
        if isinstance(identity, str) and identity in self._awaited and operation.get("level") == "error":
            self._replies[identity] = {"result": False, "values": words}
        else:
            _LOG.warning("rosbridge at %s says: %s", self.url, _shorten(words))
        return True


def _shorten(words: object) -> str:
    """What the other side says, cut off, and harmless on a terminal."""
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in str(words)[:_MAX_ERROR_CHARACTERS])


def _tcp(url: str, timeout_s: float) -> socket.socket:
    """A connected socket that gives up on a peer that acknowledges nothing for `timeout_s`. Raises OSError."""
    host, _, port = url.removeprefix("ws://").rpartition(":")
    found = socket.create_connection((host.strip("[]"), int(port)), timeout_s)
    found.settimeout(None)
    if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux; elsewhere the pings notice it later
        found.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, max(1, round(1000 * timeout_s)))
    return found
