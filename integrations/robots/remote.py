"""A robot that a program on another computer moves, called over HTTP, such as one in another language.

[arm] has `driver = "remote:RemoteArm"`, [gripper] `driver = "remote:RemoteGripper"`, each with `url`, such as
"http://192.168.1.20:8000/arm". Each call is a POST request to `url`/method with its values as a JSON object: move_to
(x_mm, y_mm, z_mm, yaw_rad, speed_mm_s), pose and stop of the arm, open (opening_mm, speed_mm_s), grasp (force_n,
speed_mm_s), state and stop of the gripper. The program answers with status 200 when the motion has ended, or with an
error status and a text, which becomes the error message. pose answers {"x_mm": ..., "y_mm": ..., "z_mm": ...,
"yaw_rad": ...}, state {"opening_mm": ..., "force_n": ..., "status": "idle"}. There is no encryption and no password:
use a network of your own.
"""

import json
import time
import urllib.error
import urllib.request

from robot import Arm, Gripper, Pose
from robot.readings import GripperState

MOTION_S, ANSWER_S = 60.0, 5.0
"""Longest wait for the end of a motion, and for an answer without one."""


def call(url, method, **values):
    """Call a method of the program at `url` and return its answer."""
    head = {"Content-Type": "application/json"}
    request = urllib.request.Request(f"{url}/{method}", json.dumps(values).encode(), head, method="POST")
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # without the environment's proxies
    try:
        with opener.open(request, timeout=MOTION_S if values else ANSWER_S) as answer:
            content = answer.read()
    except urllib.error.HTTPError as error:
        raise RuntimeError(f"{url}/{method} answered {error.code}: {error.read(500).decode()}") from error
    return json.loads(content) if content else None


class RemoteArm(Arm):
    """An arm at `url`."""

    def __init__(self, *, url: str, workspace, max_speed_mm_s=1000.0, clock=time.monotonic):
        super().__init__(f"arm at {url}", workspace, max_speed_mm_s=max_speed_mm_s, clock=clock)
        self.url = url

    def _connect(self):
        self._pose()

    def _close(self): ...

    def _move_to(self, pose, speed_mm_s):
        goal = {"x_mm": pose.x_mm, "y_mm": pose.y_mm, "z_mm": pose.z_mm, "yaw_rad": pose.yaw_rad}
        call(self.url, "move_to", **goal, speed_mm_s=speed_mm_s)
        return self._pose()

    def _pose(self):
        return Pose(**call(self.url, "pose"))

    def _stop(self):
        call(self.url, "stop")


class RemoteGripper(Gripper):
    """A gripper at `url`; `stroke_mm` and `min_force_n` (on each finger) are its own limits."""

    def __init__(
        self,
        *,
        url: str,
        stroke_mm: float,
        min_force_n: float,
        max_force_n=1000.0,
        max_speed_mm_s=420.0,
        clock=time.monotonic,
    ):
        super().__init__(
            f"gripper at {url}",
            stroke_mm=stroke_mm,
            min_force_n=min_force_n,
            max_force_n=max_force_n,
            max_speed_mm_s=max_speed_mm_s,
            clock=clock,
        )
        self.url = url

    def _connect(self):
        self._state()

    def _close(self): ...

    def _open(self, opening_mm):
        call(self.url, "open", opening_mm=opening_mm, speed_mm_s=self.max_speed_mm_s)
        return self._state()

    def _grasp(self, force_n, speed_mm_s):
        call(self.url, "grasp", force_n=force_n, speed_mm_s=speed_mm_s)
        return self._state()

    def _state(self):
        return GripperState(**call(self.url, "state"))

    def _stop(self):
        call(self.url, "stop")
