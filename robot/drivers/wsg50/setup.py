"""Settings of a WSG-50 and their application: link, limits, faults, reference, force and soft limits, read back."""

import logging
import math
import struct
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from robot.drivers.wsg50 import commands
from robot.drivers.wsg50.codec import Packet
from robot.drivers.wsg50.commands import CommandId, GraspingState, GripperLimits, Status, SystemState
from robot.drivers.wsg50.link import CommandFailed, Link, LinkLost
from robot.drivers.wsg50.motion import UPDATE_BYTES, GripperReading, Motions, fault_names
from robot.errors import DeviceError, RobotConfigError
from robot.settings import TypedSettings, bounded

_log = logging.getLogger(__name__)
_DIRECTIONS = {"default": 0, "out": 1, "in": 2}
_LONGEST_WAIT_S = 5.0
"""Longest wait between two tries to connect, unless the first is longer; doubling 20 times would take days."""

_ROUNDING = 1e-6
"""Accepted relative excess of the force limit, a rounding error of 32-bit numbers."""

TYPICAL_LIMITS = GripperLimits(110.0, 5.0, 420.0, 100.0, 5000.0, 5.0, 80.0, 120.0)
"""Limits of a WSG-50-110, used until the gripper has reported its own."""


@dataclass(frozen=True, kw_only=True)
class WSG50Settings(TypedSettings):
    """Settings of a WSG-50. Forces are those on each finger.

    Attributes:
        port: A path, or socket://192.168.1.20:1000.
        baud: Baud rate of a serial line, as set in the gripper (the default is not verified).
        stop_bits: Stop bits of a serial line, as set in the gripper (the default is not verified).
        timeout_s: Longest wait for an answer.
        home_direction: "default" as the gripper is configured, "out" or "in"; it is homed on connecting if it has lost
            its reference.
        acceleration_mm_s2: Acceleration of the jaws; 0 for the gripper's own setting.
        soft_limits_mm: Smallest and largest opening; empty for the gripper's own setting.
        tare: Whether to tare force-measuring fingers on connecting.
        acknowledge_faults: Whether to log and acknowledge a FAST STOP; if false, a person must acknowledge it.
        grasp_width_mm: Nominal width of the object, sent with each GRASP; 0 if unknown.
        min_part_mm: A smaller opening means that the fingers touch each other and hold no part.
        opening_speed_mm_s: Speed of opening and pre-positioning.
        finger_share: Fraction of the gripper's force on each finger; see `to_finger_force`.
        update_ms: Period of the state updates during a motion.
        homing_timeout_s: Longest duration of homing.
        reconnect_tries: Number of tries to open a lost port again.
        reconnect_s: First wait between two tries, which doubles up to 5 s.
        max_force_n: Upper limit of forces.
        max_speed_mm_s: Upper limit of speeds.
        max_state_age_s: The jaws are stopped if no state arrives for this long during a motion.
    """

    port: str
    baud: int = bounded(300, 4_000_000, 115200)
    stop_bits: int = bounded(1, 2, 1)
    timeout_s: float = bounded(1e-3, 600, 1.0)
    home_direction: str = "default"
    acceleration_mm_s2: float = bounded(0, 1e5, 0.0)
    soft_limits_mm: tuple[float, ...] = ()
    tare: bool = False
    acknowledge_faults: bool = False
    grasp_width_mm: float = bounded(0, 1000, 0.0)
    min_part_mm: float = bounded(0, 1000, 1.0)
    opening_speed_mm_s: float = bounded(1e-3, 1e4, 80.0)
    finger_share: float = bounded(0.1, 1.0, 0.5)
    update_ms: int = bounded(1, 1000, 20)
    homing_timeout_s: float = bounded(1e-3, 600, 30.0)
    reconnect_tries: int = bounded(1, 20, 5)
    reconnect_s: float = bounded(0, 60, 0.2)
    max_force_n: float = bounded(1e-3, 1e4, 40.0)
    max_speed_mm_s: float = bounded(1e-3, 1e4, 420.0)
    max_state_age_s: float = bounded(1e-3, 60, 0.5)

    def __post_init__(self) -> None:
        """Raise RobotConfigError for a setting of another type or out of range."""
        super().__post_init__()
        if self.max_state_age_s < 2e-3 * self.update_ms:
            raise RobotConfigError(f"max_state_age_s must be at least two periods of update_ms = {self.update_ms} ms")
        if self.home_direction not in _DIRECTIONS:
            raise RobotConfigError(
                f"home_direction must be one of {', '.join(_DIRECTIONS)}, got {self.home_direction!r}"
            )
        soft = self.soft_limits_mm
        if soft and (len(soft) != 2 or not 0 <= soft[0] < soft[1]):
            raise RobotConfigError(f"soft_limits_mm must be the smallest and largest opening, or empty; got {soft}")
        # Updates may take half of a serial line, to leave room for answers. A byte has 8 data bits and a start bit.
        bits_s = UPDATE_BYTES * (9 + self.stop_bits) * 1000 / self.update_ms
        if not self.port.startswith("socket://") and bits_s > 0.5 * self.baud:
            raise RobotConfigError(
                f"baud must be at least {2 * bits_s:g} for updates every {self.update_ms} ms, which then take half of "
                f"the line; got {self.baud}"
            )

    def to_finger_force(self, gripper_n: float) -> float:
        """Convert the gripper's force (N) to the force on each finger (N).

        The contract's force is the force on each finger (robot.devices). The gripper's force limit is the sum over
        both. SCHUNK's manual of its fieldbus interface defines the register FORCELIMIT: "the grasping force is twice
        the nominal force that is applied to the part to be grasped". SCHUNK also rates its grippers by the sum over the
        jaws. So with a limit of 40 N each finger pushes with 20 N, the fraction 0.5. A user of the simulator Drake
        found this factor in their own controller (its pull request 9950).

        Two points are uncertain. We assume that the reported force (45h) is defined as the limit is. Without
        force-measuring fingers, the gripper derives the force from its motor current only. With a force gauge, set
        `finger_share` to the measured force on one finger divided by the limit.
        """
        return gripper_n * self.finger_share

    def to_gripper_force(self, finger_n: float) -> float:
        """Convert a force on each finger (N) to the gripper's force (N), rounded down to 32 bits."""
        packed = struct.pack("<f", finger_n / self.finger_share)
        if struct.unpack("<f", packed)[0] > finger_n / self.finger_share:
            packed = struct.pack("<I", struct.unpack("<I", packed)[0] - 1)  # the next smaller positive float
        return float(struct.unpack("<f", packed)[0])


class GripperSetup:
    """Applies the settings to a gripper. Its methods raise DeviceError.

    Args:
        name: Name of the gripper in messages.
        settings: The settings.
        refused: Receives the settings that the gripper refuses.

    Attributes:
        limits: Limits of the gripper.
        opening_range: Smallest and largest opening (mm) within the soft limits.
    """

    def __init__(self, name: str, settings: WSG50Settings, refused: dict[str, str]) -> None:
        self.name, self.settings, self.refused = name, settings, refused
        self.link = Link(settings.port, baud=settings.baud, stop_bits=settings.stop_bits, timeout_s=settings.timeout_s)
        self.motions = Motions(self.link, max_age_s=settings.max_state_age_s, period_ms=settings.update_ms)
        self.limits, self.opening_range = TYPICAL_LIMITS, (0.0, TYPICAL_LIMITS.stroke_mm)

    def run(self, may_home: bool) -> None:
        """Apply all settings over an open link; home if the reference is lost, or raise if `may_home` is false."""
        self.limits = self.link.query(commands.query(CommandId.LIMITS), commands.limits)
        force, speed = self.settings.max_force_n, self.settings.max_speed_mm_s
        lowest = self.settings.to_finger_force(self.limits.min_force_n)
        if force < lowest or speed < self.limits.min_speed_mm_s:
            raise RobotConfigError(
                f"{self.name}: the limits must allow at least {lowest:g} N on each finger and "
                f"{self.limits.min_speed_mm_s:g} mm/s, the smallest values of the gripper; got {force:g} N and "
                f"{speed:g} mm/s"
            )
        self.stop_if_moving(self.motions.stop)
        self._end_fast_stop()
        if not self._system_state() & SystemState.REFERENCED:
            if not may_home:
                raise DeviceError(f"{self.name} has lost its reference and must be homed, but motion is not allowed")
            _log.warning("%s has lost its reference: homing, the jaws move", self.name)
            self.home()
        self._apply()

    def reconnect(self) -> None:
        """Open the port, if necessary, and synchronise; repeat after a failure, with increasing waits."""
        wait_s = self.settings.reconnect_s
        for number in range(1, self.settings.reconnect_tries + 1):
            try:
                self.link.open()
                self.link.sync()
                return
            except DeviceError as error:
                self.link.close()
                if number == self.settings.reconnect_tries:
                    raise DeviceError(f"{self.name} cannot be reached after {number} tries: {error}") from error
                _log.warning("%s: no connection (%s); trying again in %.2g s", self.name, error, wait_s)
            time.sleep(wait_s)
            wait_s = min(2 * wait_s, max(wait_s, _LONGEST_WAIT_S))

    def reopen(self) -> None:
        """Open the port, or wait a little if it cannot be opened."""
        try:
            self.link.open()
        except LinkLost:
            time.sleep(self.settings.reconnect_s)

    def home(self) -> GripperReading:
        """Home the jaws. If the answer is lost, a reference that was missing and is now present proves success."""
        packet = commands.home(_DIRECTIONS[self.settings.home_direction])
        before = self._system_state()

        def done(reading: GripperReading, status: Status | None) -> bool:
            proven = status is Status.SUCCESS or not SystemState.REFERENCED & before & self.motions.common_state
            return proven and bool(reading.system & SystemState.REFERENCED)

        return self.motions.run(packet, self.settings.homing_timeout_s, done)

    def stop_if_moving(self, stop: Callable[[], None]) -> None:
        """Call `stop` only if the jaws move or may move, because STOP would drop a held object."""
        try:
            is_moving = self.motions.read().is_moving
        except LinkLost:
            if not self.motions.may_be_moving:
                raise
            is_moving = True
        except DeviceError:
            is_moving = True  # unknown
        if is_moving:
            stop()

    def set_force(self, force_n: float) -> None:
        """Set the force limit and read it back; raise DeviceError if the gripper would clamp harder."""
        settings, lowest = self.settings, self.limits.min_force_n
        force_limit_n, ceiling = (
            max(settings.to_gripper_force(each), lowest) for each in (force_n, settings.max_force_n)
        )
        self.link.send(commands.packet(CommandId.SET_FORCE_LIMIT, force_limit_n))
        has = self.link.query(commands.query(CommandId.GET_FORCE_LIMIT), commands.number)
        self._note("force_n", force_n, settings.to_finger_force(has))
        if has > min(force_limit_n * (1 + _ROUNDING), ceiling):
            raise DeviceError(
                f"{self.name}: the force limit (both fingers) must be {force_limit_n:g} N, but the gripper has "
                f"{has:g} N; the jaws do not close"
            )

    def read_back(self) -> dict[str, Any]:
        """Return all settings that the gripper reports; forces are those on each finger."""
        link = self.link
        force = link.query(commands.query(CommandId.GET_FORCE_LIMIT), commands.number)
        return {
            "info": asdict(link.query(commands.query(CommandId.INFO), commands.info)),
            "limits": asdict(link.query(commands.query(CommandId.LIMITS), commands.limits)),
            "acceleration_mm_s2": link.query(commands.query(CommandId.GET_ACCELERATION), commands.number),
            "force_limit_n": self.settings.to_finger_force(force),
            "finger_share": self.settings.finger_share,
            "soft_limits_mm": self._soft_limits(),
        }

    def _system_state(self) -> SystemState:
        return self.link.query(commands.query(CommandId.SYSTEM_STATE), commands.system_state)

    def _end_fast_stop(self) -> None:
        """Log a FAST STOP, and acknowledge it if allowed."""
        system = self._system_state()
        if not system & SystemState.FAST_STOP:
            return
        _log.warning("%s is in FAST STOP: %s", self.name, fault_names(system))
        if not self.settings.acknowledge_faults:
            raise DeviceError(
                f"{self.name} is in FAST STOP: {fault_names(system)}; remove the cause, then acknowledge it on the "
                "gripper's web page, or set acknowledge_faults = true"
            )
        try:
            self.link.send(commands.acknowledge())
        except CommandFailed as error:  # a repeated command has nothing to acknowledge
            _log.warning("%s: %s", self.name, error)
        if self._system_state() & SystemState.FAST_STOP:
            raise DeviceError(
                f"{self.name} is still in FAST STOP after acknowledgement: {fault_names(system)}; remove the cause"
            )
        _log.warning("%s: FAST STOP acknowledged", self.name)

    def _apply(self) -> None:
        settings, link = self.settings, self.link
        is_holding = self.motions.read().grasping is GraspingState.HOLDING
        if not is_holding:  # with a smaller force, the held object would fall
            self.set_force(settings.to_finger_force(self.limits.min_force_n))
        if requested := settings.acceleration_mm_s2:
            lowest, highest = self.limits.min_acceleration_mm_s2, self.limits.max_acceleration_mm_s2
            self._require("acceleration_mm_s2", requested, lowest, highest)
            link.send(commands.packet(CommandId.SET_ACCELERATION, requested))
            has = link.query(commands.query(CommandId.GET_ACCELERATION), commands.number)
            self._note("acceleration_mm_s2", requested, has)
        self._set_soft_limits()
        self.refused.pop("tare", None)
        if settings.tare and is_holding:
            self.refused["tare"] = "requested true, but an object is held; open the gripper, then call recover()"
        elif settings.tare:
            try:
                link.send(Packet(CommandId.TARE))
            except CommandFailed as error:
                self.refused["tare"] = f"requested true, but {error}: are the fingers force-measuring and empty?"

    def _set_soft_limits(self) -> None:
        """Set the soft limits, if requested, and read back the opening range."""
        requested = self.settings.soft_limits_mm
        if requested:
            for each in requested:
                self._require("soft_limits_mm", each, 0.0, self.limits.stroke_mm)
            self._check_grasp_width(requested[1])
            self.link.send(commands.packet(CommandId.SET_SOFT_LIMITS, *requested))
        has = self._soft_limits()
        self.refused.pop("soft_limits_mm", None)
        if requested and (has is None or not all(map(_is_close, requested, has))):
            self.refused["soft_limits_mm"] = f"requested {tuple(requested)}, has {has}"
        lowest, highest = has or (0.0, self.limits.stroke_mm)
        self.opening_range = max(0.0, lowest), min(highest, self.limits.stroke_mm)
        self._check_grasp_width(self.opening_range[1])

    def _soft_limits(self) -> tuple[float, float] | None:
        try:
            found = self.link.query(commands.query(CommandId.GET_SOFT_LIMITS), commands.soft_limits)
        except CommandFailed:
            return None
        return found if found[0] < found[1] else None

    def _check_grasp_width(self, greatest_mm: float) -> None:
        if self.settings.grasp_width_mm > greatest_mm:
            raise DeviceError(
                f"{self.name}: grasp_width_mm must be at most the largest opening, {greatest_mm:g} mm, got "
                f"{self.settings.grasp_width_mm:g}; reduce it, or widen the soft limits"
            )

    def _require(self, name: str, value: float, lowest: float, highest: float) -> None:
        if not lowest <= value <= highest:
            raise DeviceError(f"{self.name}: {name} must be from {lowest:g} to {highest:g}, got {value:g}")

    def _note(self, name: str, requested: float, has: float) -> None:
        self.refused.pop(name, None)
        if not _is_close(requested, has):
            self.refused[name] = f"requested {requested:g}, has {has:g}"


def _is_close(requested: float, has: float) -> bool:
    """Return whether two numbers are equal up to the gripper's rounding."""
    return math.isclose(requested, has, rel_tol=0.01, abs_tol=0.01)
