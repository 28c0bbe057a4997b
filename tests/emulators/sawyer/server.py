"""A rosbridge server with an emulated arm: a real websocket, the robot's topics and IK service.

    python -m tests.emulators.sawyer.server --port 9090

It does not use the driver's code for messages, so tests check that code independently.
"""

import argparse
import contextlib
import json
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from tests.emulators.interrupts import until_interrupted
from tests.emulators.sawyer.arm import SawyerModel, forward, inverse

JOINT_NAMES = [f"right_j{number}" for number in range(7)]
LIMB = "/robot/limb/right/"
IK_SERVICE = "/ExternalTools/right/PositionKinematicsNode/IKService"
TIP = "right_hand"
RATE_HZ = 100.0


class RosbridgeClient:
    """One connection, with its subscribed and advertised topics."""

    def __init__(self, connection: Any) -> None:
        self.connection = connection
        self.subscribed: set[str] = set()
        self.advertised: set[str] = set()

    def send(self, text: str) -> None:
        """Send a message; do nothing after a disconnection."""
        with contextlib.suppress(Exception):
            self.connection.send(text)

    def drop(self) -> None:
        """Cut the connection without a closing handshake."""
        with contextlib.suppress(OSError):
            self.connection.socket.shutdown(socket.SHUT_RDWR)


class EmulatedSawyer:
    """The robot.

    Attributes:
        silent: Topics that are not sent.
        refuse_ik: Number of IK calls to refuse.
        commands: Received joint commands as (time_s, positions), newest last.
    """

    def __init__(self, *, model: SawyerModel | None = None) -> None:
        self.model = model or SawyerModel()
        self.silent: set[str] = set()
        self.refuse_ik = 0
        self.commands: deque[tuple[float, list[float]]] = deque(maxlen=5000)
        self.calls = 0
        self._lock = threading.RLock()
        self._clients: set[RosbridgeClient] = set()
        self._latched: dict[str, Mapping[str, Any]] = {}
        self._ended = threading.Event()
        self._now = time.monotonic()

    def press_estop(self) -> None:
        """Press the red button."""
        with self._lock:
            self.model.stopped, self.model.enabled = True, False
            self.model.estop_button, self.model.estop_source = 1, 1

    def release_estop(self) -> None:
        """Release the button and reset the robot."""
        with self._lock:
            self.model.stopped, self.model.enabled = False, True
            self.model.estop_button = self.model.estop_source = 0

    def drop_connections(self) -> None:
        """Cut all connections without a closing handshake."""
        for client in tuple(self._clients):  # without the lock: a sender may hold it while it waits for this cut
            client.drop()

    def handle(self, connection: Any) -> None:
        """Serve one connection until it ends."""
        client = RosbridgeClient(connection)
        with self._lock:
            self._clients.add(client)
        try:
            for text in connection:
                self._handle(client, text)
        except Exception:  # broken connections are expected
            pass
        finally:
            with self._lock:
                self._clients.discard(client)

    def run(self) -> None:
        """Move the arm and publish its state until `end` is called."""
        while not self._ended.wait(1.0 / RATE_HZ):
            with self._lock:
                self._advance()
                self._publish_all()

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
                    client.send(text)

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
        """Return joint states like the robot's, with the head's pan among the joints of the arm."""
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

    def _handle(self, client: RosbridgeClient, text: str | bytes) -> None:
        try:
            operation = json.loads(text)
            name = operation["op"]
            with self._lock:
                {
                    "subscribe": self._subscribe,
                    "unsubscribe": lambda client, operation: client.subscribed.discard(operation["topic"]),
                    "advertise": lambda client, operation: client.advertised.add(operation["topic"]),
                    "unadvertise": lambda client, operation: client.advertised.discard(operation["topic"]),
                    "publish": self._publish,
                    "call_service": self._call_service,
                }[name](client, operation)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            client.send(json.dumps({"op": "status", "level": "error", "msg": f"invalid message: {error!r}"}))

    def _subscribe(self, client: RosbridgeClient, operation: Mapping[str, Any]) -> None:
        topic = operation["topic"]
        client.subscribed.add(topic)
        if topic in self._latched:
            client.send(json.dumps({"op": "publish", "topic": topic, "msg": self._latched[topic]}))

    def _publish(self, client: RosbridgeClient, operation: Mapping[str, Any]) -> None:
        """Apply a published message and forward it to subscribers."""
        topic, message = operation["topic"], operation["msg"]
        if topic not in client.advertised:
            raise ValueError(f"{topic} was not advertised")
        if topic == LIMB + "joint_command":
            self._command(message)
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

    def _command(self, message: Mapping[str, Any]) -> None:
        if message["mode"] != 1:
            raise ValueError(f"only position mode, 1, is emulated, got {message['mode']}")
        positions = dict(zip(message["names"], message["position"], strict=True))
        target = [float(positions[name]) for name in JOINT_NAMES]
        self._advance()
        self.model.command(target)
        self.commands.append((self._now, target))

    def _call_service(self, client: RosbridgeClient, operation: Mapping[str, Any]) -> None:
        self.calls += 1
        exists = operation["service"] == IK_SERVICE
        values = self._solve(operation["args"]) if exists else f"Service {operation['service']} does not exist"
        reply = {"op": "service_response", "service": operation["service"], "values": values, "result": exists}
        client.send(json.dumps(reply | {"id": operation.get("id")}))

    def _solve(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return joint positions for each pose and seed; result_type -1: no solution, -3: the tip does not exist."""
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
        position, orientation = pose["position"], pose["orientation"]
        found = inverse([position[axis] for axis in "xyz"], [orientation[axis] for axis in "xyzw"], seed)
        return (None, -1) if found is None else (list(found), 1)

    def _seed(self, arguments: Mapping[str, Any], index: int) -> list[float]:
        if arguments["seed_mode"] != 1:  # SEED_USER
            return [float(angle) for angle in self.model.joints]
        seed = arguments["seed_angles"][index]
        positions = dict(zip(seed["name"], seed["position"], strict=True))
        return [float(positions[name]) for name in JOINT_NAMES]


def _header() -> dict[str, Any]:
    """Return a ROS header with the time of the robot's clock."""
    now = time.time_ns()
    return {"seq": 0, "stamp": {"secs": now // 10**9, "nsecs": now % 10**9}, "frame_id": "base"}


@contextlib.contextmanager
def serve(emulator: EmulatedSawyer, host: str = "127.0.0.1", port: int = 0) -> Iterator[str]:
    """Serve in threads and yield the address, "ws://127.0.0.1:54321"; port 0 chooses one. Needs `websockets`."""
    from websockets.sync.server import serve as listen

    server = listen(emulator.handle, host, port, compression=None, ping_interval=None, close_timeout=0.5)
    threads = [threading.Thread(target=work, daemon=True) for work in (server.serve_forever, emulator.run)]
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
    options = parser.parse_args()
    with until_interrupted(), serve(EmulatedSawyer(), options.host, options.port) as url:
        print(f"emulated arm behind rosbridge at {url}; press Ctrl-C to stop", flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    main()
