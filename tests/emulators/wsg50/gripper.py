"""The behaviour of an emulated WSG-50 in time. It has no I/O: tests.emulators.wsg50.server provides ports.

It is based on the protocol (see robot.drivers.wsg50.codec) with its own packing and numbers, so that it and the driver
do not have the same misreadings. Both use the same framing and checksum, which are tested against printed packets.
If the protocol leaves behaviour open, the emulator does the least convenient thing: it denies what may be denied.
"""

import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence

from robot.drivers.wsg50.codec import Packet
from tests.emulators.wsg50.mechanics import STROKE_MM, Mechanics

# Numbers of the protocol: states, statuses, bits, limits, lengths of commands.
IDLE, GRASPING, NO_PART, PART_LOST, HOLDING, RELEASING, POSITIONING, ERROR = range(8)
OK, NOT_AVAILABLE, NOT_INITIALIZED, RUNNING, NO_PARAM, FEW_PARAMS, UNKNOWN = 0, 1, 3, 4, 12, 13, 14
FORMAT, DENIED, FAILED, ABORTED, INVALID, PENDING, RANGE, BLOCKED = 15, 16, 18, 19, 24, 26, 28, 29
FAULT_BITS = {
    "temperature warning": 13,
    "temperature": 14,
    "power": 15,
    "current": 16,
    "finger": 17,
    "command": 18,
    "script": 20,
}
UPDATES = frozenset({0x40, 0x41, 0x43, 0x45})
REFERENCED_BIT, MOVING_BIT, MINUS_BIT, PLUS_BIT = 0, 1, 2, 3
STOPPED_BIT, REACHED_BIT, FORCE_BIT, FAST_STOP_BIT = 6, 7, 9, 12
SPEEDS, ACCELERATIONS, FORCES = (5.0, 420.0), (100.0, 5000.0), (5.0, 80.0)
LENGTHS = {0x20: 1, 0x21: 9, 0x24: 3, 0x25: 8, 0x26: 8, 0x32: 4}

_HOMING_MM_S = 100.0
_CLAMPING_MM = 3.0
"""Clamping travel: the distance beyond the nominal width in which the fingers detect a part."""

Answer = int | bytes
"""A status without parameters, or the parameters of a success."""


class EmulatedWSG50:
    """A WSG-50. `receive` accepts a command, `tick` lets time pass; both return its packets in order. Thread-safe.

    Attributes:
        object_mm: Width of the rigid object between the jaws, or None. It can change at any time; a held part is then
            lost.
        speed_up: Factor by which its time runs faster than `clock`.
        keeps_force_n: A fixed force limit that ignores commands, or None.
        jammed: The jaws move and no motion ends.
        silent: It receives commands and sends nothing.
        mute_updates: It sends no automatic updates.
        next_status: Status by id that answers the next command of this id instead of its execution.
        received: Ids of the last commands.
        grasping: Grasping state of the protocol.
        force_limit_n: Force limit.
    """

    def __init__(
        self,
        *,
        object_mm: float | None = None,
        opening_mm: float = 50.0,
        referenced: bool = False,
        speed_up: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._lock = threading.RLock()
        self._jaws = Mechanics(opening_mm, object_mm)
        self.speed_up, self._clock = speed_up, clock
        self.jammed = self.silent = self.mute_updates = False
        self.next_status: dict[int, int] = {}
        self.keeps_force_n: float | None = None
        self.received: list[int] = []
        self.grasping, self._bits = IDLE, {REFERENCED_BIT} if referenced else set()
        self.force_limit_n = 40.0
        self._running: tuple[int, Callable[[], int | None]] | None = None
        self._updates: dict[int, tuple[float, float]] = {}
        """Period and next time (s) of each automatic update."""
        self._outgoing: list[Packet] = []
        self._announced = False
        self._now = clock()

    @property
    def object_mm(self) -> float | None:
        """Width of the object between the jaws, or None."""
        return self._jaws.object_mm

    @object_mm.setter
    def object_mm(self, width: float | None) -> None:
        with self._lock:
            self._jaws.object_mm = width

    @property
    def opening_mm(self) -> float:
        """Current opening of the jaws."""
        with self._lock:
            self._advance()
            return self._jaws.opening_mm

    @property
    def moves(self) -> bool:
        """Whether the jaws move."""
        with self._lock:
            self._advance()
            return self._jaws.moves

    @property
    def is_closing(self) -> bool:
        """Whether the jaws close for a grasp."""
        return self.moves and self.grasping == GRASPING

    @property
    def in_fast_stop(self) -> bool:
        """Whether it waits for an acknowledgement."""
        return FAST_STOP_BIT in self._bits

    def warn(self, fault: str) -> None:
        """Set only the flag of a fault of FAULT_BITS."""
        with self._lock:
            self._bits.add(FAULT_BITS[fault])

    def fail(self, fault: str | None = None) -> None:
        """Raise a FAST STOP and set the flag of a fault of FAULT_BITS."""
        with self._lock:
            self._bits |= {FAST_STOP_BIT} | ({FAULT_BITS[fault]} if fault else set())
            self._stand()
            self.grasping = ERROR

    def lose_reference(self) -> None:
        """Require homing, as after a loss of power."""
        with self._lock:
            self._bits.discard(REFERENCED_BIT)

    def connected(self) -> None:
        """Handle a new client."""
        with self._lock:
            self._announced = False
            self._updates.clear()

    def disconnected(self) -> None:
        """Handle the loss of the client: a FAST STOP, unless the client announced it."""
        with self._lock:
            self._updates.clear()
            if not self._announced:
                self.fail()
            self._outgoing.clear()

    def receive(self, packet: Packet) -> list[Packet]:
        """Execute a command and return the immediate answers."""
        with self._lock:
            self._advance()
            self.received.append(packet.id)
            forced = self.next_status.pop(packet.id, None)
            answer = self._answer(packet.id, packet.payload) if forced is None else forced
            self._outgoing.append(
                Packet(packet.id, _status(answer) if isinstance(answer, int) else _status(OK) + answer)
            )
            return self._take_packets()

    def tick(self) -> list[Packet]:
        """Let time pass up to now; return results of motions and automatic updates."""
        with self._lock:
            self._advance()
            self._outgoing += self._ended()
            for command, (period_s, next_s) in self._updates.items():
                if self._now >= next_s:
                    self._updates[command] = period_s, max(next_s + period_s, self._now)
                    if not self.mute_updates:
                        self._outgoing.append(Packet(command, _status(OK) + self._value(command)))
            return self._take_packets()

    def _take_packets(self) -> list[Packet]:
        packets, self._outgoing = self._outgoing, []
        return [] if self.silent else packets

    def _stand(self) -> None:
        """Stop immediately; a running motion is answered as aborted."""
        self._jaws.stand()
        self._bits.discard(FORCE_BIT)
        if self._running:
            self._outgoing.append(Packet(self._running[0], _status(ABORTED)))
            self._running = None

    def _advance(self) -> None:
        now = self._clock()
        passed, self._now = now - self._now, now
        if not self.jammed:
            self._jaws.advance(passed * self.speed_up)

    def _ended(self) -> Iterator[Packet]:
        """Yield the result of an ended motion; detect the loss of a held part."""
        if self._running and (status := self._running[1]()) is not None:
            command, self._running = self._running[0], None
            yield Packet(command, _status(status))
        if self.grasping == HOLDING and (self.object_mm or 0.0) < self._jaws.opening_mm - 0.1:
            self.grasping = PART_LOST
            self._bits.discard(FORCE_BIT)

    def _answer(self, command: int, payload: bytes) -> Answer:
        if command not in _ACTIONS and command not in UPDATES:
            return UNKNOWN
        expected = 3 if command in UPDATES else LENGTHS.get(command, 0)
        if command != 0x06 and len(payload) != expected:
            return FEW_PARAMS if len(payload) < expected else FORMAT if expected else NO_PARAM
        return self._update(command, payload) if command in UPDATES else _ACTIONS[command](self, payload)

    def _update(self, command: int, payload: bytes) -> Answer:
        """Start or stop automatic updates: flags u8, period u16 (ms)."""
        flags, period_s = payload[0], (payload[1] | payload[2] << 8) / 1000
        self._updates.pop(command, None)
        if flags > 1 or (flags and not period_s):
            return RANGE
        if flags:
            self._updates[command] = period_s, self._now + period_s
        return self._value(command)

    def _value(self, command: int) -> bytes:
        if command == 0x40:
            return struct.pack("<I", sum(1 << bit for bit in self._flags()))
        if command == 0x41:
            return bytes([self.grasping])
        force = self.force_limit_n if self.grasping == HOLDING else 0.0
        return struct.pack("<f", self._jaws.opening_mm if command == 0x43 else force)

    def _flags(self) -> set[int]:
        states = {
            MOVING_BIT: self._jaws.moves,
            MINUS_BIT: self._jaws.blocked < 0,
            PLUS_BIT: self._jaws.blocked > 0,
        }
        return self._bits | {bit for bit, is_set in states.items() if is_set}

    def _begin(self, command: int, state: int, to_mm: float, speed: float, ended: Callable[[], int | None]) -> int:
        self._bits -= {STOPPED_BIT, REACHED_BIT, FORCE_BIT}
        self.grasping, self._running = state, (command, ended)
        self._jaws.go(to_mm, speed)
        return PENDING

    def _refusal(self, states: Sequence[int], width: float, speed: float) -> int | None:
        """Return the status that refuses a motion now, or None."""
        if FAST_STOP_BIT in self._bits:
            return DENIED
        if self._running:
            return RUNNING
        if REFERENCED_BIT not in self._bits:
            return NOT_INITIALIZED
        if self.grasping not in states:
            return DENIED
        return None if 0.0 <= width <= STROKE_MM and SPEEDS[0] <= speed <= SPEEDS[1] else RANGE

    def _home(self, payload: bytes) -> Answer:
        if payload[0] > 2:
            return INVALID
        if FAST_STOP_BIT in self._bits or self._running:
            return DENIED if FAST_STOP_BIT in self._bits else RUNNING
        self._bits.discard(REFERENCED_BIT)

        def ended() -> int | None:
            if self._jaws.moves:
                return None
            self.grasping = IDLE
            if self._jaws.blocked:
                return BLOCKED
            self._bits |= {REFERENCED_BIT, REACHED_BIT}
            return OK

        return self._begin(0x20, POSITIONING, 0.0 if payload[0] == 2 else STROKE_MM, _HOMING_MM_S, ended)

    def _move(self, payload: bytes) -> Answer:
        flags, width, speed = struct.unpack("<Bff", payload)
        width += self._jaws.opening_mm if flags & 1 else 0.0
        if (refused := self._refusal((IDLE,), width, speed)) is not None:
            return refused
        return self._begin(0x21, POSITIONING, width, speed, self._arrived)

    def _arrived(self) -> int | None:
        if self._jaws.moves:
            return None
        self.grasping = IDLE
        if self._jaws.blocked:
            return BLOCKED
        self._bits.add(REACHED_BIT)
        return OK

    def _release(self, payload: bytes) -> Answer:
        width, speed = struct.unpack("<ff", payload)
        if (refused := self._refusal((NO_PART, PART_LOST, HOLDING), width, speed)) is not None:
            return refused
        return self._begin(0x26, RELEASING, width, speed, self._arrived)

    def _grasp(self, payload: bytes) -> Answer:
        width, speed = struct.unpack("<ff", payload)
        if (refused := self._refusal((IDLE,), width, speed)) is not None:
            return refused
        return self._begin(0x25, GRASPING, max(0.0, width - _CLAMPING_MM), speed, self._grasped)

    def _grasped(self) -> int | None:
        if self._jaws.moves:
            return None
        if self._jaws.blocked < 0:
            self.grasping = HOLDING
            self._bits.add(FORCE_BIT)
            return OK
        self.grasping = NO_PART
        return FAILED

    def _stop(self, _: bytes) -> Answer:
        self._stand()
        self._bits.add(STOPPED_BIT)
        self.grasping = self.grasping if self.grasping == ERROR else IDLE
        return OK

    def _fast_stop(self, _: bytes) -> Answer:
        self.fail()
        return OK

    def _acknowledge(self, payload: bytes) -> Answer:
        if payload != b"\x61\x63\x6b":
            return INVALID
        if FAST_STOP_BIT not in self._bits:
            return DENIED
        self._bits -= {FAST_STOP_BIT, *FAULT_BITS.values()}
        self.grasping = IDLE
        return OK

    def _announce(self, _: bytes) -> Answer:
        self._announced = True
        return OK

    def _set_force(self, payload: bytes) -> Answer:
        (value,) = struct.unpack("<f", payload)
        if self._jaws.moves:  # a change during a motion raises a FAST STOP
            self.fail()
            return DENIED
        if not FORCES[0] <= value <= FORCES[1]:
            return RANGE
        self.force_limit_n = value if self.keeps_force_n is None else self.keeps_force_n
        return OK


def _status(number: int) -> bytes:
    return struct.pack("<H", number)


_ACTIONS: dict[int, Callable[[EmulatedWSG50, bytes], Answer]] = {
    0x06: lambda _, payload: payload,
    0x07: EmulatedWSG50._announce,
    0x20: EmulatedWSG50._home,
    0x21: EmulatedWSG50._move,
    0x22: EmulatedWSG50._stop,
    0x23: EmulatedWSG50._fast_stop,
    0x24: EmulatedWSG50._acknowledge,
    0x25: EmulatedWSG50._grasp,
    0x26: EmulatedWSG50._release,
    0x31: lambda gripper, _: struct.pack("<f", gripper._jaws.acceleration_mm_s2),
    0x32: EmulatedWSG50._set_force,
    0x33: lambda gripper, _: struct.pack("<f", gripper.force_limit_n),
    0x50: lambda _, payload: struct.pack("<BBHI", 1, 6, 0x4000, 20260101),
    0x53: lambda _, payload: struct.pack("<8f", STROKE_MM, *SPEEDS, *ACCELERATIONS, *FORCES, 120.0),
}
