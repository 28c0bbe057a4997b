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

from websockets.sync.server import serve as listen

from tests.emulators.sawyer.arm import SawyerModel, forward, inverse

JOINT_NAMES = [f"right_j{number}" for number in range(7)]
LIMB = "/robot/limb/right/"
IK_SERVICE = "/ExternalTools/right/PositionKinematicsNode/IKService"
TIP = "right_hand"
RATE_HZ = 100.0


class RosbridgeClient:
    """One connection, with its subscribed and advertised topics."""

    def __init__(self, connection):
        self.connection, self.subscribed, self.advertised = connection, set(), set()

    def send(self, **operation):
        """Send an operation; do nothing after a disconnection."""
        with contextlib.suppress(Exception):
            self.connection.send(json.dumps(operation))

    def drop(self):
        with contextlib.suppress(OSError):
            self.connection.socket.shutdown(socket.SHUT_RDWR)


class EmulatedSawyer:
    """The robot.

    Attributes:
        silent: Topics that are not sent.
        refuse_ik: Number of IK calls to refuse.
        commands: Received joint commands, newest last.
        calls: Number of IK calls.
    """

    def __init__(self, *, model=None):
        self.model = model or SawyerModel()
        self.silent, self.refuse_ik, self.calls = set(), 0, 0
        self.commands = deque(maxlen=5000)
        self._lock, self._ended, self._now = threading.RLock(), threading.Event(), time.monotonic()
        self._clients, self._latched = set(), {}

    def press_estop(self):
        with self._lock:
            self.model.stopped, self.model.enabled = True, False
            self.model.estop_button, self.model.estop_source = 1, 1

    def release_estop(self):
        """Release the button and reset the robot."""
        with self._lock:
            self.model.stopped, self.model.enabled = False, True
            self.model.estop_button = self.model.estop_source = 0

    def drop_connections(self):
        """Cut all connections without a closing handshake."""
        for client in tuple(self._clients):  # without the lock: a sender may hold it while it waits for this cut
            client.drop()

    def handle(self, connection):
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

    def run(self):
        """Move the arm and publish its state until `end` is called."""
        while not self._ended.wait(1.0 / RATE_HZ):
            with self._lock:
                self._advance()
                for topic, message in self._messages().items():
                    self._publish_to_all(topic, message)

    def end(self):
        self._ended.set()

    def _advance(self):
        now = time.monotonic()
        self.model.advance(now - self._now)
        self._now = now

    def _publish_to_all(self, topic, message):
        for client in self._clients:
            if topic in client.subscribed and topic not in self.silent:
                client.send(op="publish", topic=topic, msg=message)

    def _messages(self):
        model = self.model
        (x, y, z), (qx, qy, qz, qw) = forward(model.joints)
        pose = {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": qx, "y": qy, "z": qz, "w": qw}}
        return {
            "/robot/joint_states": {  # with the head's pan among the joints of the arm, like the robot's
                "name": ["head_pan", *JOINT_NAMES],
                "position": [0.0, *model.joints.tolist()],
                "velocity": [0.0, *model.velocity.tolist()],
                "effort": [0.0] * 8,
            },
            "/robot/state": {
                "enabled": model.enabled,
                "stopped": model.stopped,
                "error": model.error,
                "estop_button": model.estop_button,
                "estop_source": model.estop_source,
            },
            LIMB + "tip_states": {"names": [TIP], "states": [{"pose": pose}]},
            LIMB + "collision_detection_state": {"collision_state": model.has_collided},
        }

    def _handle(self, client, text):
        try:
            operation = json.loads(text)
            with self._lock:
                {
                    "subscribe": self._subscribe,
                    "advertise": lambda client, operation: client.advertised.add(operation["topic"]),
                    "publish": self._publish,
                    "call_service": self._call_service,
                }[operation["op"]](client, operation)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            client.send(op="status", level="error", msg=f"invalid message: {error!r}")

    def _subscribe(self, client, operation):
        topic = operation["topic"]
        client.subscribed.add(topic)
        if topic in self._latched:
            client.send(op="publish", topic=topic, msg=self._latched[topic])

    def _publish(self, client, operation):
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
        self._publish_to_all(topic, message)

    def _command(self, message):
        if message["mode"] != 1:
            raise ValueError(f"only position mode, 1, is emulated, got {message['mode']}")
        positions = dict(zip(message["names"], message["position"], strict=True))
        self._advance()
        self.commands.append([float(positions[name]) for name in JOINT_NAMES])
        self.model.command(self.commands[-1])

    def _call_service(self, client, operation):
        self.calls += 1
        exists = operation["service"] == IK_SERVICE
        values = self._solve(operation["args"]) if exists else f"Service {operation['service']} does not exist"
        reply = {"service": operation["service"], "values": values, "result": exists, "id": operation.get("id")}
        client.send(op="service_response", **reply)

    def _solve(self, arguments):
        """Return joint positions for the pose and seed; result_type -1: no solution, -3: the tip does not exist."""
        (stamped,), (tip,) = arguments["pose_stamp"], arguments["tip_names"]
        joints, kind = None, -3
        if stamped["header"]["frame_id"] == "base" and tip == TIP:
            seed = self.model.joints
            if arguments["seed_mode"] == 1:  # SEED_USER
                (given,) = arguments["seed_angles"]
                positions = dict(zip(given["name"], given["position"], strict=True))
                seed = [float(positions[name]) for name in JOINT_NAMES]
            place, turn = stamped["pose"]["position"], stamped["pose"]["orientation"]
            joints = inverse([place[axis] for axis in "xyz"], [turn[axis] for axis in "xyzw"], seed)
            if self.refuse_ik > 0:
                self.refuse_ik, joints = self.refuse_ik - 1, None
            kind = 1 if joints else -1
        found = {"name": JOINT_NAMES if joints else [], "position": list(joints or ()), "velocity": [], "effort": []}
        return {"joints": [found], "result_type": [kind]}


@contextlib.contextmanager
def serve(emulator, port=0):
    """Serve in threads and yield the address, "ws://127.0.0.1:54321"; port 0 chooses one."""
    server = listen(emulator.handle, "127.0.0.1", port, compression=None, ping_interval=None, close_timeout=0.5)
    threads = [threading.Thread(target=work, daemon=True) for work in (server.serve_forever, emulator.run)]
    for thread in threads:
        thread.start()
    try:
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
    finally:
        emulator.end()
        emulator.drop_connections()
        server.shutdown()
        for thread in threads:
            thread.join()


def main():
    """Serve until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, default=9090)
    with contextlib.suppress(KeyboardInterrupt), serve(EmulatedSawyer(), parser.parse_args().port) as url:
        print(url, flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    main()
