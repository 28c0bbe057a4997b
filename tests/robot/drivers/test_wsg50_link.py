"""The link to a WSG-50: deadlines, late and doubled replies, lost ports."""

import contextlib
import itertools
import os
import select
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import closing

import pytest
from serial.urlhandler import protocol_socket

from robot.drivers.wsg50 import codec as wsg50_codec
from robot.drivers.wsg50 import commands
from robot.drivers.wsg50 import link as wsg50_link
from robot.drivers.wsg50.codec import Packet, decode, encode
from robot.drivers.wsg50.commands import CommandId, Status
from robot.drivers.wsg50.driver import WSG50
from robot.drivers.wsg50.link import CommandFailed, Link, LinkLost, NoEcho, NoReply, Port
from robot.errors import DeviceError
from tests.waiting import wait_until
from tests.wsg50_packets import bytes_of

OK = bytes(2)


class Peer:
    """The other end of a TCP link: answers each packet by a function packet -> bytes, or None to disconnect."""

    def __init__(self, answer):
        self.answer, self.received = answer, []
        self.server = socket.create_server(("127.0.0.1", 0))
        self.url = f"socket://127.0.0.1:{self.server.getsockname()[1]}"
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self):
        try:
            client, _ = self.server.accept()
        except OSError:
            return
        buffer = bytearray()
        with client:
            while data := self.receive(client):
                buffer += data
                while True:
                    used, packet = decode(buffer)
                    del buffer[:used]
                    if packet is None:
                        break
                    self.received.append(packet.id)
                    answer = self.answer(packet)
                    if answer is None:
                        return
                    client.sendall(answer)

    def receive(self, client):
        try:
            return client.recv(4096)
        except OSError:
            return b""

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.server.shutdown(socket.SHUT_RDWR)
        self.server.close()
        self.thread.join()


class Endless:
    """A fake port whose peer sends the same data without end, faster than it can be read."""

    def __init__(self, data):
        self.data = data

    def __call__(self, name, **_):
        return self

    def read(self, timeout_s):
        return self.data

    def write(self, data): ...

    def close(self): ...


class Timed:
    """A fake port with a fake clock of a slow computer: a byte of a checksum takes 10 us, a read 0.5 ms.

    The peer sends `data` without end, `at_once` bytes in each read, and an echo if `echoes`.
    """

    def __init__(self, data, at_once, echoes):
        self.stream, self.at_once, self.echoes = itertools.cycle(data), at_once, echoes
        self.now_s, self.echo = 1000.0, b""

    def monotonic(self):
        return self.now_s

    def __call__(self, name, **_):
        return self

    def __getitem__(self, index):
        self.now_s += 1e-5
        return TABLE[index]

    def read(self, timeout_s):
        self.now_s += 5e-4
        echo, self.echo = self.echo, b""
        return echo + bytes(itertools.islice(self.stream, self.at_once))

    def write(self, data):
        packet = decode(data)[1]
        if self.echoes and packet and packet.id == CommandId.LOOP:
            self.echo = reply(packet, packet.payload)

    def close(self): ...


TABLE = wsg50_codec._TABLE
TRUNCATED = b"\xaa\xaa\xaa\x06\xff\x00"
UPDATE = encode(Packet(CommandId.SYSTEM_STATE, OK + bytes(4)))
FLOODS = pytest.mark.parametrize(
    "data", [bytes(1000), UPDATE * 50, b"\xaa" * 1000, b"\xaa\xaa\xaa\x06\xff\x00" * 150], ids=range(4)
)


def ends(call, seconds=20.0):
    """Return the result or the DeviceError of a call, run in a thread; fail the test if it does not end."""
    ended = []

    def run():
        try:
            ended.append(call())
        except DeviceError as error:
            ended.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(seconds)
    assert ended, f"not ended in {seconds} s"
    return ended[0]


def reply(packet, parameters=b"", status=0):
    return encode(Packet(packet.id, status.to_bytes(2, "little") + parameters))


def echoing(packet):
    """Answer only LOOP."""
    return reply(packet, packet.payload) if packet.id == CommandId.LOOP else b""


def linked(peer, timeout_s=0.2):
    link = Link(peer.url, timeout_s=timeout_s)
    link.open()
    return closing(link)


@pytest.fixture(autouse=True)
def quick_close(monkeypatch):
    """pyserial waits 0.3 s after closing a socket."""
    import serial.urlhandler.protocol_socket as protocol

    monkeypatch.setattr(protocol, "time", type("NoWait", (), {"sleep": staticmethod(lambda _: None)}))


def test_a_loopback_port_returns_the_written_bytes():
    port = Port("loop://", baud=115200, stop_bits=2, write_timeout_s=1.0)
    port.write(bytes_of("stop"))
    got = b""
    while len(got) < len(bytes_of("stop")):
        got += port.read(1.0)
    assert got == bytes_of("stop")
    assert port.read(0.01) == b""
    port.close()


def test_a_reply_is_found_among_updates_and_noise():
    def answer(packet):
        if packet.id == CommandId.LOOP:
            return echoing(packet)
        update = encode(Packet(CommandId.OPENING, OK + b"\x00\x00\x16\x43"))
        return update + b"\xaa\xaa noise" + update + reply(packet, b"\x00\x00\x20\x42")

    with Peer(answer) as peer, linked(peer) as link:
        assert link.query(commands.query(CommandId.GET_FORCE_LIMIT), commands.number) == 40.0
        assert commands.number(link.updates[CommandId.OPENING][0]) == 150.0


def test_pending_is_not_the_end_of_a_command():
    def answer(packet):
        return echoing(packet) or reply(packet, status=Status.CMD_PENDING) + reply(packet)

    with Peer(answer) as peer, linked(peer) as link:
        assert link.call(Packet(CommandId.TARE)) == b""
        link.begin(Packet(CommandId.HOME, b"\0"))
        assert [link.poll(CommandId.HOME, 1.0), link.poll(CommandId.HOME, 1.0)] == [Status.CMD_PENDING, Status.SUCCESS]
        assert link.poll(CommandId.HOME, 0.01) is None


def test_another_status_than_success_raises_with_command_and_status():
    with Peer(lambda packet: echoing(packet) or reply(packet, status=16)) as peer, linked(peer) as link:
        with pytest.raises(CommandFailed, match=r"STOP \(22h\) with ACCESS_DENIED \(status 16\)") as caught:
            link.send(Packet(CommandId.STOP))
        assert caught.value.status is Status.ACCESS_DENIED
        assert peer.received.count(CommandId.STOP) == 1  # an answered command is not repeated


def test_a_query_without_answer_is_tried_three_times_within_the_deadline():
    with Peer(echoing) as peer, linked(peer, timeout_s=0.05) as link:
        started = time.monotonic()
        with pytest.raises(NoReply, match=r"INFO \(50h\) within 0.05 s"):
            link.query(commands.query(CommandId.INFO), commands.info)
        assert time.monotonic() - started < 5
        assert peer.received.count(CommandId.INFO) == 3
        assert link.counts["retried"] == 2


@FLOODS
@pytest.mark.parametrize(
    ("wait", "end"),
    [
        (lambda link: link.pump(0.05), None),
        (lambda link: link.pump(0.0), None),
        (lambda link: link.poll(CommandId.HOME, 0.05), None),
        (lambda link: link.sync(), NoEcho),
        (lambda link: link.send_urgent(Packet(CommandId.STOP)), NoReply),
        (lambda link: link.send(Packet(CommandId.STOP)), NoEcho),
    ],
)
def test_every_wait_ends_although_the_peer_sends_without_end(data, wait, end, monkeypatch):
    monkeypatch.setattr(wsg50_link, "Port", Endless(data))
    link = Link("a port", timeout_s=0.05)
    link.open()
    ended = ends(lambda: wait(link))
    assert ended is None if end is None else isinstance(ended, end)


@pytest.mark.parametrize("echoes", [False, True])
@pytest.mark.parametrize("at_once", [1, 512])
@pytest.mark.parametrize("data", [TRUNCATED, TRUNCATED + b"\x55", b"\xaa", UPDATE], ids=range(4))
@pytest.mark.parametrize(
    ("wait", "time_outs"),
    [
        (lambda link: link.poll(CommandId.HOME, 0.1), 1),
        (lambda link: link.send_urgent(Packet(CommandId.STOP)), 1),
        (lambda link: link.sync(), 3),
        (lambda link: link.call(Packet(CommandId.STOP)), 4),
        (lambda link: link.send(Packet(CommandId.STOP)), 7),
        (lambda link: link.pump(0.0), 0),
    ],
    ids=["poll", "send_urgent", "sync", "call", "send", "pump"],
)
def test_every_call_ends_within_its_time_outs_for_any_data(wait, time_outs, data, at_once, echoes, monkeypatch):
    """Truncated packets sent byte by byte are the worst case: they must not prolong a wait."""
    peer = Timed(data, at_once, echoes)
    for module, name in ((wsg50_link, "Port"), (wsg50_link, "time"), (wsg50_codec, "_TABLE")):
        monkeypatch.setattr(module, name, peer)
    link = Link("a port", timeout_s=0.1)
    link.open()
    began = peer.now_s
    with contextlib.suppress(DeviceError):
        wait(link)
    assert peer.now_s - began <= 0.1 * time_outs + 0.05 * (time_outs + 1)  # plus the time to decode


@FLOODS
def test_connecting_ends_although_the_peer_sends_without_end(data, monkeypatch):
    monkeypatch.setattr(wsg50_link, "Port", Endless(data))
    gripper = WSG50(port="a port", timeout_s=0.05)
    assert "is it on and connected" in str(ends(gripper.connect))
    assert not gripper.is_connected


def test_a_socket_can_be_opened_although_the_peer_sends_without_end():
    """On opening, pyserial reads until the socket is empty; here it is never empty."""
    pending = [b"x"] * 100
    with Peer(echoing) as peer, pytest.MonkeyPatch.context() as patch:
        real = select.select

        def always(read, write, other, timeout=None):
            return (read, write, other) if pending and pending.pop() else real(read, write, other, timeout)

        patch.setattr(protocol_socket.select, "select", always)
        Port(peer.url, baud=9600, stop_bits=1, write_timeout_s=1.0).close()
        assert len(pending) > 90


def test_all_bytes_received_during_a_suspension_are_processed_at_once():
    updates = b"".join(encode(Packet(CommandId.OPENING, OK + struct.pack("<f", each))) for each in range(800))

    def answer(packet):
        return echoing(packet) or reply(packet) + updates

    with Peer(answer) as peer, linked(peer) as link:
        link.send(Packet(CommandId.STOP))
        time.sleep(0.2)
        link.pump(0.0)
        assert commands.number(link.updates[CommandId.OPENING][0]) == 799.0


def test_a_command_that_was_received_damaged_is_repeated():
    statuses = [11, 0]

    def answer(packet):
        return echoing(packet) or reply(packet, status=statuses.pop(0))

    with Peer(answer) as peer, linked(peer, timeout_s=5.0) as link:
        link.send(Packet(CommandId.STOP))
        assert peer.received.count(CommandId.STOP) == 2
        assert link.counts == {"retried": 1}


def test_without_an_echo_no_command_is_repeated():
    with Peer(lambda packet: b"") as peer, linked(peer, timeout_s=0.05) as link:
        with pytest.raises(NoEcho):
            link.send(Packet(CommandId.STOP))
        wait_until(lambda: len(peer.received) == 3)
        time.sleep(0.1)
        assert peer.received == [CommandId.LOOP] * 3


def test_without_an_echo_no_command_is_sent():
    with Peer(lambda packet: b"") as peer, linked(peer, timeout_s=0.05) as link:
        with pytest.raises(NoReply, match="is it on and connected"):
            link.call(Packet(CommandId.STOP))
        assert set(peer.received) == {CommandId.LOOP}  # no command without synchronisation


def test_a_late_reply_is_never_returned_for_the_next_query():
    """The first query is answered after the second was sent; without the echo the old value would be returned."""
    late = []

    def answer(packet):
        if packet.id == CommandId.LOOP:
            return b"".join(late) + echoing(packet)
        if not late:
            late.append(reply(packet, b"\x00\x00\x80\x3f"))  # 1.0
            return b""
        return reply(packet, b"\x00\x00\x00\x40")  # 2.0

    with Peer(answer) as peer, linked(peer, timeout_s=0.1) as link:
        with pytest.raises(NoReply):
            link.call(commands.query(CommandId.GET_FORCE_LIMIT))
        assert commands.number(link.call(commands.query(CommandId.GET_FORCE_LIMIT))) == 2.0
        assert link.counts["unexpected"] == 1


def test_a_doubled_reply_requires_synchronisation_before_the_next_command():
    def answer(packet):
        return echoing(packet) or 2 * reply(packet, b"\x00\x00\x80\x3f")

    with Peer(answer) as peer, linked(peer) as link:
        link.call(commands.query(CommandId.GET_FORCE_LIMIT))
        link.pump(0.05)
        loops = peer.received.count(CommandId.LOOP)
        link.call(commands.query(CommandId.GET_ACCELERATION))
        assert peer.received.count(CommandId.LOOP) == loops + 1


def test_an_incomplete_packet_hides_no_packet_after_it():
    truncated = b"\xaa\xaa\xaa\x06\xff\x00"  # claims 255 bytes that never arrive

    def answer(packet):
        return echoing(packet) or truncated + reply(packet, b"\x00\x00\x80\x3f")

    with Peer(answer) as peer, linked(peer) as link:
        assert commands.number(link.call(commands.query(CommandId.GET_FORCE_LIMIT))) == 1.0
        assert link.counts["abandoned"] >= 1


def test_a_query_with_a_reply_of_the_wrong_length_is_repeated():
    answers = [b"\x01", b"\x00\x00\x80\x3f"]

    def answer(packet):
        return echoing(packet) or reply(packet, answers.pop(0))

    with Peer(answer) as peer, linked(peer) as link:
        assert link.query(commands.query(CommandId.GET_FORCE_LIMIT), commands.number) == 1.0
        assert answers == []


def test_an_urgent_stop_does_not_synchronise_first():
    with Peer(lambda packet: echoing(packet) or reply(packet)) as peer, linked(peer) as link:
        link.require_sync()
        link.send_urgent(Packet(CommandId.STOP))
        assert peer.received == [CommandId.STOP]


def test_a_link_closed_by_the_peer_raises_and_can_be_opened_again():
    with Peer(lambda packet: None) as peer:
        link = Link(peer.url, timeout_s=0.5)
        link.open()
        with pytest.raises(LinkLost, match=r"was lost.*recover"):
            link.sync()
        assert not link.is_open
        with pytest.raises(LinkLost, match="is closed or was lost"):
            link.send(Packet(CommandId.STOP))
        link.close()
    with Peer(echoing) as other:
        link.name = other.url
        link.open()
        link.open()
        link.sync()
        link.close()
        link.close()


@pytest.mark.parametrize(
    "port", ["/nowhere/tty", "socket://127.0.0.1:1", "socket://127.0.0.1", "what://is this", "loop://?x=1"]
)
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
    assert not link.is_open


def test_without_pyserial_the_message_names_the_install_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(
        DeviceError, match=r"requires pyserial, which is missing; run pip install 'touch-retrieval\[gripper\]'"
    ):
        Link("loop://").open()


def test_the_driver_can_be_imported_without_pyserial():
    blocked = (
        "import sys; sys.modules['serial'] = None; import robot.drivers.wsg50.driver, tests.emulators.wsg50.server"
    )
    subprocess.run([sys.executable, "-c", blocked], check=True, timeout=60)
