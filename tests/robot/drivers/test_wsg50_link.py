"""The link to a WSG-50: deadlines, late and doubled replies, lost ports."""

import os
import socket
import struct
import threading
from contextlib import contextmanager, suppress

import pytest

from robot.drivers.wsg50 import codec
from robot.drivers.wsg50.codec import CommandId, Packet, Status, decode, encode
from robot.drivers.wsg50.driver import CommandFailed, Link, LinkLost, NoEcho, NoReply
from tests.wsg50_bench import quick_close

OK = bytes(2)
FORCE = codec.query(CommandId.GET_FORCE_LIMIT)
ONE, TWO = struct.pack("<f", 1), struct.pack("<f", 2)


@contextmanager
def linked_to(answer, timeout_s=0.2):
    """Yield an open link and the ids that its peer receives; `answer(packet)` returns bytes, or None to disconnect."""
    received = []

    def run():
        with suppress(OSError):
            while True:
                with server.accept()[0] as client, suppress(OSError, TypeError):
                    serve(client)

    def serve(client):
        buffer = bytearray()
        while data := client.recv(4096):
            buffer += data
            packet = True
            while packet:
                used, packet = decode(buffer)
                del buffer[:used]
                if packet:
                    received.append(packet.id)
                    client.sendall(answer(packet))  # TypeError for None

    with socket.create_server(("127.0.0.1", 0)) as server:
        link = Link(f"socket://127.0.0.1:{server.getsockname()[1]}", timeout_s=timeout_s)
        thread = threading.Thread(target=run)
        thread.start()
        link.open()
        yield link, received
        link.close()
        server.shutdown(socket.SHUT_RDWR)
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


def test_a_reply_is_found_among_updates_noise_and_the_pending_of_a_motion():
    def answer(packet):
        update = encode(Packet(CommandId.OPENING, OK + TWO))
        pending = reply(packet, status=Status.CMD_PENDING)
        return echoing(packet) or update + b"\xaa\xaa noise" + pending + update + reply(packet, ONE)

    with linked_to(answer) as (link, _):
        assert link.query(FORCE, codec.number) == 1.0
        assert codec.number(link.updates[CommandId.OPENING][0]) == 2.0
        link.begin(codec.HOME)
        assert [link.poll(CommandId.HOME, 1.0), link.poll(CommandId.HOME, 1.0)] == [Status.CMD_PENDING, Status.SUCCESS]
        assert link.poll(CommandId.HOME, 0.01) is None


def test_another_status_than_success_raises_and_is_not_repeated():
    with linked_to(lambda packet: echoing(packet) or reply(packet, status=16)) as (link, received):
        with pytest.raises(CommandFailed, match=r"STOP.*ACCESS_DENIED"):
            link.send(Packet(CommandId.STOP))
        assert received.count(CommandId.STOP) == 1


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


def test_a_query_without_answer_is_tried_three_times_and_without_an_echo_it_is_not_sent():
    with linked_to(echoing, 0.05) as (link, received):
        with pytest.raises(NoReply, match=r"INFO.*0\.05 s"):
            link.query(codec.query(CommandId.INFO), codec.info)
        assert received.count(CommandId.INFO) == 3
    with linked_to(lambda packet: b"", 0.05) as (link, received):
        with pytest.raises(NoEcho, match="is it on and connected"):
            link.send(Packet(CommandId.STOP))
        assert set(received) == {CommandId.LOOP}


def test_every_wait_ends_although_the_peer_sends_without_end():
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = Link(f"socket://127.0.0.1:{server.getsockname()[1]}", timeout_s=0.01)

        def flood():
            client, _ = server.accept()
            with client:
                try:
                    while True:
                        client.sendall(bytes(1000))
                except OSError:
                    return

        peer = threading.Thread(target=flood)
        link.open()
        peer.start()
        link.pump(0.01)
        with pytest.raises(NoReply):
            link.send_urgent(Packet(CommandId.STOP))
        link.close()
        peer.join()


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


def test_a_link_closed_by_the_peer_raises_and_can_be_opened_again():
    answers = [None]
    with linked_to(lambda packet: answers.pop() if answers else echoing(packet)) as (link, _):
        for _ in range(2):
            with pytest.raises(LinkLost, match=r"was lost.*recover"):
                link.sync()
        for use in (link.open, link.open, link.sync, link.close, link.close):
            use()


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
