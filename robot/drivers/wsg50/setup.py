"""What a WSG-50 is set to, and the getting there: line, limits, faults, reference, force and soft limits, read back."""

import logging
import math
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from robot.drivers.wsg50 import commands
from robot.drivers.wsg50.codec import Packet
from robot.drivers.wsg50.commands import Command, GraspingState, GripperLimits, Status, SystemState
from robot.drivers.wsg50.force import of_gripper, on_finger
from robot.drivers.wsg50.link import CommandFailed, Link
from robot.drivers.wsg50.motion import UPDATE_BYTES, Motions, Reading, causes, read
from robot.drivers.wsg50.port import LinkLost
from robot.errors import DeviceError, RobotConfigError
from robot.settings import check_range

_log = logging.getLogger(__name__)
_DIRECTIONS = {"default": 0, "out": 1, "in": 2}
_RANGES = {
    "baud": (300, 4_000_000),
    "stop_bits": (1, 2),
    "timeout_s": (1e-3, 600),
    "acceleration_mm_s2": (0, 1e5),
    "grasp_width_mm": (0, 1000),
    "least_part_mm": (0, 1000),
    "opening_speed_mm_s": (1e-3, 1e4),
    "finger_share": (0.1, 1.0),
    "update_ms": (1, 1000),
    "homing_timeout_s": (1e-3, 600),
    "reconnect_tries": (1, 20),
    "reconnect_s": (0, 60),
    "max_force_n": (1e-3, 1e4),
    "max_speed_mm_s": (1e-3, 1e4),
    "max_state_age_s": (1e-3, 60),
}

_LONGEST_WAIT_S = 5.0
"""Between two tries to reach the gripper, unless the first wait is longer: doubled twenty times it would be days."""

_ROUNDING = 1e-6
"""How much harder than asked a gripper may clamp, relatively: less than numbers of 32 bits are off."""

TYPICAL = GripperLimits(110.0, 5.0, 420.0, 100.0, 5000.0, 5.0, 80.0, 120.0)
"""Of a WSG-50-110, until the gripper has said its own."""


@dataclass(frozen=True)
class Settings:
    """As robot.drivers.wsg50.driver.WSG50 explains them."""

    port: str
    baud: int
    stop_bits: int
    timeout_s: float
    home_direction: str
    acceleration_mm_s2: float
    soft_limits_mm: Sequence[float]
    tare: bool
    acknowledge_faults: bool
    grasp_width_mm: float
    least_part_mm: float
    opening_speed_mm_s: float
    finger_share: float
    update_ms: int
    homing_timeout_s: float
    reconnect_tries: int
    reconnect_s: float
    max_force_n: float
    max_speed_mm_s: float
    max_state_age_s: float

    def __post_init__(self) -> None:
        """Raises RobotConfigError for a setting of the wrong type or out of range."""
        for field in fields(self):
            if not _is_a(field.type, getattr(self, field.name)):
                kind = getattr(field.type, "__name__", field.type)
                raise RobotConfigError(f"{field.name} must be a {kind}, got {getattr(self, field.name)!r}")
        for name, (least, most) in _RANGES.items():
            check_range(name, getattr(self, name), least, most)
        if self.max_state_age_s < 2e-3 * self.update_ms:
            raise RobotConfigError(f"max_state_age_s must span two updates of {self.update_ms} ms")
        if self.home_direction not in _DIRECTIONS:
            raise RobotConfigError(f"home_direction must be of {', '.join(_DIRECTIONS)}, got {self.home_direction!r}")
        soft = tuple(self.soft_limits_mm)
        if soft and (len(soft) != 2 or not 0 <= soft[0] < soft[1] < math.inf):
            raise RobotConfigError(f"soft_limits_mm must be the least and greatest opening, or empty; got {soft}")
        self._check_rate()

    def _check_rate(self) -> None:
        """A serial line that is full of updates has no room for answers. A byte has 8 data bits and a start bit."""
        bits_s = UPDATE_BYTES * (9 + self.stop_bits) * 1000 / self.update_ms
        if not self.port.startswith("socket://") and bits_s > 0.5 * self.baud:
            raise RobotConfigError(
                f"baud must be at least {2 * bits_s:g} for updates every {self.update_ms} ms, which then fill half of "
                f"the line; got {self.baud}"
            )


class Setup:
    """Brings the gripper on a link to its settings. `refused` is filled with what it does not take.

    limits: what the gripper can do; openings: least and greatest (mm) that its soft limits leave. Raises DeviceError.
    """

    def __init__(self, name: str, settings: Settings, refused: dict[str, str]) -> None:
        self.name, self.settings, self.refused = name, settings, refused
        self.link = Link(settings.port, baud=settings.baud, stop_bits=settings.stop_bits, timeout_s=settings.timeout_s)
        self.motions = Motions(self.link, max_age_s=settings.max_state_age_s, period_ms=settings.update_ms)
        self.limits, self.openings = TYPICAL, (0.0, TYPICAL.stroke_mm)

    def run(self, may_home: bool) -> None:
        """All of it, over an open line. Homes where the reference is lost, or raises DeviceError where it may not."""
        self.limits = self.link.ask(commands.ask(Command.LIMITS), commands.limits)
        self._check_ceilings()
        self.stop_if_it_moves(self.motions.stop)
        self._end_fast_stop()
        if not self._system_state() & SystemState.REFERENCED:
            if not may_home:
                raise DeviceError(f"{self.name} does not know its reference, and may not be moved now to find it")
            _log.warning("%s does not know its reference: homing, the jaws move", self.name)
            self.home()
        self._apply()

    def reach(self) -> None:
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

    def open_again(self) -> None:
        """Open the port, or wait a little where it cannot be opened."""
        try:
            self.link.open()
        except LinkLost:
            time.sleep(self.settings.reconnect_s)

    def home(self) -> Reading:
        """Find the reference. That it is there proves homing if it was not before, or not while it moved."""
        packet = commands.home(_DIRECTIONS[self.settings.home_direction])
        before = self._system_state()

        def done(reading: Reading, status: Status | None) -> bool:
            proven = status is Status.SUCCESS or not SystemState.REFERENCED & before & self.motions.kept
            return proven and bool(reading.system & SystemState.REFERENCED)

        return self.motions.run(packet, self.settings.homing_timeout_s, done)

    def stop_if_it_moves(self, stop: Callable[[], None]) -> None:
        """Standing jaws are left as they are: STOP would drop what they hold."""
        try:
            moves = self.motions.read().moves
        except LinkLost:
            if not self.motions.unsettled:
                raise
            moves = True
        except DeviceError:
            moves = True  # not known
        if moves:
            stop()

    def check_stands(self) -> None:
        """Settings that change while it moves raise a FAST STOP."""
        if read(self.link).moves:
            raise DeviceError(f"{self.name} must stand while it is set, and is moving; call stop()")

    def set_force(self, force_n: float) -> None:
        """Set the force limit and read it back; a gripper that would clamp harder than asked is not used."""
        share = self.settings.finger_share
        wanted, ceiling = self._limit_for(force_n), self._limit_for(self.settings.max_force_n)
        self.link.tell(commands.set_force_limit(wanted))
        has = self.link.ask(commands.ask(Command.GET_FORCE_LIMIT), commands.number)
        self._note("force_n", force_n, on_finger(has, share))
        if has > min(wanted * (1 + _ROUNDING), ceiling):
            raise DeviceError(
                f"{self.name}: the force limit must be {wanted:g} N, the gripper has {has:g} N; it is not told to grasp"
            )

    def _limit_for(self, force_n: float) -> float:
        """The gripper's count for a force on each finger, as a number of 32 bits that is not above it."""
        wanted = of_gripper(force_n, self.settings.finger_share)
        return max(_float32_at_most(wanted), self.limits.min_force_n)

    def set_acceleration(self, acceleration_mm_s2: float) -> float:
        """Set the acceleration; returns what the gripper has then."""
        least, most = self.limits.min_acceleration_mm_s2, self.limits.max_acceleration_mm_s2
        self._require("acceleration_mm_s2", acceleration_mm_s2, least, most)
        self.link.tell(commands.set_acceleration(acceleration_mm_s2))
        has = self.link.ask(commands.ask(Command.GET_ACCELERATION), commands.number)
        self._note("acceleration_mm_s2", acceleration_mm_s2, has)
        return has

    def set_soft_limits(self, asked: Sequence[float]) -> tuple[float, float] | None:
        """Set the openings that no motion leaves, or clear them where `asked` is empty; returns what it has then."""
        for each in asked:
            self._require("soft_limits_mm", each, 0.0, self.limits.stroke_mm)
        if asked:
            self._check_grasp_width(asked[1])
        self.link.tell(commands.set_soft_limits(*asked) if asked else commands.ask(Command.CLEAR_SOFT_LIMITS))
        return self._learn_openings(asked)

    def read_back(self) -> dict[str, Any]:
        """Everything that the gripper says of its settings; forces as the contract counts them."""
        link, share = self.link, self.settings.finger_share
        force = link.ask(commands.ask(Command.GET_FORCE_LIMIT), commands.number)
        return {
            "info": asdict(link.ask(commands.ask(Command.INFO), commands.info)),
            "limits": asdict(link.ask(commands.ask(Command.LIMITS), commands.limits)),
            "acceleration_mm_s2": link.ask(commands.ask(Command.GET_ACCELERATION), commands.number),
            "force_limit_n": on_finger(force, share),
            "finger_share": share,
            "soft_limits_mm": self._soft_limits(),
        }

    def _check_ceilings(self) -> None:
        force, speed = self.settings.max_force_n, self.settings.max_speed_mm_s
        least = on_finger(self.limits.min_force_n, self.settings.finger_share)
        if force < least or speed < self.limits.min_speed_mm_s:
            raise RobotConfigError(
                f"{self.name}: the ceilings must allow its least force on a finger, {least:g} N, and speed, "
                f"{self.limits.min_speed_mm_s:g} mm/s; got {force:g} N and {speed:g} mm/s"
            )

    def _system_state(self) -> SystemState:
        return self.link.ask(commands.ask(Command.SYSTEM_STATE), commands.system_state)

    def _end_fast_stop(self) -> None:
        """Say a FAST STOP aloud, and acknowledge it if that is allowed."""
        system = self._system_state()
        if not system & SystemState.FAST_STOP:
            return
        _log.warning("%s is in FAST STOP: %s", self.name, causes(system))
        if not self.settings.acknowledge_faults:
            raise DeviceError(
                f"{self.name} is in FAST STOP: {causes(system)}; see to it, then acknowledge it on the gripper's web "
                "page, or set acknowledge_faults = true"
            )
        try:
            self.link.tell(commands.acknowledge())
        except CommandFailed as error:  # said twice, the second finds nothing to acknowledge
            _log.warning("%s: %s", self.name, error)
        if self._system_state() & SystemState.FAST_STOP:
            raise DeviceError(f"{self.name} stays in FAST STOP though acknowledged: {causes(system)}; see to it")
        _log.warning("%s: FAST STOP acknowledged", self.name)

    def _apply(self) -> None:
        settings = self.settings
        holds = self.motions.read().grasping is GraspingState.HOLDING
        if not holds:  # else what is held would be held with less, and be dropped
            self.set_force(on_finger(self.limits.min_force_n, settings.finger_share))
        if settings.acceleration_mm_s2:
            self.set_acceleration(settings.acceleration_mm_s2)
        if settings.soft_limits_mm:
            self.set_soft_limits(settings.soft_limits_mm)
        else:
            self._learn_openings(())
        self.refused.pop("tare", None)
        if settings.tare and holds:
            self.refused["tare"] = "asked true, but something is held; open it, then call tare()"
        elif settings.tare:
            self._tare()

    def _tare(self) -> None:
        try:
            self.link.tell(Packet(Command.TARE))
        except CommandFailed as error:
            self.refused["tare"] = f"asked true, but {error}: has it force-measuring fingers, and holds nothing?"

    def _soft_limits(self) -> tuple[float, float] | None:
        try:
            found = self.link.ask(commands.ask(Command.GET_SOFT_LIMITS), commands.soft_limits)
        except CommandFailed:
            return None
        return found if found[0] < found[1] else None

    def _learn_openings(self, asked: Sequence[float]) -> tuple[float, float] | None:
        has = self._soft_limits()
        self.refused.pop("soft_limits_mm", None)
        if asked and (has is None or not all(map(_near, asked, has))):
            self.refused["soft_limits_mm"] = f"asked {tuple(asked)}, has {has}"
        least, greatest = has or (0.0, self.limits.stroke_mm)
        self.openings = max(0.0, least), min(greatest, self.limits.stroke_mm)
        self._check_grasp_width(self.openings[1])
        return has

    def _check_grasp_width(self, greatest_mm: float) -> None:
        if self.settings.grasp_width_mm > greatest_mm:
            raise DeviceError(
                f"{self.name}: grasp_width_mm must be at most the greatest opening, {greatest_mm:g} mm, got "
                f"{self.settings.grasp_width_mm:g}; set it lower, or the soft limits wider"
            )

    def _require(self, name: str, value: float, least: float, most: float) -> None:
        if not least <= value <= most:
            raise DeviceError(f"{self.name}: {name} must be from {least:g} to {most:g}, got {value:g}")

    def _note(self, name: str, asked: float, has: float) -> None:
        self.refused.pop(name, None)
        if not _near(asked, has):
            self.refused[name] = f"asked {asked:g}, has {has:g}"


def first_failure(steps: Sequence[Callable[[], None]]) -> DeviceError | None:
    """Do every step, also after one has failed."""
    failure = None
    for step in steps:
        try:
            step()
        except DeviceError as error:
            failure = failure or error
    return failure


def _is_a(kind: Any, value: object) -> bool:
    """Whether a setting is of the type it is declared with; a whole number is a float, true is none."""
    if kind == Sequence[float]:
        return isinstance(value, Sequence) and all(_is_a(float, each) for each in value)
    return isinstance(value, (int, float) if kind is float else kind) and isinstance(value, bool) == (kind is bool)


def _float32_at_most(value: float) -> float:
    """The greatest number of 32 bits up to `value` (> 0)."""
    packed = struct.pack("<f", value)
    if struct.unpack("<f", packed)[0] > value:
        packed = struct.pack("<I", struct.unpack("<I", packed)[0] - 1)  # bits of positive numbers count like them
    return float(struct.unpack("<f", packed)[0])


def _near(asked: float, has: float) -> bool:
    """Numbers of 32 bits, and what a gripper may round."""
    return math.isclose(asked, has, rel_tol=0.01, abs_tol=0.01)
