"""The WSG-50's packets byte by byte, and decoding of damaged, truncated and noisy streams."""

import math
import struct

import pytest

from robot.drivers.wsg50 import codec
from robot.drivers.wsg50.codec import CommandId, GraspingState, Packet, Status, SystemState, WireError, decode, encode

PACKETS = {  # from the gripper's manual and from the tests of a public driver: bytes, packet
    "AA AA AA 01 00 00 E8 10": Packet(0x01),
    "AA AA AA 01 02 00 12 34 6D 66": Packet(0x01, b"\x12\x34"),
    "AA AA AA 20 02 00 00 00 B3 FD": Packet(0x20, b"\x00\x00"),
    "AA AA AA 90 02 00 0E 00 FD 02": Packet(0x90, b"\x0e\x00"),
    "AA AA AA 30 06 00 00 00 00 00 16 43 DC CB": Packet(0x30, bytes.fromhex("00 00 00 00 16 43")),
    "AA AA AA 21 02 00 1A 00 67 CB": Packet(0x21, b"\x1a\x00"),
    "AA AA AA 24 03 00 61 63 6B DC B9": codec.ACKNOWLEDGE,
    "AA AA AA 07 00 00 35 4C": codec.command(CommandId.DISCONNECT),
    "AA AA AA 23 00 00 AC 1C": codec.command(CommandId.FAST_STOP),
    "AA AA AA 22 00 00 0E 76": codec.command(CommandId.STOP),
    "AA AA AA 33 00 00 2C 70": codec.query(CommandId.GET_FORCE_LIMIT),
    "AA AA AA 41 03 00 01 0E 4E 15 B9": codec.update(CommandId.GRASPING_STATE, 0x4E0E),
    "AA AA AA 43 03 00 01 34 12 85 F3": codec.update(CommandId.OPENING, 0x1234),
    "AA AA AA 50 00 00 DB 87": codec.query(CommandId.INFO),
    "AA AA AA 25 08 00 00 00 40 41 00 00 08 42 A7 F1": codec.command(CommandId.GRASP, 12.0, 34.0),
    "AA AA AA 06 03 00 61 62 63 CA 44": Packet(CommandId.LOOP, b"abc"),
    "AA AA AA 21 09 00 02 00 00 08 42 00 00 60 42 95 56": codec.move(34.0, 56.0),
}
STOP, INFO = encode(Packet(0x22)), encode(Packet(0x50))
GRASP = encode(codec.command(CommandId.GRASP, 12.0, 34.0))


def fed(*chunks):
    """Return every packet of a stream that arrives in pieces."""
    buffer, found = bytearray(), []
    for chunk in chunks:
        buffer += chunk
        while True:
            used, packet = decode(buffer)
            del buffer[:used]
            if packet is None:
                break
            found.append(packet)
    return found


def in_pieces(stream):
    """Return the packets of a stream that arrives whole, in halves or byte by byte; they must be the same."""
    whole = fed(stream)
    assert fed(stream[: len(stream) // 2], stream[len(stream) // 2 :]) == whole
    assert fed(*(stream[at : at + 1] for at in range(len(stream)))) == whole
    return whole


@pytest.mark.parametrize("text", PACKETS)
def test_a_documented_packet_is_encoded_decoded_and_incomplete_at_every_shorter_length(text):
    whole, packet = bytes.fromhex(text), PACKETS[text]
    assert encode(packet) == whole
    assert decode(whole) == (len(whole), packet)
    for length in range(len(whole)):
        assert decode(whole[:length]) == (0, None)


def test_replies_and_their_parameters_are_parsed_as_documented():
    assert codec.reply(Packet(0x30, bytes.fromhex("00 00 00 00 16 43"))) == (Status.SUCCESS, struct.pack("<f", 150))
    assert codec.reply(Packet(0x90, b"\x0e\x00")) == (Status.CMD_UNKNOWN, b"")
    assert codec.reply(Packet(0x21, b"\x1a\x00")) == (Status.CMD_PENDING, b"")
    assert codec.number(struct.pack("<f", 150)) == 150.0
    state = codec.system_state(struct.pack("<I", 0x11003))
    assert state == (SystemState.REFERENCED | SystemState.MOVING | SystemState.FAST_STOP | SystemState.CURRENT_FAULT)
    assert state.faults == "current fault"
    assert codec.grasping_state(b"\x04") is GraspingState.HOLDING
    assert codec.info(struct.pack("<BBHI", 1, 6, 0x4000, 123456))["serial"] == 123456
    limits = codec.limits(struct.pack("<8f", 110, 5, 420, 100, 5000, 5, 80, 120))
    assert (limits.stroke_mm, limits.min_speed_mm_s, limits.max_force_n) == (110.0, 5.0, 80.0)
    assert (len(Status), Status.CHECKSUM_ERROR, Status.AXIS_BLOCKED) == (31, 11, 29)
    assert [bit.bit_length() - 1 for bit in SystemState] == [0, 1, *range(12, 19), 20]
    assert (GraspingState.NO_PART, GraspingState.ERROR) == (2, 7)


@pytest.mark.parametrize(
    "misuse",
    [
        lambda: codec.reply(Packet(0x22, b"\x00")),
        lambda: codec.number(struct.pack("<f", math.nan)),
        lambda: codec.grasping_state(b"\x08"),
    ],
)
def test_invalid_values_are_wire_errors(misuse):
    with pytest.raises(WireError):
        misuse()


@pytest.mark.parametrize("noise", [b"", b"\x00", b"\xaa", b"\xaa\xaa\xaa", b"\xaa\xaa\x00", b"\xaa" * 9])
def test_noise_between_packets_and_their_arrival_in_pieces_lose_none(noise):
    assert in_pieces(b"".join(noise + bytes.fromhex(text) for text in PACKETS)) == list(PACKETS.values())


@pytest.mark.parametrize("payload", [b"\xaa" * 7, b"x\xaa\xaa\xaa\x22\x00\x00", encode(Packet(0x23))])
def test_a_preamble_or_a_packet_inside_a_payload_splits_no_packet(payload):
    packet = Packet(CommandId.LOOP, payload)
    stream = 2 * encode(packet)
    assert len(stream.split(codec.PREAMBLE)) > 3  # a public driver splits at each preamble
    assert in_pieces(stream) == [packet, packet]


def test_the_packets_after_a_damaged_or_truncated_one_are_found():
    close = bytes(codec.MAX_PAYLOAD)  # a flipped length may claim this many bytes more
    for bit in range(8 * len(GRASP)):
        bad = bytearray(GRASP)
        bad[bit // 8] ^= 1 << bit % 8
        assert fed(bytes(bad) + INFO + close)[-1:] == [Packet(0x50)]
    for length in range(1, len(GRASP)):
        assert fed(GRASP[:length] + STOP + INFO) == [Packet(0x22), Packet(0x50)]
