"""Driver of the WSG-50 parallel gripper (Weiss Robotics, SCHUNK).

Modules of the package: packets (codec), commands and replies (commands), the link, serial or TCP (link), supervised
motions (motion), settings and forces (setup). Tested with an emulator, not yet with a gripper.

Before use, set on the gripper's web page:

* The binary command interface: on.
* "Part width tolerance" and "clamping travel": their maximum. The width of the object is unknown, so GRASP is sent with
  `grasp_width_mm`, by default 0. (The driver of the Robotics Library gives the same advice.)
* "Error state on TCP disconnect": on. Then the jaws stop if this program is killed. Over a serial line they do not.
"""

import logging
import time
from typing import Any

from robot.devices import Clock, Gripper
from robot.drivers.wsg50 import commands
from robot.drivers.wsg50.codec import Packet
from robot.drivers.wsg50.commands import CommandId, GraspingState, Status, SystemState
from robot.drivers.wsg50.link import LinkLost, NoReply
from robot.drivers.wsg50.motion import ACTION, GripperReading, IsDone, check_ready, fault_names, read
from robot.drivers.wsg50.setup import TYPICAL_LIMITS, GripperSetup, WSG50Settings
from robot.errors import DeviceError
from robot.readings import GripperState, GripperStatus

_log = logging.getLogger(__name__)
_STATUS_OF: dict[GraspingState, GripperStatus] = {
    GraspingState.IDLE: "idle",
    GraspingState.GRASPING: "moving",
    GraspingState.NO_PART: "no_part",
    GraspingState.PART_LOST: "part_lost",
    GraspingState.HOLDING: "holding",
    GraspingState.RELEASING: "moving",
    GraspingState.POSITIONING: "moving",
}
_CLOSED_STATES = {GraspingState.HOLDING, GraspingState.NO_PART, GraspingState.PART_LOST}
"""States that end only by RELEASE; in them, the gripper refuses GRASP."""

_REACHED_MM, _SAME_MM = 1.0, 0.1
"""Tolerance of a reached target, and distance below which no motion is needed."""

_REGRIP_MM = 5.0
"""Opening motion that releases a held object before another grasp."""

_SLACK_S = 2.0
"""Extra time of a motion, for acceleration and the link."""


class WSG50(Gripper):
    """A WSG-50; the fields of WSG50Settings are keyword arguments of the constructor.

    `stop` releases a held object, because STOP ends the gripper's force control. Use the driver from one thread only;
    to stop the gripper from another thread, interrupt the driver's thread (Ctrl-C).
    """

    Settings = WSG50Settings

    def __init__(self, *, clock: Clock = time.monotonic, **settings: Any) -> None:
        """Check the settings; raise RobotConfigError for one out of range."""
        options = self._options = WSG50Settings(**settings)
        super().__init__(
            "WSG-50",
            stroke_mm=TYPICAL_LIMITS.stroke_mm,
            min_force_n=options.to_finger_force(TYPICAL_LIMITS.min_force_n),
            max_force_n=min(options.max_force_n, options.to_finger_force(TYPICAL_LIMITS.max_force_n)),
            max_speed_mm_s=options.max_speed_mm_s,
            clock=clock,
        )
        self._setup = GripperSetup(self.name, options, self.refused)
        self._link, self._motions = self._setup.link, self._setup.motions

    @property
    def line_counts(self) -> dict[str, int]:
        """Number of errors on the serial or TCP link so far, by kind."""
        return dict(self._link.counts)

    # Methods of the contract.

    def _connect(self) -> None:
        self._link.open()
        self._link.sync()
        self._set_up()

    def _close(self) -> None:
        """If the jaws move, stop them. Then send DISCONNECT.

        Over TCP, the gripper would otherwise enter FAST STOP.
        """
        if not (self._link.has_echoed or self._motions.may_be_moving):  # no motion was started
            self._link.close()
            return
        try:
            if self._link.is_open:
                self._setup.stop_if_moving(self._stop)
            else:  # the link was lost after the start of a motion; over a serial line the jaws still move
                self._stop()
            try:
                self._motions.stop_updates()
            finally:
                self._link.send(Packet(CommandId.DISCONNECT))
        finally:
            self._link.close()

    def _settings(self) -> dict[str, Any]:
        return self._setup.read_back()

    def _recover(self) -> None:
        """Reconnect, then restore reference and settings as on connecting."""
        for number in range(1, self._options.reconnect_tries + 1):
            self._setup.reconnect()
            try:
                self._set_up()
                return
            except (LinkLost, NoReply):
                self._stop_quietly()
                if number == self._options.reconnect_tries:
                    raise
            except BaseException:
                self._stop_quietly()
                raise

    def _stop(self) -> None:
        if not self._link.is_open:
            self._setup.reopen()
        for tries_left in reversed(range(self._options.reconnect_tries)):
            try:
                self._motions.stop()
                return
            except LinkLost:
                if not tries_left:
                    raise
            _log.warning("%s: lost the link during a possible motion: opening it again to stop the jaws", self.name)
            self._setup.reopen()

    def _state(self) -> GripperState:
        return self._as_state(read(self._link))

    def _open(self, opening_mm: float) -> GripperState:
        reading = self._read_ready()
        if reading.grasping in _CLOSED_STATES:
            reading = self._release(max(opening_mm, self._wider_opening(reading)))
        if abs(reading.opening_mm - opening_mm) > _SAME_MM:
            reading = self._move(opening_mm, closing=opening_mm < reading.opening_mm)
        return self._as_state(reading)

    def _grasp(self, force_n: float, speed_mm_s: float) -> GripperState:
        reading = self._read_ready()
        if reading.grasping in _CLOSED_STATES:
            self._release(self._wider_opening(reading))
        self._setup.set_force(force_n)
        width = max(self._options.grasp_width_mm, self._setup.opening_range[0])
        packet = commands.packet(CommandId.GRASP, width, speed_mm_s)
        return self._as_state(self._run(packet, speed_mm_s, lambda reading, _: reading.grasping in _CLOSED_STATES))

    # Methods beyond the contract.

    def home(self) -> GripperState:
        """Home the jaws over the whole stroke, at the gripper's own speed; raise DeviceError if this fails."""
        with self._moving("cannot be homed"):
            return self._as_state(self._setup.home())

    # Implementation.

    def _set_up(self) -> None:
        """Apply the settings and read the gripper's limits; max_force_n and max_speed_mm_s may lower them."""
        self._setup.run(may_home=self.may_move)
        limits, options = self._setup.limits, self._options
        self.min_opening_mm, self.stroke_mm = self._setup.opening_range
        self.min_force_n = options.to_finger_force(limits.min_force_n)
        self.max_force_n = min(options.max_force_n, options.to_finger_force(limits.max_force_n))
        self.min_speed_mm_s = limits.min_speed_mm_s
        self.max_speed_mm_s = min(options.max_speed_mm_s, limits.max_speed_mm_s)

    def _stop_quietly(self) -> None:
        try:
            self._stop()
        except DeviceError as error:
            _log.warning("%s: while it was stopped: %s", self.name, error)

    def _read_ready(self) -> GripperReading:
        reading = read(self._link)
        check_ready(reading)
        return reading

    def _wider_opening(self, reading: GripperReading) -> float:
        """Return an opening slightly wider than the current one, to release the object."""
        return min(reading.opening_mm + _REGRIP_MM, self._setup.opening_range[1])

    def _release(self, width_mm: float) -> GripperReading:
        speed = self._opening_speed()
        return self._run(commands.packet(CommandId.RELEASE, width_mm, speed), speed, _is_at(width_mm))

    def _move(self, width_mm: float, *, closing: bool) -> GripperReading:
        """Pre-position the jaws; a closing motion uses the smallest force."""
        if closing:
            self._setup.set_force(self.min_force_n)
        speed = self._opening_speed()
        return self._run(commands.move(width_mm, speed), speed, _is_at(width_mm))

    def _run(self, packet: Packet, speed_mm_s: float, done: IsDone) -> GripperReading:
        seconds = self._setup.limits.stroke_mm / speed_mm_s + _SLACK_S + self._options.timeout_s
        return self._motions.run(packet, seconds, done)

    def _opening_speed(self) -> float:
        return min(max(self._options.opening_speed_mm_s, self._setup.limits.min_speed_mm_s), self.max_speed_mm_s)

    def _as_state(self, reading: GripperReading) -> GripperState:
        if reading.system & SystemState.FAST_STOP or reading.grasping not in _STATUS_OF:
            raise DeviceError(
                f"{self.name} is in FAST STOP or in an error state: {fault_names(reading.system)}; {ACTION}"
            )
        status = _STATUS_OF[reading.grasping]
        if status == "holding" and reading.opening_mm < self._options.min_part_mm:
            status = "no_part"
        return GripperState(reading.opening_mm, self._options.to_finger_force(reading.force_n), status)


def _is_at(width_mm: float) -> IsDone:
    def done(reading: GripperReading, _: Status | None) -> bool:
        return reading.grasping is GraspingState.IDLE and abs(reading.opening_mm - width_mm) <= _REACHED_MM

    return done
