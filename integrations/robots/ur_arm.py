"""A Universal Robots arm through ur_rtde (pip install ur-rtde), for [arm]: `driver = "ur_arm:URArm"`.

The TCP of the robot (set on the teach pendant, or by `tcp`) must be the flange or any point on its axis; `tool_mm` is
its distance to the point between the fingertips. The robot must be in remote control.
"""

import math
import time

import rtde_control
import rtde_receive
from scipy.spatial.transform import Rotation

from robot import Arm
from robot.drivers.sawyer.codec import Mount

ACCELERATION_M_S2, STOP_M_S2, POLL_S, TIMEOUT_S = 0.5, 2.0, 0.02, 60.0


class URArm(Arm):
    """The arm; the keyword arguments are keys of [arm].

    Args:
        host: Address of the robot.
        origin_mm: Origin of the rig's frame in the robot's base frame.
        tool_mm: Distance from the robot's TCP to the point between the fingertips.
        origin_yaw_deg: Turn of the rig's frame about z in the base frame.
        tool_yaw_deg: Angle from the x axis of the TCP to the closing direction of finger a.
    """

    def __init__(
        self,
        *,
        host: str,
        origin_mm: tuple[float, float, float],
        tool_mm: float,
        origin_yaw_deg: float = 0.0,
        tool_yaw_deg: float = 0.0,
        workspace,
        max_speed_mm_s=1000.0,
        clock=time.monotonic,
    ):
        super().__init__("UR arm", workspace, max_speed_mm_s=max_speed_mm_s, clock=clock)
        self.host = host
        self.mount = Mount(origin_mm, math.radians(origin_yaw_deg), tool_mm, math.radians(tool_yaw_deg))
        self.control = None

    def _connect(self):
        self.receive = rtde_receive.RTDEReceiveInterface(self.host)
        self.control = rtde_control.RTDEControlInterface(self.host)

    def _close(self):
        """End the program on the robot."""
        if self.control is not None:
            self.control.stopScript()
            self.control.disconnect()
            self.receive.disconnect()

    def _move_to(self, pose, speed_mm_s):
        """Move on a straight line."""
        target = self._to_ur(pose)
        if not self.control.isPoseWithinSafetyLimits(target):
            raise RuntimeError(f"the robot cannot reach {target} within its safety limits")
        before, end_s = self.control.getAsyncOperationProgress(), time.monotonic() + TIMEOUT_S
        if not self.control.moveL(target, speed_mm_s / 1000, ACCELERATION_M_S2, True):  # asynchronous: Ctrl-C works
            raise RuntimeError("the robot refused the motion; is it in remote control?")
        while (progress := self.control.getAsyncOperationProgress()) >= 0 or progress == before:  # -1 and -2 in turn
            if time.monotonic() > end_s:
                raise TimeoutError(f"the arm still moves after {TIMEOUT_S:g} s")
            if self.receive.isProtectiveStopped() or self.receive.isEmergencyStopped():
                raise RuntimeError("the robot stopped itself; unlock it on the teach pendant")
            time.sleep(POLL_S)
        return self._pose()

    def _pose(self):
        x, y, z, *turn = self.receive.getActualTCPPose()
        quaternion = dict(zip("xyzw", Rotation.from_rotvec(turn).as_quat().tolist(), strict=True))
        return self.mount.pose_of({"position": {"x": x, "y": y, "z": z}, "orientation": quaternion})

    def _stop(self):
        self.control.stopL(STOP_M_S2)

    def _to_ur(self, pose):
        tip = self.mount.tip_of(pose)
        turn = Rotation.from_quat([tip["orientation"][axis] for axis in "xyzw"]).as_rotvec()
        return [*tip["position"].values(), *turn.tolist()]
