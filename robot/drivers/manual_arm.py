"""An arm that is a person: each pose is asked for in words, so that a gripper alone can collect data."""

import math
import time
from collections.abc import Callable

from robot.devices import Arm, Clock
from robot.errors import DeviceError, RobotConfigError
from robot.readings import Pose, Region

NEAR_MM, NEAR_RAD = 1.0, math.radians(1.0)
"""Poses this near to each other are one to a person's hand: it is not asked again."""


class ManualArm(Arm):
    """Asks a person to bring the hand to each pose, and believes them. `ask` shows a sentence and returns when done."""

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

    def _close(self) -> None:
        self._at = None

    def _stop(self) -> None:
        """A person who is interrupted stands somewhere: the next pose is asked for again."""
        self._at = None

    def _move_to(self, pose: Pose, speed_mm_s: float) -> Pose:
        """Raises RobotConfigError where nobody can answer."""
        if self._at is not None and is_near(self._at, pose):
            return self._at
        self._at = None
        try:
            self._ask(describe_pose(pose))
        except EOFError as error:
            raise RobotConfigError("a person must move the hand of this rig: run it in a terminal") from error
        self._at = pose
        return pose

    def _pose(self) -> Pose:
        if self._at is None:
            raise DeviceError(f"{self.name}: nobody has been asked to bring the hand anywhere yet; call move_to first")
        return self._at


def is_near(here: Pose, there: Pose) -> bool:
    """Whether a person need not move: within 1 mm, and within 1 degree of a whole turn's angle."""
    turn = math.remainder(there.yaw_rad - here.yaw_rad, math.tau)
    return math.dist(here.as_tuple()[:3], there.as_tuple()[:3]) <= NEAR_MM and abs(turn) <= NEAR_RAD


def describe_pose(pose: Pose) -> str:
    """What a person is asked to do; right and away are as the camera sees them, which looks on from the -y side."""
    sideways = f"{abs(pose.x_mm):.0f} mm to the {'right' if pose.x_mm >= 0 else 'left'} of the middle of the workspace"
    along = f"{abs(pose.y_mm):.0f} mm {'away from' if pose.y_mm >= 0 else 'towards'} the camera"
    turned = f"{math.degrees(math.remainder(pose.yaw_rad, math.tau)):.0f} deg"
    return (
        f"Put the point between the fingertips {pose.z_mm:.0f} mm above the table, {sideways}, {along}, with the line "
        f"from finger a to finger b turned by {turned} from the right, counter-clockwise seen from above; "
        "then press Enter."
    )
