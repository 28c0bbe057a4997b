"""An arm that a person moves to each requested pose, to collect data with a gripper only."""

import math
import time
from collections.abc import Callable

from robot.devices import Arm, Clock, VirtualDevice
from robot.errors import DeviceError, RobotConfigError
from robot.readings import Pose, Region

NEAR_MM, NEAR_RAD = 1.0, math.radians(1.0)
"""A person is not asked again for a pose this close to the current one."""


class ManualArm(VirtualDevice, Arm):
    """Asks a person to move the hand to each pose and assumes it reached.

    `ask` shows a request and returns when it is done.
    """

    is_manual = True

    def __init__(
        self,
        *,
        workspace: Region,
        max_speed_mm_s: float = 1000.0,
        ask: Callable[[str], object] = input,
        clock: Clock = time.monotonic,
    ) -> None:
        super().__init__("manual arm", workspace, max_speed_mm_s=max_speed_mm_s, clock=clock)
        self._ask = ask
        self._at: Pose | None = None

    def _connect(self) -> None:
        self._at = None

    def _stop(self) -> None:
        """Forget the pose: after an interruption, the next pose is requested again."""
        self._at = None

    def _move_to(self, pose: Pose, speed_mm_s: float) -> Pose:
        """Ask for the pose; raise RobotConfigError without a terminal."""
        if self._at is not None:
            turn = math.remainder(pose.yaw_rad - self._at.yaw_rad, math.tau)
            if math.dist(self._at.as_tuple()[:3], pose.as_tuple()[:3]) <= NEAR_MM and abs(turn) <= NEAR_RAD:
                return self._at
        self._at = None
        try:
            self._ask(_describe(pose))
        except EOFError as error:
            raise RobotConfigError("a person must move the hand of this rig: run it in a terminal") from error
        self._at = pose
        return pose

    def _pose(self) -> Pose:
        if self._at is None:
            raise DeviceError(f"{self.name}: the pose is unknown before the first motion; call move_to first")
        return self._at


def _describe(pose: Pose) -> str:
    """Return the request for a pose; right and behind are as the camera on the -y side sees them."""
    sideways = f"{abs(pose.x_mm):.0f} mm to the {'right' if pose.x_mm >= 0 else 'left'} of the origin"
    along = f"{abs(pose.y_mm):.0f} mm {'behind' if pose.y_mm >= 0 else 'in front of'} it as the camera sees it"
    turned = f"{math.degrees(math.remainder(pose.yaw_rad, math.tau)):.0f} deg"
    return (
        f"Put the point between the fingertips {pose.z_mm:.0f} mm above the table, {sideways}, {along}, with the "
        f"direction from finger a to finger b {turned} counter-clockwise from the right, seen from above; "
        "then press Enter."
    )
