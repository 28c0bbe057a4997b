"""The WSG-50's packets byte by byte, and decoding of damaged, truncated and noisy streams."""

import contextlib
import itertools
import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.wsg50 import codec, commands
from robot.drivers.wsg50.codec import Packet, WireError, decode, encode
from robot.drivers.wsg50.commands import CommandId, GraspingState, Status, SystemState
from robot.errors import DeviceError
from tests.wsg50_packets import COMMANDS, MANUAL_REPLIES, PACKETS, bytes_of

BUILT = {
    "acknowledge": commands.acknowledge(),
    "disconnect": commands.packet(CommandId.DISCONNECT),
    "fast stop": commands.packet(CommandId.FAST_STOP),
    "stop": commands.packet(CommandId.STOP),
    "get force limit": commands.query(CommandId.GET_FORCE_LIMIT),
    "grasping state every 4E0Eh ms": commands.update(CommandId.GRASPING_STATE, 0x4E0E),
    "opening every 1234h ms": commands.update(CommandId.OPENING, 0x1234),
    "info": commands.query(CommandId.INFO),
    "grasp 12 mm 34 mm/s": commands.packet(CommandId.GRASP, 12.0, 34.0),
    "loop abc": Packet(CommandId.LOOP, b"abc"),
    "move to 34 mm at 56 mm/s, stop on block": commands.move(34.0, 56.0),
}

PARSERS = (
    "number",
    "soft_limits",
    "limits",
    "info",
    "system_state",
    "grasping_state",
)


def all_packets(stream):
    """Return every packet of a complete stream."""
    buffer, found = bytearray(stream), []
    while True:
        used, packet = decode(buffer)
        del buffer[:used]
        if packet is None:
            return found
        found.append(packet)


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


@pytest.mark.parametrize("name", PACKETS)
def test_a_packet_of_the_manual_is_encoded_and_decoded_exactly(name):
    text, command, payload = PACKETS[name]
    packet = Packet(command, bytes.fromhex(payload))
    assert encode(packet) == bytes.fromhex(text)
    assert decode(bytes.fromhex(text)) == (len(bytes.fromhex(text)), packet)


def test_every_command_of_the_public_tests_has_a_builder_with_the_same_bytes():
    assert set(BUILT) == set(COMMANDS)
    for name, packet in BUILT.items():
        assert encode(packet) == bytes_of(name), name


def test_the_checksum_of_a_packet_is_zero_and_that_of_the_preamble_50f5():
    assert codec.checksum(b"\xaa\xaa\xaa") == 0x50F5
    assert [codec.checksum(bytes_of(name)) for name in PACKETS] == [0] * len(PACKETS)


def test_the_checksum_is_not_the_textbook_ccitt():
    import binascii

    body = bytes_of("stop")[:-2]
    assert codec.checksum(body) == 0x760E
    assert binascii.crc_hqx(body, 0xFFFF) != 0x760E


def test_builders_without_a_documented_packet_follow_the_command_table():
    assert commands.home(2) == Packet(0x20, b"\x02")
    assert commands.packet(CommandId.RELEASE, 1.0, 2.0) == Packet(0x26, struct.pack("<ff", 1, 2))
    assert commands.packet(CommandId.SET_ACCELERATION, 150.0) == Packet(0x30, bytes.fromhex("00001643"))
    assert commands.packet(CommandId.SET_FORCE_LIMIT, 40.0) == Packet(0x32, struct.pack("<f", 40))
    assert commands.packet(CommandId.SET_SOFT_LIMITS, 5.0, 100.0) == Packet(0x34, struct.pack("<ff", 5, 100))
    assert commands.query(CommandId.OPENING) == Packet(0x43, b"\x00\x00\x00")
    assert commands.update(CommandId.FORCE, 20) == Packet(0x45, b"\x01\x14\x00")


def test_replies_are_parsed_as_documented():
    answers = [name for name in MANUAL_REPLIES if PACKETS[name][1] != 0x01]
    status = {name: commands.reply(decode(bytes_of(name))[1])[0] for name in answers}
    assert status == {
        "homing done": Status.SUCCESS,
        "unknown command 90h": Status.CMD_UNKNOWN,
        "acceleration 150": Status.SUCCESS,
        "move pending": Status.CMD_PENDING,
        "move done": Status.SUCCESS,
    }
    assert commands.number(commands.reply(decode(bytes_of("acceleration 150"))[1])[1]) == 150.0


def test_parsers_return_the_values_packed_by_hand():
    assert commands.system_state(struct.pack("<I", 0x1003)) == (
        SystemState.REFERENCED | SystemState.MOVING | SystemState.FAST_STOP
    )
    assert commands.grasping_state(b"\x04") is GraspingState.HOLDING
    assert commands.soft_limits(struct.pack("<ff", 5, 100)) == (5.0, 100.0)
    assert commands.info(struct.pack("<BBHI", 1, 6, 0x4000, 123456)) == commands.GripperInfo(1, 6, 0x4000, 123456)
    limits = commands.limits(struct.pack("<8f", 110, 5, 420, 100, 5000, 5, 80, 120))
    assert (limits.stroke_mm, limits.min_speed_mm_s, limits.max_force_n) == (110.0, 5.0, 80.0)


def test_every_status_and_bit_has_the_number_of_the_manual():
    assert [int(status) for status in Status] == list(range(31))
    assert [bit.bit_length() - 1 for bit in SystemState] == [*range(10), *range(12, 21)]
    assert [int(state) for state in GraspingState] == list(range(8))


@pytest.mark.parametrize(
    "misuse",
    [
        lambda: commands.reply(Packet(0x22, b"\x00")),
        lambda: commands.reply(Packet(0x22, b"\x63\x00")),
        lambda: commands.number(b"\x00\x00\x00"),
        lambda: commands.number(struct.pack("<f", math.nan)),
        lambda: commands.limits(bytes(31)),
        lambda: commands.info(bytes(9)),
        lambda: commands.system_state(bytes(5)),
        lambda: commands.grasping_state(b"\x08"),
        lambda: commands.soft_limits(bytes(4)),
        lambda: commands.home(3),
        lambda: commands.packet(CommandId.GRASP, math.nan, 1.0),
        lambda: commands.packet(CommandId.GRASP, 1e39, 1.0),
        lambda: commands.update(CommandId.INFO, 10),
        lambda: commands.update(CommandId.FORCE, 0),
        lambda: commands.update(CommandId.FORCE, 65536),
        lambda: Packet(0xAA),
        lambda: Packet(256),
        lambda: Packet(1, bytes(codec.MAX_PAYLOAD + 1)),
    ],
)
def test_invalid_values_are_wire_errors(misuse):
    with pytest.raises(WireError) as caught:
        misuse()
    assert isinstance(caught.value, DeviceError)


def test_a_stream_gives_the_same_packets_in_one_two_or_many_pieces():
    stream = b"".join(bytes_of(name) for name in PACKETS)
    expected = [Packet(command, bytes.fromhex(payload)) for _, command, payload in PACKETS.values()]
    assert all_packets(stream) == expected
    assert fed([stream[: len(stream) // 2], stream[len(stream) // 2 :]]) == expected
    assert fed([stream[at : at + 1] for at in range(len(stream))]) == expected


@pytest.mark.parametrize("name", PACKETS)
def test_a_packet_truncated_at_any_length_is_incomplete(name):
    whole = bytes_of(name)
    for length in range(len(whole)):
        used, packet = decode(whole[:length])
        assert (used, packet) == (0, None)


@pytest.mark.parametrize(
    "noise", [b"\x00", b"\xaa", b"\xaa\xaa", b"\xaa\xaa\xaa", b"\xaa\xaa\x00", b"\xaa" * 9, b"hello"]
)
@pytest.mark.parametrize("name", PACKETS)
def test_noise_before_and_between_packets_loses_none(name, noise):
    packet = decode(bytes_of(name))[1]
    stream = noise + bytes_of(name) + noise + bytes_of(name)
    assert all_packets(stream) == [packet, packet]
    assert fed([stream[at : at + 1] for at in range(len(stream))]) == [packet, packet]


def test_the_three_aa_must_be_consecutive():
    """Public drivers count any three AA, so that AA 00 AA AA begins a packet."""
    spread = b"\xaa\x00\xaa\xaa" + bytes_of("stop")[3:]
    assert all_packets(spread + bytes_of("info")) == [Packet(0x50)]


@pytest.mark.parametrize(
    "payload", [b"\xaa\xaa\xaa", b"\xaa" * 7, b"x\xaa\xaa\xaa\x22\x00\x00", b"\xaa\xaa\xaa\xaa\x06"]
)
def test_a_preamble_inside_a_payload_splits_no_packet(payload):
    packet = Packet(CommandId.LOOP, payload)
    stream = encode(packet) + encode(packet)
    assert len(stream.split(codec.PREAMBLE)) > 3  # a public driver splits at each preamble
    assert all_packets(stream) == [packet, packet]
    assert fed([stream[at : at + 1] for at in range(len(stream))]) == [packet, packet]


def test_a_packet_inside_a_payload_is_not_a_packet_of_the_stream():
    packet = Packet(CommandId.LOOP, bytes_of("fast stop"))
    assert all_packets(encode(packet)) == [packet]


@pytest.mark.parametrize("name", PACKETS)
def test_a_packet_with_any_bit_flipped_loses_no_packet_after_it(name):
    good = bytes_of(name)
    after = Packet(CommandId.LOOP, bytes(range(16)))
    close = bytes(codec.MAX_PAYLOAD)  # a flipped length may claim this many bytes more
    for bit in range(8 * len(good)):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        found = all_packets(bytes(bad) + encode(after) + close)
        assert found[-1:] == [after]
        assert decode(good)[1] not in found[:-1]


def test_a_valid_packet_that_begins_inside_a_damaged_one_is_found():
    damaged = bytes_of("grasp 12 mm 34 mm/s")[:9]  # truncated: its length claims the beginning of the next
    assert all_packets(damaged + bytes_of("stop") + bytes_of("info")) == [Packet(0x22), Packet(0x50)]


def test_a_length_above_the_largest_payload_is_noise_at_once():
    claim = b"\xaa\xaa\xaa\x06" + struct.pack("<H", codec.MAX_PAYLOAD + 1)
    assert all_packets(claim + bytes_of("stop")) == [Packet(0x22)]
    waits = b"\xaa\xaa\xaa\x06" + struct.pack("<H", codec.MAX_PAYLOAD)
    assert decode(waits + bytes_of("stop")) == (0, None)
    assert all_packets((waits + bytes_of("stop"))[1:]) == [Packet(0x22)]  # as a caller does when no more bytes arrive


@given(st.binary(max_size=80), st.integers(0, 255).filter(lambda number: number != 0xAA), st.binary(max_size=64))
def test_every_encoded_packet_is_decoded(noise, command, payload):
    packet = Packet(command, payload)
    assert decode(encode(packet)) == (len(encode(packet)), packet)
    assert packet in all_packets(noise + encode(packet) + bytes(codec.MAX_PAYLOAD + 8))


@given(st.lists(st.binary(max_size=30), max_size=6))
def test_the_pieces_of_a_stream_do_not_matter(chunks):
    assert fed(chunks) == all_packets(b"".join(chunks))


def fuzzed(seed):
    """Return a million bytes rich in AA, 00 and 01 with 2000 inserted packets, and the offsets of these."""
    rng = np.random.default_rng(seed)
    alphabet = np.array([0xAA] * 6 + [0x00] * 4 + [0x01] + list(range(2, 7)), np.uint8)
    noise = rng.choice(alphabet, 1_000_000).tobytes()
    stream, inserted, before = bytearray(), {}, 0
    for cut, name in zip(np.sort(rng.choice(len(noise), 2000, replace=False)), itertools.cycle(PACKETS), strict=False):
        stream += noise[before:cut]
        inserted[len(stream)] = name
        stream += bytes_of(name)
        before = cut
    return stream + noise[before:] + bytes(codec.MAX_PAYLOAD + 8), inserted


def places(stream):
    """Return the decoded packets by offset."""
    buffer, found, at = bytearray(stream), {}, 0
    while True:
        used, packet = decode(buffer)
        if packet is None:
            return found
        found[at + used - len(encode(packet))] = packet
        at += used
        del buffer[:used]


def test_a_packet_in_a_million_fuzzed_bytes_is_lost_only_inside_noise_that_is_a_valid_packet():
    """Noise is a valid packet if it has a preamble, a length that reaches past the inserted packet and a checksum
    that matches, with probability 1 / 65536. No other packet is lost.
    """
    stream, inserted = fuzzed(0)
    found = places(stream)
    lost = {at for at in inserted if at not in found}
    inside = {at for start, packet in found.items() for at in range(start + 1, start + len(encode(packet)))}
    swallowed = inside & set(inserted)
    assert lost == swallowed
    assert len(lost) <= 2
    assert all(found[at] == decode(bytes_of(name))[1] for at, name in inserted.items() if at in found)
    assert fed([stream[at : at + 997] for at in range(0, len(stream), 997)]) == list(found.values())


def test_payloads_of_noise_are_parsed_or_are_wire_errors():
    parsers = [getattr(commands, name) for name in PARSERS]
    for payload in (np.random.default_rng(size).bytes(size) for size in range(40) for _ in range(5)):
        for parse in parsers:
            with contextlib.suppress(WireError):
                parse(payload)
        with contextlib.suppress(WireError):
            commands.reply(Packet(0x40, payload))


class Counted(tuple):
    """The table of the checksum, which counts its accesses."""

    count = 0

    def __getitem__(self, index):
        type(self).count += 1
        return super().__getitem__(index)


@pytest.mark.parametrize("truncated", ["aa aa aa 06 ff 00", "aa aa aa 06 00 01", "aa aa aa 06 ff 00 55"])
def test_each_byte_of_truncated_packets_enters_the_checksum_once(truncated, monkeypatch):
    """A checksum packet by packet would read each byte once for every packet that claims it, 40 times here."""
    stream = bytes.fromhex(truncated) * 500
    monkeypatch.setattr(codec, "_TABLE", Counted(codec._TABLE))
    Counted.count = 0
    used, packet = decode(stream)
    assert packet is None
    assert used > len(stream) - 265  # all but a possible packet
    assert Counted.count <= len(stream)


@given(st.binary(max_size=600), st.data())
def test_the_checksum_of_a_range_is_that_of_its_bytes_alone(data, draw):
    first = draw.draw(st.integers(0, len(data)))
    sums = codec._PrefixChecksums(data, first)
    for _ in range(3):
        start = draw.draw(st.integers(first, len(data)))
        stop = draw.draw(st.integers(start, min(len(data), start + 264)))
        assert sums.checksum_of(start, stop) == codec.checksum(data[start:stop])
