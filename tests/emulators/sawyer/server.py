"""A rosbridge server with a made-up arm behind it: a real websocket, the robot's topics and its IK service, and faults.

    python -m tests.emulators.sawyer.server --port 9090 [--faults 0.02 --seed 0]

It parses and builds messages on its own, so that the driver's reading of them is tested and not shared.
"""

import argparse
import contextlib
import json
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from tests.emulators.faults import FaultInjector
from tests.emulators.interrupts import until_interrupted
from tests.emulators.sawyer.arm import SawyerModel, forward, inverse

JOINT_NAMES = [f"right_j{number}" for number in range(7)]
LIMB = "/robot/limb/right/"
IK_SERVICE = "/ExternalTools/right/PositionKinematicsNode/IKService"
TIP = "right_hand"

MESSAGE_FAULTS = ("dropped", "duplicated", "corrupted")
REPLY_FAULTS = (*MESSAGE_FAULTS, "delayed", "wrong_id", "ik_failed", "disconnected")


class MessageFaults(FaultInjector):
    """What the server sends is dropped, duplicated, corrupted (cut short); a reply of a service is besides delayed,
    sent with a wrong_id, ik_failed, or the connection is disconnected instead; a command is command_dropped."""

    KINDS = (*REPLY_FAULTS, "command_dropped")


class RosbridgeClient:
    """One connection: what it subscribed to and advertised, and how to send to it."""

    def __init__(self, connection: Any) -> None:
        self.connection = connection
        self.subscribed: set[str] = set()
        self.advertised: set[str] = set()

    def send(self, text: str) -> None:
        """Send, or do nothing where the other side is gone."""
        with contextlib.suppress(Exception):
            self.connection.send(text)

    def drop(self) -> None:
        """Cut the connection without a goodbye."""
        with contextlib.suppress(OSError):
            self.connection.socket.shutdown(socket.SHUT_RDWR)


class EmulatedSawyer:
    """The robot's side. Switches: `silent` topics are not sent, `refuse_ik` that many IK calls, `reply_delay_s`.

    commands: the joint commands received, newest last, as (time_s, positions).
    """

    def __init__(
        self, *, model: SawyerModel | None = None, faults: MessageFaults | None = None, rate_hz: float = 100.0
    ) -> None:
        self.model = model or SawyerModel()
        self.faults = faults or MessageFaults()
        self.rate_hz = rate_hz
        self.silent: set[str] = set()
        self.refuse_ik = 0
        self.reply_delay_s = 0.0
        self.commands: deque[tuple[float, list[float]]] = deque(maxlen=5000)
        self.calls = 0
        self._lock = threading.RLock()
        self._clients: set[RosbridgeClient] = set()
        self._latched: dict[str, Mapping[str, Any]] = {}
        self._later: list[tuple[float, RosbridgeClient, str]] = []
        self._ended = threading.Event()
        self._now = time.monotonic()

    def press_estop(self) -> None:
        """A person presses the red button."""
        with self._lock:
            self.model.stopped, self.model.enabled = True, False
            self.model.estop_button, self.model.estop_source = 1, 1

    def release_estop(self) -> None:
        """A person turns the button and resets the robot."""
        with self._lock:
            self.model.stopped, self.model.enabled = False, True
            self.model.estop_button = self.model.estop_source = 0

    def drop_connections(self) -> None:
        """Every connection breaks without a goodbye."""
        for client in tuple(self._clients):  # without the lock: a sender may hold it and wait for this very break
            client.drop()

    def handle(self, connection: Any) -> None:
        """Serve one connection until it ends."""
        client = RosbridgeClient(connection)
        with self._lock:
            self._clients.add(client)
        try:
            for text in connection:
                self._take(client, text)
        except Exception:  # a connection that breaks is what this is for
            pass
        finally:
            with self._lock:
                self._clients.discard(client)

    def run(self) -> None:
        """Move the arm and publish its state until `end`."""
        while not self._ended.wait(1.0 / self.rate_hz):
            with self._lock:
                self._advance()
                self._publish_all()
                due = [each for each in self._later if each[0] <= self._now]
                self._later = [each for each in self._later if each[0] > self._now]
            for _, client, text in due:
                client.send(text)

    def end(self) -> None:
        """Stop `run`."""
        self._ended.set()

    def _advance(self) -> None:
        now = time.monotonic()
        self.model.advance(now - self._now)
        self._now = now

    def _publish_all(self) -> None:
        for topic, make in self._topics().items():
            clients = [client for client in self._clients if topic in client.subscribed]
            if clients and topic not in self.silent:
                text = json.dumps({"op": "publish", "topic": topic, "msg": make()})
                for client in clients:
                    self._send(client, text, MESSAGE_FAULTS)

    def _topics(self) -> Mapping[str, Callable[[], Mapping[str, Any]]]:
        return {
            "/robot/joint_states": self._joint_states,
            "/robot/state": self._robot_state,
            LIMB + "tip_states": self._tip_states,
            LIMB + "collision_detection_state": lambda: {
                "header": _header(),
                "collision_state": self.model.has_collided,
            },
        }

    def _joint_states(self) -> Mapping[str, Any]:
        """As the robot's: the head's pan stands among the arm's joints."""
        return {
            "header": _header(),
            "name": ["head_pan", *JOINT_NAMES],
            "position": [0.0, *self.model.joints.tolist()],
            "velocity": [0.0, *self.model.velocity.tolist()],
            "effort": [0.0] * 8,
        }

    def _robot_state(self) -> Mapping[str, Any]:
        model = self.model
        return {
            "ready": model.enabled and not model.stopped,
            "enabled": model.enabled,
            "stopped": model.stopped,
            "error": model.error,
            "lowVoltage": False,
            "estop_button": model.estop_button,
            "estop_source": model.estop_source,
        }

    def _tip_states(self) -> Mapping[str, Any]:
        (x, y, z), (qx, qy, qz, qw) = forward(self.model.joints)
        pose = {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": qx, "y": qy, "z": qz, "w": qw}}
        return {"header": _header(), "names": [TIP], "states": [{"header": _header(), "pose": pose}]}

    def _take(self, client: RosbridgeClient, text: str | bytes) -> None:
        try:
            operation = json.loads(text)
            name = operation["op"]
            with self._lock:
                {
                    "subscribe": self._subscribe,
                    "unsubscribe": lambda who, what: who.subscribed.discard(what["topic"]),
                    "advertise": lambda who, what: who.advertised.add(what["topic"]),
                    "unadvertise": lambda who, what: who.advertised.discard(what["topic"]),
                    "publish": self._published,
                    "call_service": self._called,
                }[name](client, operation)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            client.send(json.dumps({"op": "status", "level": "error", "msg": f"not understood: {error!r}"}))

    def _subscribe(self, client: RosbridgeClient, operation: Mapping[str, Any]) -> None:
        topic = operation["topic"]
        client.subscribed.add(topic)
        if topic in self._latched:
            client.send(json.dumps({"op": "publish", "topic": topic, "msg": self._latched[topic]}))

    def _published(self, client: RosbridgeClient, operation: Mapping[str, Any]) -> None:
        """Act on what is published and pass it on to who subscribed to it."""
        topic, message = operation["topic"], operation["msg"]
        if topic not in client.advertised:
            raise ValueError(f"{topic} was not advertised")
        if topic == LIMB + "joint_command":
            self._commanded(message)
            return
        if topic == LIMB + "set_speed_ratio":
            self.model.speed_ratio = min(1.0, max(0.0, float(message["data"])))
        elif topic == LIMB + "joint_command_timeout":
            self.model.command_timeout_s = float(message["data"])
        elif topic == "/robot/set_super_enable":
            self.model.enabled = bool(message["data"]) and not self.model.stopped
        self._latched[topic] = message
        for other in self._clients:
            if topic in other.subscribed and topic not in self.silent:
                other.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))

    def _commanded(self, message: Mapping[str, Any]) -> None:
        if message["mode"] != 1:
            raise ValueError(f"only position mode, 1, is emulated, got {message['mode']}")
        places = dict(zip(message["names"], message["position"], strict=True))
        target = [float(places[name]) for name in JOINT_NAMES]
        if self.faults.draw(["command_dropped"]) is None:
            self._advance()
            self.model.command(target)
            self.commands.append((self._now, target))

    def _called(self, client: RosbridgeClient, operation: Mapping[str, Any]) -> None:
        self.calls += 1
        good = operation["service"] == IK_SERVICE
        values = self._solve(operation["args"]) if good else f"Service {operation['service']} does not exist"
        reply = {"op": "service_response", "service": operation["service"], "values": values, "result": good}
        self._reply(client, reply | {"id": operation.get("id")})

    def _reply(self, client: RosbridgeClient, reply: dict[str, Any]) -> None:
        fault = self.faults.draw(REPLY_FAULTS)
        if fault == "disconnected":
            client.drop()
            return
        if fault == "wrong_id":
            reply["id"] = f"not-{reply['id']}"
        if fault == "ik_failed" and isinstance(reply["values"], dict):
            reply["values"] = {"joints": [{"name": [], "position": []}], "result_type": [-1]}
        delay_s = self.reply_delay_s + (0.3 if fault == "delayed" else 0.0)
        for text in _damaged(json.dumps(reply), fault):
            if delay_s:
                self._later.append((time.monotonic() + delay_s, client, text))
            else:
                client.send(text)

    def _solve(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Positions for each asked pose, seeded as asked; result_type -1: none, -3: the tip does not exist."""
        answer: dict[str, Any] = {"joints": [], "result_type": []}
        for index, stamped in enumerate(arguments["pose_stamp"]):
            joints, kind = None, -3
            if stamped["header"]["frame_id"] == "base" and arguments["tip_names"][index] == TIP:
                joints, kind = self._inverse(stamped["pose"], self._seed(arguments, index))
            answer["joints"].append(
                {"name": JOINT_NAMES if joints else [], "position": joints or [], "velocity": [], "effort": []}
            )
            answer["result_type"].append(kind)
        return answer

    def _inverse(self, pose: Mapping[str, Any], seed: list[float]) -> tuple[list[float] | None, int]:
        if self.refuse_ik > 0:
            self.refuse_ik -= 1
            return None, -1
        place, turn = pose["position"], pose["orientation"]
        found = inverse([place[a] for a in "xyz"], [turn[a] for a in "xyzw"], seed)
        return (None, -1) if found is None else (list(found), 1)

    def _seed(self, arguments: Mapping[str, Any], index: int) -> list[float]:
        if arguments["seed_mode"] != 1:  # SEED_USER
            return [float(angle) for angle in self.model.joints]
        seed = arguments["seed_angles"][index]
        places = dict(zip(seed["name"], seed["position"], strict=True))
        return [float(places[name]) for name in JOINT_NAMES]

    def _send(self, client: RosbridgeClient, text: str, possible: Sequence[str]) -> None:
        for part in _damaged(text, self.faults.draw(possible)):
            client.send(part)


def _damaged(text: str, fault: str | None) -> list[str]:
    """What is sent in place of a message."""
    return {"dropped": [], "duplicated": [text, text], "corrupted": [text[: len(text) // 2]]}.get(fault or "", [text])


def _header() -> dict[str, Any]:
    """A ROS time stamp by the robot's own clock."""
    now = time.time_ns()
    return {"seq": 0, "stamp": {"secs": now // 10**9, "nsecs": now % 10**9}, "frame_id": "base"}


@contextlib.contextmanager
def serve(emulator: EmulatedSawyer, host: str = "127.0.0.1", port: int = 0) -> Iterator[str]:
    """Serve in threads, port 0 a free one; gives the address, "ws://127.0.0.1:54321". Needs `websockets`."""
    from websockets.sync.server import serve as listen

    server = listen(emulator.handle, host, port, compression=None, ping_interval=None, close_timeout=0.5)
    threads = [threading.Thread(target=each, daemon=True) for each in (server.serve_forever, emulator.run)]
    for thread in threads:
        thread.start()
    try:
        yield f"ws://{host}:{server.socket.getsockname()[1]}"
    finally:
        emulator.end()
        emulator.drop_connections()
        server.shutdown()
        for thread in threads:
            thread.join()


def main() -> None:
    """Serve until Ctrl-C or SIGTERM."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=9090)
    parser.add_argument("--faults", type=float, default=0.0, help="share of operations that go wrong")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    emulator = EmulatedSawyer(faults=MessageFaults(asked.faults, seed=asked.seed))
    with until_interrupted(), serve(emulator, asked.host, asked.port) as url:
        print(f"a made-up arm behind rosbridge at {url}; Ctrl-C ends it", flush=True)
        threading.Event().wait()
    for kind, count in sorted(emulator.faults.counts.items()):
        if count:
            print(f"{kind}: {count}")


if __name__ == "__main__":
    main()
