"""What a WSG-50 is set to, and the getting there: line, limits, faults, reference, force and soft limits, read back."""

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
"""Between two tries to reach the gripper, unless the first wait is longer: doubled twenty times it would be days."""

_ROUNDING = 1e-6
"""How much harder than asked a gripper may clamp, relatively: less than numbers of 32 bits are off."""

TYPICAL_LIMITS = GripperLimits(110.0, 5.0, 420.0, 100.0, 5000.0, 5.0, 80.0, 120.0)
"""Of a WSG-50-110, until the gripper has said its own."""


@dataclass(frozen=True, kw_only=True)
class WSG50Settings(TypedSettings):
    """Settings of a WSG-50 at `port`: a path, or socket://192.168.1.20:1000. Forces are those on each finger.

    baud, stop_bits: of a serial line, as set in the gripper (the defaults are not verified). timeout_s: of an answer.
    home_direction: "default" as the gripper is configured, "out" or "in"; it is homed on connecting if it has lost its
    reference. acceleration_mm_s2: 0 leaves the gripper's own; soft_limits_mm: least and greatest opening, empty leaves
    its own. tare: the force-measuring fingers on connecting. acknowledge_faults: end a FAST STOP that is found, after
    saying it aloud; else a person must. grasp_width_mm: nominal width given with each grasp. min_part_mm: what is
    held at less is the other finger, not a part. finger_share: see `to_finger_force`. update_ms: period of the state while
    it moves, which must not be older than max_state_age_s. reconnect_tries, reconnect_s: how often `recover` opens the
    port again, and the first wait (s), which doubles up to 5 s. max_force_n, max_speed_mm_s: ceilings.
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
        """Raises RobotConfigError for a setting of the wrong type or out of range."""
        super().__post_init__()
        if self.max_state_age_s < 2e-3 * self.update_ms:
            raise RobotConfigError(f"max_state_age_s must span two updates of {self.update_ms} ms")
        if self.home_direction not in _DIRECTIONS:
            raise RobotConfigError(f"home_direction must be of {', '.join(_DIRECTIONS)}, got {self.home_direction!r}")
        soft = self.soft_limits_mm
        if soft and (len(soft) != 2 or not 0 <= soft[0] < soft[1]):
            raise RobotConfigError(f"soft_limits_mm must be the least and greatest opening, or empty; got {soft}")
        # A serial line that is full of updates has no room for answers. A byte has 8 data bits and a start bit.
        bits_s = UPDATE_BYTES * (9 + self.stop_bits) * 1000 / self.update_ms
        if not self.port.startswith("socket://") and bits_s > 0.5 * self.baud:
            raise RobotConfigError(
                f"baud must be at least {2 * bits_s:g} for updates every {self.update_ms} ms, which then fill half of "
                f"the line; got {self.baud}"
            )

    def to_finger_force(self, gripper_n: float) -> float:
        """Force on each finger (N) where the gripper counts `gripper_n`.

        The contract's force is the one on each finger (robot.devices). The gripper's force limit is the sum over both:
        SCHUNK's manual of its fieldbus interface says of the register FORCELIMIT that "the grasping force is twice the
        nominal force that is applied to the part to be grasped", and SCHUNK rates its grippers by the sum over the
        jaws. So an object gripped with a limit of 40 N is pushed with 20 N by each finger: the share 0.5 of it. A user
        of the open simulator Drake found their own controller off by this very factor (its pull request 9950).

        Not certain: that the force which the gripper reports (45h) counts as its limit does, which is assumed here; and
        how near the true force is, for without force-measuring fingers the gripper knows its motor's current only.
        Whoever has a force gauge sets `finger_share` to what is measured on one finger, over the limit set.
        """
        return gripper_n * self.finger_share

    def to_gripper_force(self, finger_n: float) -> float:
        """What the gripper must count (N) for `finger_n` on each finger, as the greatest number of 32 bits up to it."""
        packed = struct.pack("<f", finger_n / self.finger_share)
        if struct.unpack("<f", packed)[0] > finger_n / self.finger_share:
            packed = struct.pack("<I", struct.unpack("<I", packed)[0] - 1)  # bits of positive numbers count like them
        return float(struct.unpack("<f", packed)[0])


class GripperSetup:
    """Brings the gripper on a link to its settings. `refused` is filled with what it does not take.

    limits: what the gripper can do; openings: least and greatest (mm) that its soft limits leave. Raises DeviceError.
    """

    def __init__(self, name: str, settings: WSG50Settings, refused: dict[str, str]) -> None:
        self.name, self.settings, self.refused = name, settings, refused
        self.link = Link(settings.port, baud=settings.baud, stop_bits=settings.stop_bits, timeout_s=settings.timeout_s)
        self.motions = Motions(self.link, max_age_s=settings.max_state_age_s, period_ms=settings.update_ms)
        self.limits, self.opening_range = TYPICAL_LIMITS, (0.0, TYPICAL_LIMITS.stroke_mm)

    def run(self, may_home: bool) -> None:
        """All of it, over an open line. Homes where the reference is lost, or raises DeviceError where it may not."""
        self.limits = self.link.query(commands.query(CommandId.LIMITS), commands.limits)
        force, speed = self.settings.max_force_n, self.settings.max_speed_mm_s
        least = self.settings.to_finger_force(self.limits.min_force_n)
        if force < least or speed < self.limits.min_speed_mm_s:
            raise RobotConfigError(
                f"{self.name}: the ceilings must allow its least force on a finger, {least:g} N, and speed, "
                f"{self.limits.min_speed_mm_s:g} mm/s; got {force:g} N and {speed:g} mm/s"
            )
        self.stop_if_moving(self.motions.stop)
        self._end_fast_stop()
        if not self._system_state() & SystemState.REFERENCED:
            if not may_home:
                raise DeviceError(f"{self.name} does not know its reference, and may not be moved now to find it")
            _log.warning("%s does not know its reference: homing, the jaws move", self.name)
            self.home()
        self._apply()

    def reconnect(self) -> None:
        """Have the gripper answer, opening the port again if need be, with waits that double."""
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
                _log.warning("%s: no line (%s); trying again in %.2g s", self.name, error, wait_s)
            time.sleep(wait_s)
            wait_s = min(2 * wait_s, max(wait_s, _LONGEST_WAIT_S))

    def reopen(self) -> None:
        """Open the port, or wait a little where it cannot be opened."""
        try:
            self.link.open()
        except LinkLost:
            time.sleep(self.settings.reconnect_s)

    def home(self) -> GripperReading:
        """Find the reference. That it is there proves homing if it was not before, or not while it moved."""
        packet = commands.home(_DIRECTIONS[self.settings.home_direction])
        before = self._system_state()

        def done(reading: GripperReading, status: Status | None) -> bool:
            proven = status is Status.SUCCESS or not SystemState.REFERENCED & before & self.motions.common_state
            return proven and bool(reading.system & SystemState.REFERENCED)

        return self.motions.run(packet, self.settings.homing_timeout_s, done)

    def stop_if_moving(self, stop: Callable[[], None]) -> None:
        """Standing jaws are left as they are: STOP would drop what they hold."""
        try:
            is_moving = self.motions.read().is_moving
        except LinkLost:
            if not self.motions.may_be_moving:
                raise
            is_moving = True
        except DeviceError:
            is_moving = True  # not known
        if is_moving:
            stop()

    def set_force(self, force_n: float) -> None:
        """Set the force limit and read it back; a gripper that would clamp harder than asked is not used."""
        settings, least = self.settings, self.limits.min_force_n
        force_limit_n, ceiling = (
            max(settings.to_gripper_force(each), least) for each in (force_n, settings.max_force_n)
        )
        self.link.send(commands.packet(CommandId.SET_FORCE_LIMIT, force_limit_n))
        has = self.link.query(commands.query(CommandId.GET_FORCE_LIMIT), commands.number)
        self._note("force_n", force_n, settings.to_finger_force(has))
        if has > min(force_limit_n * (1 + _ROUNDING), ceiling):
            raise DeviceError(
                f"{self.name}: the force limit must be {force_limit_n:g} N, the gripper has {has:g} N; it is not told to grasp"
            )

    def read_back(self) -> dict[str, Any]:
        """Everything that the gripper says of its settings; forces as the contract counts them."""
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
        """Say a FAST STOP aloud, and acknowledge it if that is allowed."""
        system = self._system_state()
        if not system & SystemState.FAST_STOP:
            return
        _log.warning("%s is in FAST STOP: %s", self.name, fault_names(system))
        if not self.settings.acknowledge_faults:
            raise DeviceError(
                f"{self.name} is in FAST STOP: {fault_names(system)}; see to it, then acknowledge it on the gripper's web "
                "page, or set acknowledge_faults = true"
            )
        try:
            self.link.send(commands.acknowledge())
        except CommandFailed as error:  # said twice, the second finds nothing to acknowledge
            _log.warning("%s: %s", self.name, error)
        if self._system_state() & SystemState.FAST_STOP:
            raise DeviceError(f"{self.name} stays in FAST STOP though acknowledged: {fault_names(system)}; see to it")
        _log.warning("%s: FAST STOP acknowledged", self.name)

    def _apply(self) -> None:
        settings, link = self.settings, self.link
        holds = self.motions.read().grasping is GraspingState.HOLDING
        if not holds:  # else what is held would be held with less, and be dropped
            self.set_force(settings.to_finger_force(self.limits.min_force_n))
        if requested := settings.acceleration_mm_s2:
            least, most = self.limits.min_acceleration_mm_s2, self.limits.max_acceleration_mm_s2
            self._require("acceleration_mm_s2", requested, least, most)
            link.send(commands.packet(CommandId.SET_ACCELERATION, requested))
            has = link.query(commands.query(CommandId.GET_ACCELERATION), commands.number)
            self._note("acceleration_mm_s2", requested, has)
        self._set_soft_limits()
        self.refused.pop("tare", None)
        if settings.tare and holds:
            self.refused["tare"] = "asked true, but something is held; open it, then call recover()"
        elif settings.tare:
            try:
                link.send(Packet(CommandId.TARE))
            except CommandFailed as error:
                self.refused["tare"] = f"asked true, but {error}: has it force-measuring fingers, and holds nothing?"

    def _set_soft_limits(self) -> None:
        """Set the openings that no motion leaves, where any are asked, and learn which openings there are."""
        requested = self.settings.soft_limits_mm
        if requested:
            for each in requested:
                self._require("soft_limits_mm", each, 0.0, self.limits.stroke_mm)
            self._check_grasp_width(requested[1])
            self.link.send(commands.packet(CommandId.SET_SOFT_LIMITS, *requested))
        has = self._soft_limits()
        self.refused.pop("soft_limits_mm", None)
        if requested and (has is None or not all(map(_is_close, requested, has))):
            self.refused["soft_limits_mm"] = f"asked {tuple(requested)}, has {has}"
        least, greatest = has or (0.0, self.limits.stroke_mm)
        self.opening_range = max(0.0, least), min(greatest, self.limits.stroke_mm)
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
                f"{self.name}: grasp_width_mm must be at most the greatest opening, {greatest_mm:g} mm, got "
                f"{self.settings.grasp_width_mm:g}; set it lower, or the soft limits wider"
            )

    def _require(self, name: str, value: float, least: float, most: float) -> None:
        if not least <= value <= most:
            raise DeviceError(f"{self.name}: {name} must be from {least:g} to {most:g}, got {value:g}")

    def _note(self, name: str, requested: float, has: float) -> None:
        self.refused.pop(name, None)
        if not _is_close(requested, has):
            self.refused[name] = f"asked {requested:g}, has {has:g}"


def _is_close(requested: float, has: float) -> bool:
    """Numbers of 32 bits, and what a gripper may round."""
    return math.isclose(requested, has, rel_tol=0.01, abs_tol=0.01)
