"""The link to a WSG-50: deadlines, late and doubled replies, lost ports."""

import os
import socket
import struct
import threading
from contextlib import contextmanager, suppress

import pytest

from robot.drivers.wsg50 import codec
from robot.drivers.wsg50.codec import CommandId, Packet, decode, encode
from robot.drivers.wsg50.driver import Link, LinkLost
from tests.wsg50_bench import quick_close

FORCE = codec.query(CommandId.GET_FORCE_LIMIT)
ONE, TWO = struct.pack("<f", 1), struct.pack("<f", 2)


@contextmanager
def linked_to(answer, timeout_s=0.2):
    """Yield an open link and the ids that its peer receives; `answer(packet)` returns bytes."""
    received = []

    def run():
        buffer = bytearray()
        with server.accept()[0] as client, suppress(OSError):
            while data := client.recv(4096):
                buffer += data
                packet = True
                while packet:
                    used, packet = decode(buffer)
                    del buffer[:used]
                    if packet:
                        received.append(packet.id)
                        client.sendall(answer(packet))

    with socket.create_server(("127.0.0.1", 0)) as server:
        link = Link(f"socket://127.0.0.1:{server.getsockname()[1]}", timeout_s=timeout_s)
        thread = threading.Thread(target=run)
        thread.start()
        link.open()
        yield link, received
        link.close()
        thread.join()


@pytest.fixture(autouse=True)
def _quick_close():
    with quick_close():
        yield


def reply(packet, parameters=b"", status=0):
    return encode(Packet(packet.id, status.to_bytes(2, "little") + parameters))


def echoing(packet):
    """Answer only LOOP."""
    return reply(packet, packet.payload) if packet.id == CommandId.LOOP else b""


@pytest.mark.parametrize(
    "first",
    [b"", reply(FORCE, b"\x01"), reply(FORCE, status=11), b"\xaa\xaa\xaa\x06\xff\x00"],
    ids=["lost", "short", "damaged command", "claims bytes that never arrive"],
)
def test_an_answer_that_is_not_valid_is_requested_again(first):
    answers = [first, reply(FORCE, ONE)]
    with linked_to(lambda packet: echoing(packet) or answers.pop(0), 0.1) as (link, _):
        assert link.query(FORCE, codec.number) == 1.0
        assert answers == []


def test_a_late_reply_is_never_returned_for_the_next_query():
    """The first query is answered after the second was sent; without the echo the old value would be returned."""
    late = []

    def answer(packet):
        if packet.id == CommandId.LOOP:
            return b"".join(late) + echoing(packet)
        if not late:
            late.append(reply(packet, ONE))
            return b""
        return reply(packet, TWO)

    with linked_to(answer, 0.1) as (link, _):
        assert link.query(FORCE, codec.number) == 2.0


def test_an_urgent_stop_does_not_synchronise_first():
    with linked_to(lambda packet: echoing(packet) or reply(packet)) as (link, received):
        link.send_urgent(Packet(CommandId.STOP))
        assert received == [CommandId.STOP]


@pytest.mark.parametrize("port", ["/nowhere/tty", "socket://127.0.0.1:1", "socket://127.0.0.1", "what://is this"])
def test_a_port_that_cannot_be_opened_is_a_lost_link(port):
    with pytest.raises(LinkLost, match="cannot be opened"):
        Link(port).open()


def test_a_closed_terminal_is_a_lost_link():
    own, other = os.openpty()
    link = Link(os.ttyname(other), timeout_s=0.5)
    link.open()
    os.close(other)
    os.close(own)
    with pytest.raises(LinkLost):
        link.sync()
