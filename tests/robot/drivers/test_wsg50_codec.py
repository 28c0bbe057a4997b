"""The WSG-50's packets to the byte, and what is found in damaged, cut and noisy streams."""

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
    """Every packet of a stream that is there as a whole."""
    buffer, found = bytearray(stream), []
    while True:
        used, packet = decode(buffer)
        del buffer[:used]
        if packet is None:
            return found
        found.append(packet)


def fed(chunks):
    """Every packet of a stream that comes in pieces."""
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
def test_a_packet_of_the_manual_is_written_and_read_to_the_byte(name):
    text, command, payload = PACKETS[name]
    packet = Packet(command, bytes.fromhex(payload))
    assert encode(packet) == bytes.fromhex(text)
    assert decode(bytes.fromhex(text)) == (len(bytes.fromhex(text)), packet)


def test_every_command_of_the_public_tests_comes_out_of_its_builder():
    assert set(BUILT) == set(COMMANDS)
    for name, packet in BUILT.items():
        assert encode(packet) == bytes_of(name), name


def test_the_check_sum_runs_to_zero_over_a_packet_and_to_50f5_over_the_preamble():
    assert codec.checksum(b"\xaa\xaa\xaa") == 0x50F5
    assert [codec.checksum(bytes_of(name)) for name in PACKETS] == [0] * len(PACKETS)


def test_the_check_sum_is_not_the_textbook_ccitt():
    import binascii

    body = bytes_of("stop")[:-2]
    assert codec.checksum(body) == 0x760E
    assert binascii.crc_hqx(body, 0xFFFF) != 0x760E


def test_builders_without_a_printed_packet_pack_what_the_table_says():
    assert commands.home(2) == Packet(0x20, b"\x02")
    assert commands.packet(CommandId.RELEASE, 1.0, 2.0) == Packet(0x26, struct.pack("<ff", 1, 2))
    assert commands.packet(CommandId.SET_ACCELERATION, 150.0) == Packet(0x30, bytes.fromhex("00001643"))
    assert commands.packet(CommandId.SET_FORCE_LIMIT, 40.0) == Packet(0x32, struct.pack("<f", 40))
    assert commands.packet(CommandId.SET_SOFT_LIMITS, 5.0, 100.0) == Packet(0x34, struct.pack("<ff", 5, 100))
    assert commands.query(CommandId.OPENING) == Packet(0x43, b"\x00\x00\x00")
    assert commands.update(CommandId.FORCE, 20) == Packet(0x45, b"\x01\x14\x00")


def test_replies_mean_what_the_manual_says():
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


def test_parsers_read_what_was_packed_by_hand():
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
def test_what_cannot_be_is_the_codecs_own_error(misuse):
    with pytest.raises(WireError) as caught:
        misuse()
    assert isinstance(caught.value, DeviceError)


def test_a_stream_is_the_same_whole_halved_and_byte_by_byte():
    stream = b"".join(bytes_of(name) for name in PACKETS)
    want = [Packet(command, bytes.fromhex(payload)) for _, command, payload in PACKETS.values()]
    assert all_packets(stream) == want
    assert fed([stream[: len(stream) // 2], stream[len(stream) // 2 :]]) == want
    assert fed([stream[at : at + 1] for at in range(len(stream))]) == want


@pytest.mark.parametrize("name", PACKETS)
def test_a_packet_cut_at_any_length_is_waited_for(name):
    whole = bytes_of(name)
    for length in range(len(whole)):
        used, packet = decode(whole[:length])
        assert (used, packet) == (0, None)


@pytest.mark.parametrize(
    "noise", [b"\x00", b"\xaa", b"\xaa\xaa", b"\xaa\xaa\xaa", b"\xaa\xaa\x00", b"\xaa" * 9, b"hello"]
)
@pytest.mark.parametrize("name", PACKETS)
def test_noise_before_and_between_costs_no_packet(name, noise):
    packet = decode(bytes_of(name))[1]
    stream = noise + bytes_of(name) + noise + bytes_of(name)
    assert all_packets(stream) == [packet, packet]
    assert fed([stream[at : at + 1] for at in range(len(stream))]) == [packet, packet]


def test_three_aa_must_stand_in_a_row():
    """Public drivers count any three AA: AA 00 AA AA then begins a packet for them."""
    spread = b"\xaa\x00\xaa\xaa" + bytes_of("stop")[3:]
    assert all_packets(spread + bytes_of("info")) == [Packet(0x50)]


@pytest.mark.parametrize(
    "payload", [b"\xaa\xaa\xaa", b"\xaa" * 7, b"x\xaa\xaa\xaa\x22\x00\x00", b"\xaa\xaa\xaa\xaa\x06"]
)
def test_a_preamble_inside_a_payload_splits_no_packet(payload):
    packet = Packet(CommandId.LOOP, payload)
    stream = encode(packet) + encode(packet)
    assert len(stream.split(codec.PREAMBLE)) > 3  # a public driver cuts there: two packets make two cuts, not more
    assert all_packets(stream) == [packet, packet]
    assert fed([stream[at : at + 1] for at in range(len(stream))]) == [packet, packet]


def test_a_whole_packet_inside_a_payload_stays_inside():
    packet = Packet(CommandId.LOOP, bytes_of("fast stop"))
    assert all_packets(encode(packet)) == [packet]


@pytest.mark.parametrize("name", PACKETS)
def test_a_packet_with_any_bit_flipped_costs_itself_and_nothing_after_it(name):
    good = bytes_of(name)
    after = Packet(CommandId.LOOP, bytes(range(16)))
    close = bytes(codec.MAX_PAYLOAD)  # a flipped length may claim so much more
    for bit in range(8 * len(good)):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        found = all_packets(bytes(bad) + encode(after) + close)
        assert found[-1:] == [after]
        assert decode(good)[1] not in found[:-1]


def test_a_good_packet_that_begins_inside_a_damaged_one_is_found():
    damaged = bytes_of("grasp 12 mm 34 mm/s")[:9]  # cut: its length claims the beginning of the next
    assert all_packets(damaged + bytes_of("stop") + bytes_of("info")) == [Packet(0x22), Packet(0x50)]


def test_a_length_above_the_largest_payload_is_noise_at_once():
    claim = b"\xaa\xaa\xaa\x06" + struct.pack("<H", codec.MAX_PAYLOAD + 1)
    assert all_packets(claim + bytes_of("stop")) == [Packet(0x22)]
    waits = b"\xaa\xaa\xaa\x06" + struct.pack("<H", codec.MAX_PAYLOAD)
    assert decode(waits + bytes_of("stop")) == (0, None)
    assert all_packets((waits + bytes_of("stop"))[1:]) == [Packet(0x22)]  # what a caller does when no more comes


@given(st.binary(max_size=80), st.integers(0, 255).filter(lambda number: number != 0xAA), st.binary(max_size=64))
def test_whatever_is_packetd_is_read_back(noise, command, payload):
    packet = Packet(command, payload)
    assert decode(encode(packet)) == (len(encode(packet)), packet)
    assert packet in all_packets(noise + encode(packet) + bytes(codec.MAX_PAYLOAD + 8))


@given(st.lists(st.binary(max_size=30), max_size=6))
def test_pieces_change_nothing(chunks):
    assert fed(chunks) == all_packets(b"".join(chunks))


def fuzzed(seed):
    """A million bytes rich in AA, 00 and 01 with 2000 packets planted in them, and where each of these begins."""
    rng = np.random.default_rng(seed)
    alphabet = np.array([0xAA] * 6 + [0x00] * 4 + [0x01] + list(range(2, 7)), np.uint8)
    noise = rng.choice(alphabet, 1_000_000).tobytes()
    stream, planted, before = bytearray(), {}, 0
    for cut, name in zip(np.sort(rng.choice(len(noise), 2000, replace=False)), itertools.cycle(PACKETS), strict=False):
        stream += noise[before:cut]
        planted[len(stream)] = name
        stream += bytes_of(name)
        before = cut
    return stream + noise[before:] + bytes(codec.MAX_PAYLOAD + 8), planted


def places(stream):
    """Where each packet begins that is found."""
    buffer, found, at = bytearray(stream), {}, 0
    while True:
        used, packet = decode(buffer)
        if packet is None:
            return found
        found[at + used - len(encode(packet))] = packet
        at += used
        del buffer[:used]


def test_a_million_fuzzed_bytes_cost_a_planted_packet_only_where_noise_makes_a_packet_of_it():
    """A planted packet is found, unless it lies inside noise that is itself a packet: a beginning, a length that
    reaches so far, and a check sum that holds, which is so for 1 in 65536 of them. Nothing else is lost."""
    stream, planted = fuzzed(0)
    found = places(stream)
    lost = {at for at in planted if at not in found}
    inside = {at for start, packet in found.items() for at in range(start + 1, start + len(encode(packet)))}
    swallowed = inside & set(planted)
    assert lost == swallowed
    assert len(lost) <= 2
    assert all(found[at] == decode(bytes_of(name))[1] for at, name in planted.items() if at in found)
    assert fed([stream[at : at + 997] for at in range(0, len(stream), 997)]) == list(found.values())


def test_whatever_is_found_in_noise_is_parsed_or_refused_with_the_drivers_own_error():
    parsers = [getattr(commands, name) for name in PARSERS]
    for payload in (np.random.default_rng(size).bytes(size) for size in range(40) for _ in range(5)):
        for parse in parsers:
            with contextlib.suppress(WireError):
                parse(payload)
        with contextlib.suppress(WireError):
            commands.reply(Packet(0x40, payload))


class Counted(tuple):
    """The table of the check sum, which counts how often it is looked into."""

    looked = 0

    def __getitem__(self, index):
        type(self).looked += 1
        return super().__getitem__(index)


@pytest.mark.parametrize("half", ["aa aa aa 06 ff 00", "aa aa aa 06 00 01", "aa aa aa 06 ff 00 55"])
def test_packets_that_break_off_cost_each_byte_once_however_many_claim_it(half, monkeypatch):
    """Summed packet by packet, each byte is gone through once for every packet that claims it, 40 times here."""
    stream = bytes.fromhex(half) * 500
    monkeypatch.setattr(codec, "_TABLE", Counted(codec._TABLE))
    Counted.looked = 0
    used, packet = decode(stream)
    assert packet is None
    assert used > len(stream) - 265  # all but what may still become a packet
    assert Counted.looked <= len(stream)


@given(st.binary(max_size=600), st.data())
def test_the_sum_of_a_stretch_is_that_of_its_bytes_alone(data, draw):
    first = draw.draw(st.integers(0, len(data)))
    sums = codec._PrefixChecksums(data, first)
    for _ in range(3):
        start = draw.draw(st.integers(first, len(data)))
        stop = draw.draw(st.integers(start, min(len(data), start + 264)))
        assert sums.checksum_of(start, stop) == codec.checksum(data[start:stop])
