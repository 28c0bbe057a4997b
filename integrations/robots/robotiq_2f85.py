"""A Robotiq 2F-85 behind its URCap on a Universal Robots controller.

[gripper] has `driver = "robotiq_2f85:Robotiq2F85"`. The URCap answers on TCP port 63352: "SET POS 255 GTO 1" with
"ack", "GET POS" with "POS 255". POS is 0 when the jaws are open and 255 when they are closed; SPE and FOR are 0 to 255
for 20 to 150 mm/s and 20 to 235 N. OBJ is 0 during a motion, 1 or 2 at an object, 3 at the requested position. Activate
the gripper on the teach pendant before use: activation moves the jaws.
"""

import socket
import time

from robot import Gripper
from robot.readings import GripperState

STROKE_MM, SPEED_MM_S, FORCE_N = 85.0, (20.0, 150.0), (20.0, 235.0)
ACTIVE, MOVING, AT_OBJECT, AT_POSITION = 3, 0, 2, 3
TIMEOUT_S, POLL_S = 10.0, 0.02


class Robotiq2F85(Gripper):
    """The gripper. Its force counts for both fingers: we take half of it as the force on each finger.

    Args:
        host: Address of the robot's controller, a key of [gripper].
        port: Port of the URCap.
    """

    def __init__(
        self, *, host: str, port: int = 63352, max_force_n=1000.0, max_speed_mm_s=1000.0, clock=time.monotonic
    ):
        super().__init__(
            "Robotiq 2F-85",
            stroke_mm=STROKE_MM,
            min_force_n=FORCE_N[0] / 2,
            max_force_n=min(max_force_n, FORCE_N[1] / 2),
            max_speed_mm_s=min(max_speed_mm_s, SPEED_MM_S[1]),
            clock=clock,
        )
        self.address, self.link, self.force_n = (host, port), None, None

    def _connect(self):
        self.link = socket.create_connection(self.address, TIMEOUT_S)
        self.answers = self.link.makefile("rb")

    def _close(self):
        if self.link is not None:
            self.link.close()

    def _open(self, opening_mm):
        self.force_n = None
        self._move(round(255 * (1 - opening_mm / STROKE_MM)), self.max_speed_mm_s, FORCE_N[0])
        return self._state()

    def _grasp(self, force_n, speed_mm_s):
        self._move(255, speed_mm_s, 2 * force_n)
        self.force_n = force_n
        return self._state()

    def _state(self):
        opening_mm = STROKE_MM * (1 - self._get("POS") / 255)
        at = self._get("OBJ")
        if at == MOVING:
            status = "moving"
        elif self.force_n is None:
            status = "idle"
        elif at == AT_OBJECT:
            status = "holding"
        else:
            status = "no_part"
        return GripperState(opening_mm, self.force_n if status == "holding" else 0.0, status)

    def _stop(self):
        self._set(GTO=0)

    def _move(self, position, speed_mm_s, force_n):
        if self._get("STA") != ACTIVE:
            raise RuntimeError("the gripper is not active; activate it on the teach pendant (its jaws move)")
        speed, force = _to_byte(speed_mm_s, SPEED_MM_S), _to_byte(force_n, FORCE_N)
        self._set(POS=position, SPE=speed, FOR=force, GTO=1)
        end_s = time.monotonic() + TIMEOUT_S
        while self._get("PRE") != position or self._get("OBJ") == MOVING:  # PRE: the position that it works towards
            if time.monotonic() > end_s:
                raise TimeoutError(f"the jaws still move after {TIMEOUT_S:g} s")
            time.sleep(POLL_S)

    def _set(self, **values):
        words = " ".join(f"{name} {value}" for name, value in values.items())
        if (answer := self._ask(f"SET {words}")) != "ack":
            raise RuntimeError(f"the gripper must answer ack to SET {words}, got {answer!r}")

    def _get(self, name):
        answer = self._ask(f"GET {name}").split()
        if len(answer) != 2 or answer[0] != name or not answer[1].isdigit():
            raise RuntimeError(f"the gripper must answer GET {name} with its value, got {answer}")
        return int(answer[1])

    def _ask(self, command):
        self.link.sendall(command.encode() + b"\n")
        return self.answers.readline().decode("ascii", "replace").strip()


def _to_byte(value, limits):
    """Return a speed or a force as 0 to 255; raise ValueError outside the gripper's range."""
    low, high = limits
    if not low <= value <= high:
        raise ValueError(f"speed or force must be from {low:g} to {high:g}, got {value:g}; change the rig's file")
    return int(255 * (value - low) / (high - low))  # rounded down: never above the limit
