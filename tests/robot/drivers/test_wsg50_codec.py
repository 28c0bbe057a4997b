"""The WSG-50's packets byte by byte, and decoding of damaged, truncated and noisy streams."""

import binascii
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.wsg50 import codec
from robot.drivers.wsg50.codec import (
    CommandId,
    GraspingState,
    Packet,
    Status,
    SystemState,
    WireError,
    decode,
    encode,
)
from tests.wsg50_packets import COMMANDS, MANUAL_REPLIES, PACKETS, bytes_of

BUILT = {
    "acknowledge": codec.acknowledge(),
    "disconnect": codec.command(CommandId.DISCONNECT),
    "fast stop": codec.command(CommandId.FAST_STOP),
    "stop": codec.command(CommandId.STOP),
    "get force limit": codec.query(CommandId.GET_FORCE_LIMIT),
    "grasping state every 4E0Eh ms": codec.update(CommandId.GRASPING_STATE, 0x4E0E),
    "opening every 1234h ms": codec.update(CommandId.OPENING, 0x1234),
    "info": codec.query(CommandId.INFO),
    "grasp 12 mm 34 mm/s": codec.command(CommandId.GRASP, 12.0, 34.0),
    "loop abc": Packet(CommandId.LOOP, b"abc"),
    "move to 34 mm at 56 mm/s, stop on block": codec.move(34.0, 56.0),
}
PARSERS = (codec.number, codec.limits, codec.info, codec.system_state, codec.grasping_state)


def fed(chunks):
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


def byte_by_byte(stream):
    return fed(stream[at : at + 1] for at in range(len(stream)))


@pytest.mark.parametrize("name", PACKETS)
def test_a_documented_packet_is_encoded_decoded_and_incomplete_at_every_shorter_length(name):
    text, command, payload = PACKETS[name]
    whole, packet = bytes.fromhex(text), Packet(command, bytes.fromhex(payload))
    assert encode(packet) == whole
    assert decode(whole) == (len(whole), packet)
    assert codec.checksum(whole) == 0
    for length in range(len(whole)):
        assert decode(whole[:length]) == (0, None)


def test_every_command_of_the_public_tests_has_a_builder_with_the_same_bytes():
    assert {name: encode(packet) for name, packet in BUILT.items()} == {name: bytes_of(name) for name in COMMANDS}


def test_builders_without_a_documented_packet_follow_the_command_table():
    assert codec.home() == Packet(0x20, b"\x00")
    assert codec.command(CommandId.RELEASE, 1.0, 2.0) == Packet(0x26, struct.pack("<ff", 1, 2))
    assert codec.command(CommandId.SET_FORCE_LIMIT, 40.0) == Packet(0x32, struct.pack("<f", 40))
    assert codec.query(CommandId.OPENING) == Packet(0x43, b"\x00\x00\x00")
    assert codec.update(CommandId.FORCE, 20) == Packet(0x45, b"\x01\x14\x00")


def test_the_checksum_is_not_the_textbook_ccitt():
    body = bytes_of("stop")[:-2]
    assert codec.checksum(codec.PREAMBLE) == 0x50F5
    assert codec.checksum(body) == 0x760E
    assert binascii.crc_hqx(body, 0xFFFF) != 0x760E


def test_replies_and_their_parameters_are_parsed_as_documented():
    answers = {name: codec.reply(decode(bytes_of(name))[1]) for name in MANUAL_REPLIES if PACKETS[name][1] != 0x01}
    assert {name: status for name, (status, _) in answers.items()} == {
        "homing done": Status.SUCCESS,
        "unknown command 90h": Status.CMD_UNKNOWN,
        "acceleration 150": Status.SUCCESS,
        "move pending": Status.CMD_PENDING,
        "move done": Status.SUCCESS,
    }
    assert codec.number(answers["acceleration 150"][1]) == 150.0
    assert codec.system_state(struct.pack("<I", 0x1003)) == (
        SystemState.REFERENCED | SystemState.MOVING | SystemState.FAST_STOP
    )
    assert codec.grasping_state(b"\x04") is GraspingState.HOLDING
    assert codec.info(struct.pack("<BBHI", 1, 6, 0x4000, 123456)) == {
        "kind": 1,
        "hardware": 6,
        "firmware": 0x4000,
        "serial": 123456,
    }
    limits = codec.limits(struct.pack("<8f", 110, 5, 420, 100, 5000, 5, 80, 120))
    assert (limits.stroke_mm, limits.min_speed_mm_s, limits.max_force_n) == (110.0, 5.0, 80.0)


def test_every_status_and_bit_has_the_number_of_the_manual():
    assert (len(Status), Status.CHECKSUM_ERROR, Status.CMD_PENDING, Status.AXIS_BLOCKED) == (31, 11, 26, 29)
    assert [bit.bit_length() - 1 for bit in SystemState] == [0, 1, *range(12, 19), 20]
    assert (GraspingState.NO_PART, GraspingState.HOLDING, GraspingState.ERROR) == (2, 4, 7)


@pytest.mark.parametrize(
    "misuse",
    [
        lambda: codec.reply(Packet(0x22, b"\x00")),
        lambda: codec.reply(Packet(0x22, b"\x63\x00")),
        lambda: codec.number(b"\x00\x00\x00"),
        lambda: codec.number(struct.pack("<f", math.nan)),
        lambda: codec.grasping_state(b"\x08"),
        lambda: codec.command(CommandId.GRASP, math.nan, 1.0),
        lambda: codec.command(CommandId.GRASP, 1e39, 1.0),
        lambda: Packet(0xAA),
        lambda: Packet(1, bytes(codec.MAX_PAYLOAD + 1)),
    ],
)
def test_invalid_values_are_wire_errors(misuse):
    with pytest.raises(WireError):
        misuse()


def test_a_stream_gives_the_same_packets_in_one_two_or_many_pieces():
    stream = b"".join(bytes_of(name) for name in PACKETS)
    expected = [Packet(command, bytes.fromhex(payload)) for _, command, payload in PACKETS.values()]
    assert fed([stream]) == expected
    assert fed([stream[: len(stream) // 2], stream[len(stream) // 2 :]]) == expected
    assert byte_by_byte(stream) == expected


@pytest.mark.parametrize("noise", [b"\x00", b"\xaa", b"\xaa\xaa\xaa", b"\xaa\xaa\x00", b"\xaa" * 9])
def test_noise_before_and_between_packets_loses_none(noise):
    packet = decode(bytes_of("stop"))[1]
    stream = noise + bytes_of("stop") + noise + bytes_of("stop")
    assert fed([stream]) == byte_by_byte(stream) == [packet, packet]


def test_the_three_aa_must_be_consecutive():
    """Public drivers count any three AA, so that AA 00 AA AA begins a packet."""
    assert fed([b"\xaa\x00\xaa\xaa" + bytes_of("stop")[3:] + bytes_of("info")]) == [Packet(0x50)]


@pytest.mark.parametrize("payload", [b"\xaa\xaa\xaa", b"\xaa" * 7, b"x\xaa\xaa\xaa\x22\x00\x00", bytes_of("fast stop")])
def test_a_preamble_or_a_packet_inside_a_payload_splits_no_packet(payload):
    packet = Packet(CommandId.LOOP, payload)
    stream = encode(packet) + encode(packet)
    assert len(stream.split(codec.PREAMBLE)) > 3  # a public driver splits at each preamble
    assert fed([stream]) == byte_by_byte(stream) == [packet, packet]


def test_a_packet_with_any_bit_flipped_loses_no_packet_after_it():
    good, after = bytes_of("grasp 12 mm 34 mm/s"), Packet(CommandId.LOOP, bytes(range(16)))
    close = bytes(codec.MAX_PAYLOAD)  # a flipped length may claim this many bytes more
    for bit in range(8 * len(good)):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        assert fed([bytes(bad) + encode(after) + close])[-1:] == [after]


@pytest.mark.parametrize("length", range(1, len(bytes_of("grasp 12 mm 34 mm/s"))))
def test_the_packets_after_a_truncated_one_are_found(length):
    stream = bytes_of("grasp 12 mm 34 mm/s")[:length] + bytes_of("stop") + bytes_of("info")
    assert fed([stream]) == [Packet(0x22), Packet(0x50)]


def test_a_length_above_the_largest_payload_is_noise_at_once():
    claim = b"\xaa\xaa\xaa\x06" + struct.pack("<H", codec.MAX_PAYLOAD + 1)
    assert fed([claim + bytes_of("stop")]) == [Packet(0x22)]
    waits = b"\xaa\xaa\xaa\x06" + struct.pack("<H", codec.MAX_PAYLOAD) + bytes_of("stop")
    assert decode(waits) == (0, None)
    assert fed([waits[1:]]) == [Packet(0x22)]  # as a caller does when no more bytes arrive


@given(st.binary(max_size=80), st.integers(0, 255).filter(lambda number: number != 0xAA), st.binary(max_size=64))
def test_every_encoded_packet_is_decoded(noise, command, payload):
    packet = Packet(command, payload)
    assert decode(encode(packet)) == (len(encode(packet)), packet)
    assert packet in fed([noise + encode(packet) + bytes(codec.MAX_PAYLOAD + 8)])
