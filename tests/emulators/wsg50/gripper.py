"""The behaviour of an emulated WSG-50 in time. It has no I/O: tests.emulators.wsg50.server provides ports.

It is based on the protocol (see robot.drivers.wsg50.codec) with its own packing and numbers, so that it and the driver
do not have the same misreadings. Both use the same framing and checksum, which are tested against printed packets.
If the protocol leaves behaviour open, the emulator does the least convenient thing: it denies what may be denied.
"""

import struct
import threading
import time

from robot.drivers.wsg50.codec import Packet

# Numbers of the protocol: states, statuses, bits, limits, lengths of commands.
IDLE, GRASPING, NO_PART, PART_LOST, HOLDING, RELEASING, POSITIONING, ERROR = range(8)
OK, NOT_INITIALIZED, RUNNING, UNKNOWN, FORMAT, DENIED, FAILED, ABORTED = 0, 3, 4, 14, 15, 16, 18, 19
INVALID, PENDING, RANGE, BLOCKED = 24, 26, 28, 29
FAULT_BITS = {"temperature": 14, "current": 16}
REFERENCED_BIT, MOVING_BIT, FAST_STOP_BIT = 0, 1, 12
UPDATES = frozenset({0x40, 0x41, 0x43, 0x45})
STROKE_MM, SPEEDS, ACCELERATIONS, FORCES = 110.0, (5.0, 420.0), (100.0, 5000.0), (5.0, 80.0)
LENGTHS = {0x20: 1, 0x21: 9, 0x24: 3, 0x25: 8, 0x26: 8, 0x32: 4} | dict.fromkeys(UPDATES, 3)

_HOMING_MM_S = 100.0
_CLAMPING_MM = 3.0
"""Clamping travel: the distance beyond the nominal width in which the fingers detect a part."""


class EmulatedWSG50:
    """A WSG-50. `receive` accepts a command, `tick` lets time pass; both return its packets in order. Thread-safe.

    Attributes:
        object_mm: Width of the rigid object between the jaws, or None. It can change at any time; a held part is then
            lost.
        speed_up: Factor by which its time runs faster.
        keeps_force_n: A fixed force limit that ignores commands, or None.
        jammed: The jaws move and no motion ends.
        ignores_stop: STOP is answered, but the jaws go on.
        silent: It receives commands and sends nothing.
        mute_updates: It sends no automatic updates.
        unknown_states: Number of times that it reports an unknown grasping state during a motion.
        next_status: Status by id that answers the next command of this id instead of its execution.
        received: Ids of the commands.
        grasping: Grasping state of the protocol.
    """

    def __init__(self, *, object_mm=None, opening_mm=50.0, referenced=False, speed_up=1.0):
        self._lock = threading.RLock()
        self.object_mm, self.speed_up = object_mm, speed_up
        self.jammed = self.ignores_stop = self.silent = self.mute_updates = False
        self.unknown_states = 0
        self.next_status, self.received, self.keeps_force_n, self.force_limit_n = {}, [], None, 40.0
        self.grasping, self._bits = IDLE, {REFERENCED_BIT} if referenced else set()
        self._opening_mm, self._target_mm, self._speed_mm_s, self._blocked = opening_mm, None, 0.0, 0
        self._running = None  # (id, function that returns the status of the ended motion)
        self._updates = {}  # id -> period and next time (s)
        self._outgoing, self._announced, self._now = [], False, time.monotonic()

    @property
    def opening_mm(self):
        with self._lock:
            self._advance()
            return self._opening_mm

    @property
    def moves(self):
        with self._lock:
            self._advance()
            return self._target_mm is not None

    @property
    def in_fast_stop(self):
        """Whether it waits for an acknowledgement."""
        return FAST_STOP_BIT in self._bits

    def fail(self, fault=None):
        """Raise a FAST STOP and set the flag of a fault of FAULT_BITS."""
        with self._lock:
            self._bits |= {FAST_STOP_BIT} | ({FAULT_BITS[fault]} if fault else set())
            self._stand()
            self.grasping = ERROR

    def lose_reference(self):
        with self._lock:
            self._bits.discard(REFERENCED_BIT)

    def connected(self):
        with self._lock:
            self._announced = False
            self._updates.clear()

    def disconnected(self):
        """Handle the loss of the client: a FAST STOP, unless the client announced it."""
        with self._lock:
            self._updates.clear()
            if not self._announced:
                self.fail()
            self._outgoing.clear()

    def receive(self, packet):
        with self._lock:
            self._advance()
            self.received.append(packet.id)
            forced = self.next_status.pop(packet.id, None)
            self._send(packet.id, self._answer(packet.id, packet.payload) if forced is None else forced)
            return self._take_packets()

    def tick(self):
        """Let time pass up to now; return results of motions and automatic updates."""
        with self._lock:
            self._advance()
            self._end_motion()
            for command, (period_s, next_s) in self._updates.items():
                if self._now >= next_s:
                    self._updates[command] = period_s, max(next_s + period_s, self._now)
                    if not self.mute_updates:
                        self._send(command, self._value(command))
            return self._take_packets()

    def _send(self, command, answer):
        """Send a status without parameters, or the parameters of a success."""
        status, parameters = (answer, b"") if isinstance(answer, int) else (OK, answer)
        self._outgoing.append(Packet(command, struct.pack("<H", status) + parameters))

    def _take_packets(self):
        packets, self._outgoing = self._outgoing, []
        return [] if self.silent else packets

    # Jaws: constant speed; they stop at once at the target, at an object or at the end of the stroke.

    def _stand(self):
        """Stop at once; a running motion is answered as aborted."""
        self._target_mm = None
        if self._running:
            self._send(self._running[0], ABORTED)
            self._running = None

    def _advance(self):
        now = time.monotonic()
        passed, self._now = (now - self._now) * self.speed_up, now
        if self.jammed or self._target_mm is None:
            return
        way = self._target_mm - self._opening_mm
        least = self.object_mm if self.object_mm is not None and self.object_mm <= self._opening_mm else 0.0
        arrives = abs(way) <= self._speed_mm_s * passed
        moved = self._target_mm if arrives else self._opening_mm + self._speed_mm_s * passed * (1 if way > 0 else -1)
        self._opening_mm = min(max(moved, least), STROKE_MM)
        self._blocked = (moved > STROKE_MM) - (moved < least)
        if arrives or self._blocked:
            self._target_mm = None

    def _end_motion(self):
        """Send the result of an ended motion; detect the loss of a held part."""
        if self._running and self._target_mm is None:
            (command, ended), self._running = self._running, None
            self._send(command, ended())
        if self.grasping == HOLDING and (self.object_mm or 0.0) < self._opening_mm - 0.1:
            self.grasping = PART_LOST

    # Commands.

    def _answer(self, command, payload):
        if command != 0x06 and len(payload) != LENGTHS.get(command, 0):
            return FORMAT
        if command in UPDATES:
            return self._update(command, *struct.unpack("<BH", payload))
        return _ACTIONS[command](self, payload) if command in _ACTIONS else UNKNOWN

    def _update(self, command, flags, period_ms):
        self._updates.pop(command, None)
        if flags:
            self._updates[command] = period_ms / 1000, self._now + period_ms / 1000
        return self._value(command)

    def _value(self, command):
        if command == 0x40:
            bits = self._bits | ({MOVING_BIT} if self._target_mm is not None else set())
            return struct.pack("<I", sum(1 << bit for bit in bits))
        if command == 0x41:
            if self.unknown_states and self._target_mm is not None:
                self.unknown_states -= 1
                return b"\x09"
            return bytes([self.grasping])
        force = self.force_limit_n if self.grasping == HOLDING else 0.0
        return struct.pack("<f", self._opening_mm if command == 0x43 else force)

    def _begin(self, command, state, to_mm, speed, ended):
        self.grasping, self._running = state, (command, ended)
        self._target_mm, self._speed_mm_s, self._blocked = to_mm, speed, 0
        return PENDING

    def _refusal(self, states, width, speed):
        """Return the status that refuses a motion now, or None."""
        if self.in_fast_stop:
            return DENIED
        if self._running:
            return RUNNING
        if REFERENCED_BIT not in self._bits:
            return NOT_INITIALIZED
        if self.grasping not in states:
            return DENIED
        return None if 0.0 <= width <= STROKE_MM and SPEEDS[0] <= speed <= SPEEDS[1] else RANGE

    def _home(self, _):
        if self.in_fast_stop or self._running:
            return DENIED if self.in_fast_stop else RUNNING
        self._bits.discard(REFERENCED_BIT)

        def ended():
            status = self._arrived()
            self._bits |= set() if status else {REFERENCED_BIT}
            return status

        return self._begin(0x20, POSITIONING, STROKE_MM, _HOMING_MM_S, ended)

    def _arrived(self):
        self.grasping = IDLE
        return BLOCKED if self._blocked else OK

    def _move(self, payload):
        _, width, speed = struct.unpack("<Bff", payload)  # the width is absolute
        return self._refusal((IDLE,), width, speed) or self._begin(0x21, POSITIONING, width, speed, self._arrived)

    def _release(self, payload):
        width, speed = struct.unpack("<ff", payload)
        refused = self._refusal((NO_PART, PART_LOST, HOLDING), width, speed)
        return refused or self._begin(0x26, RELEASING, width, speed, self._arrived)

    def _grasp(self, payload):
        width, speed = struct.unpack("<ff", payload)
        to_mm = max(0.0, width - _CLAMPING_MM)
        return self._refusal((IDLE,), width, speed) or self._begin(0x25, GRASPING, to_mm, speed, self._grasped)

    def _grasped(self):
        self.grasping = HOLDING if self._blocked < 0 else NO_PART
        return OK if self._blocked < 0 else FAILED

    def _stop(self, _):
        if not self.ignores_stop:
            self._stand()
            self.grasping = self.grasping if self.grasping == ERROR else IDLE
        return OK

    def _fast_stop(self, _):
        self.fail()
        return OK

    def _acknowledge(self, payload):
        if payload != b"\x61\x63\x6b":
            return INVALID
        if not self.in_fast_stop:
            return DENIED
        self._bits -= {FAST_STOP_BIT, *FAULT_BITS.values()}
        self.grasping = IDLE
        return OK

    def _announce(self, _):
        self._announced = True
        return OK

    def _set_force(self, payload):
        (value,) = struct.unpack("<f", payload)
        if self._target_mm is not None:  # a change during a motion raises a FAST STOP
            self.fail()
            return DENIED
        if not FORCES[0] <= value <= FORCES[1]:
            return RANGE
        self.force_limit_n = value if self.keeps_force_n is None else self.keeps_force_n
        return OK


_ACTIONS = {
    0x06: lambda _, payload: payload,
    0x07: EmulatedWSG50._announce,
    0x20: EmulatedWSG50._home,
    0x21: EmulatedWSG50._move,
    0x22: EmulatedWSG50._stop,
    0x23: EmulatedWSG50._fast_stop,
    0x24: EmulatedWSG50._acknowledge,
    0x25: EmulatedWSG50._grasp,
    0x26: EmulatedWSG50._release,
    0x32: EmulatedWSG50._set_force,
    0x33: lambda gripper, _: struct.pack("<f", gripper.force_limit_n),
    0x50: lambda _, payload: struct.pack("<BBHI", 1, 6, 0x4000, 20260101),
    0x53: lambda _, payload: struct.pack("<8f", STROKE_MM, *SPEEDS, *ACCELERATIONS, *FORCES, 120.0),
}
