"""The emulated WSG-50: its answers, motions and faults, by bytes written by hand."""

import struct

import pytest

from robot.drivers.wsg50.codec import Packet, decode, encode
from tests.emulators.wsg50.faults import LineFaults
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.emulators.wsg50.mechanics import Mechanics
from tests.wsg50_packets import bytes_of

MOVE, STOP, FAST_STOP, ACK, GRASP, RELEASE = 0x21, 0x22, 0x23, 0x24, 0x25, 0x26
IDLE, NO_PART, PART_LOST, HOLDING, ERROR = 0, 2, 3, 4, 7


class Hand:
    """An emulator without a port, whose clock advances only in `wait`."""

    def __init__(self, **settings):
        self.now = 0.0
        self.emulator = EmulatedWSG50(clock=lambda: self.now, **{"referenced": True} | settings)

    def send(self, command, payload=b""):
        """Send a command; return the status and parameters of its answer."""
        *_, answer = self.emulator.receive(Packet(command, payload))
        assert answer.id == command
        return struct.unpack_from("<H", answer.payload)[0], answer.payload[2:]

    def wait(self, seconds):
        """Advance the clock; return the packets sent meanwhile, as (id, status)."""
        packets = []
        for _ in range(round(seconds * 100)):
            self.now += 0.01
            packets += self.emulator.tick()
        return [(packet.id, struct.unpack_from("<H", packet.payload)[0]) for packet in packets]

    def to(self, command, width, speed=100.0):
        """Run a motion to a width and return the status of its result."""
        payload = struct.pack("<ff", width, speed)
        status, _ = self.send(command, b"\x02" + payload if command == MOVE else payload)
        if status != 26:
            return status
        ((own, result),) = self.wait(5)
        assert own == command
        return result

    def state(self):
        return self.send(0x41, bytes(3))[1][0]

    def flags(self):
        number = struct.unpack("<I", self.send(0x40, bytes(3))[1])[0]
        return {bit for bit in range(32) if number >> bit & 1}

    def value(self, command):
        return struct.unpack("<f", self.send(command, bytes(3))[1])[0]


def test_the_jaws_move_with_their_speed_and_acceleration():
    jaws = Mechanics(100.0)
    jaws.acceleration_mm_s2 = 1000.0
    jaws.go(40.0, 100.0)
    jaws.advance(0.1)
    assert jaws.speed_mm_s == pytest.approx(-100.0)  # 0.1 s at 1000 mm/s^2
    assert jaws.opening_mm == pytest.approx(95.0, abs=0.2)
    jaws.advance(0.5)
    assert jaws.opening_mm == pytest.approx(45.0, abs=0.4)  # and 0.5 s at 100 mm/s; then it brakes
    jaws.advance(0.3)
    assert (jaws.opening_mm, jaws.moves, jaws.speed_mm_s) == (pytest.approx(40.0), False, 0.0)


def test_an_object_stops_the_jaws_from_outside_and_not_from_within():
    jaws = Mechanics(100.0, object_mm=40.0)
    jaws.go(0.0, 100.0)
    jaws.advance(5)
    assert (jaws.opening_mm, jaws.blocked, jaws.moves) == (40.0, -1, False)
    jaws.go(60.0, 100.0)
    jaws.advance(5)
    assert (jaws.opening_mm, jaws.blocked) == (pytest.approx(60.0), 0)


def test_it_answers_commands_as_documented():
    hand = Hand()
    assert hand.send(0x06, b"abc") == (0, b"abc")
    assert hand.send(0x33) == (0, struct.pack("<f", 40))
    assert struct.unpack("<8f", hand.send(0x53)[1]) == (110, 5, 420, 100, 5000, 5, 80, 120)
    assert len(hand.send(0x50)[1]) == 8
    assert hand.send(0x90) == (14, b"")
    assert hand.send(0x25, bytes(7)) == (13, b"")
    assert hand.send(0x25, bytes(9)) == (15, b"")
    assert hand.send(0x22, b"\x00") == (12, b"")


def test_a_fast_stop_ends_only_with_an_acknowledgement():
    hand = Hand(opening_mm=100.0)
    assert hand.send(ACK, b"ack")[0] == 16  # nothing to acknowledge
    hand.send(MOVE, b"\x02" + struct.pack("<ff", 10, 50))
    assert hand.send(FAST_STOP)[0] == 0
    assert (hand.state(), 12 in hand.flags()) == (ERROR, True)
    assert hand.to(MOVE, 50.0) == 16
    assert hand.send(0x20, b"\x00")[0] == 16
    assert hand.send(ACK, b"nak")[0] == 24
    assert hand.send(ACK, b"ack")[0] == 0
    assert (hand.state(), 12 in hand.flags()) == (IDLE, False)


def test_values_outside_the_limits_are_refused():
    hand = Hand()
    assert [hand.send(0x32, struct.pack("<f", force))[0] for force in (4, 5, 80, 81)] == [28, 0, 0, 28]
    assert [hand.send(0x30, struct.pack("<f", each))[0] for each in (99, 100, 5000, 5001)] == [28, 0, 0, 28]
    assert hand.send(0x31) == (0, struct.pack("<f", 5000))
    assert [hand.to(MOVE, 60.0, speed) for speed in (4, 421)] == [28, 28]
    assert [hand.to(MOVE, width) for width in (-1, 111)] == [28, 28]
    assert hand.send(0x35)[0] == 1
    assert hand.send(0x34, struct.pack("<ff", 20, 90)) == (0, b"")
    assert hand.send(0x35) == (0, struct.pack("<ff", 20, 90))
    assert [hand.to(MOVE, width) for width in (19, 91, 50)] == [28, 28, 0]


def test_a_setting_during_a_motion_causes_a_fast_stop():
    hand = Hand(opening_mm=100.0)
    hand.send(MOVE, b"\x02" + struct.pack("<ff", 10, 50))
    assert hand.send(0x32, struct.pack("<f", 20))[0] == 16
    assert hand.emulator.in_fast_stop
    assert not hand.emulator.moves


def test_an_unannounced_disconnect_causes_a_fast_stop():
    hand = Hand()
    hand.emulator.connected()
    hand.send(0x07)
    hand.emulator.disconnected()
    assert not hand.emulator.in_fast_stop
    hand.emulator.connected()
    hand.emulator.disconnected()
    assert hand.emulator.in_fast_stop


@pytest.mark.parametrize("kind", LineFaults.KINDS)
def test_each_fault_changes_a_packet_as_named(kind):
    packet = decode(bytes_of("grasp 12 mm 34 mm/s"))[1]
    faults = LineFaults(1.0, [kind], delay_s=0.5)
    pieces = list(faults.on(packet))
    data = b"".join(piece.data or b"" for piece in pieces)
    good = encode(packet)
    assert faults.counts == {kind: 1}
    assert {
        "dropped": pieces == [],
        "duplicated": data == good + good,
        "corrupted": len(data) == len(good) and sum((a ^ b).bit_count() for a, b in zip(data, good, strict=False)) == 1,
        "delayed": [(piece.data, piece.pause_s) for piece in pieces] == [(good, 0.5)],
        "split": data == good and [piece.pause_s for piece in pieces] == [0, 0.5],
        "wrong id": (found := decode(data)[1]) and found.payload == packet.payload and found.id != packet.id,
        "disconnect": [piece.data for piece in pieces] == [None],
    }[kind]


def test_faults_occur_at_their_rate_and_are_reproducible():
    packet = Packet(STOP)
    runs = []
    for _ in range(2):
        faults = LineFaults(0.1, seed=3)
        runs.append([list(faults.on(packet)) for _ in range(2000)])
        assert 140 <= sum(faults.counts.values()) <= 260
    assert runs[0] == runs[1]
    assert not any(LineFaults().on(packet) is None for _ in range(5))
