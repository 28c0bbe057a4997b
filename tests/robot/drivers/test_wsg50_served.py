"""The emulated WSG-50 on its ports: TCP, a terminal, a program; whatever clients send."""

import contextlib
import math
import os
import re
import select
import signal
import socket
import struct
import sys
import time

import numpy as np
import pytest

from robot.drivers.wsg50.codec import Packet, encode
from tests.emulators.wsg50 import gripper as wsg50_emulated
from tests.emulators.wsg50.faults import LineFaults
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.emulators.wsg50.server import main, serve_pty, serve_tcp
from tests.waiting import STARTED, STARTED_IDS, first_line, running
from tests.wsg50_packets import bytes_of

STOP = 0x22


def read_until(read, want, seconds=5.0):
    got, deadline = b"", time.monotonic() + seconds
    while want not in got and time.monotonic() < deadline:
        got += read()
    return got


def test_it_speaks_the_printed_bytes_over_tcp():
    with serve_tcp(EmulatedWSG50()) as url:
        host, port = url.removeprefix("socket://").split(":")
        with socket.create_connection((host, int(port)), timeout=5) as client:
            client.sendall(bytes_of("stop"))
            want = encode(Packet(STOP, b"\0\0"))
            assert read_until(lambda: client.recv(100), want) == want


def test_it_speaks_the_printed_bytes_over_a_terminal():
    with serve_pty(EmulatedWSG50()) as path:
        terminal = os.open(path, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(terminal, bytes_of("get force limit"))
            want = encode(Packet(0x33, b"\0\0" + struct.pack("<f", 40)))
            assert read_until(lambda: os.read(terminal, 100), want) == want
        finally:
            os.close(terminal)


def damaged(packet):
    return packet[:-1] + bytes([packet[-1] ^ 1])


def talk(client, sent, want):
    client.sendall(sent)
    return want in read_until(lambda: client.recv(1000), want)


@contextlib.contextmanager
def client_of(url):
    host, port = url.removeprefix("socket://").split(":")
    with socket.create_connection((host, int(port)), timeout=5) as client:
        yield client


def test_a_damaged_command_is_answered_only_if_it_is_to_be():
    emulator, said = EmulatedWSG50(), encode(Packet(STOP, b"\x0b\x00"))
    with serve_tcp(emulator) as url, client_of(url) as client:
        client.sendall(damaged(bytes_of("stop")))
        assert talk(client, bytes_of("loop abc"), encode(Packet(0x06, b"\0\0abc")))
        emulator.answers_bad_checksum = True
        assert talk(client, b"\xaa" + damaged(bytes_of("stop")), said)
        assert STOP not in emulator.heard


def test_a_length_that_lies_swallows_what_comes_next_until_its_bytes_are_there():
    emulator = EmulatedWSG50()
    with serve_tcp(emulator) as url, client_of(url) as client:
        client.sendall(b"\xaa\xaa\xaa\x22\xff\x00" + bytes_of("info"))
        time.sleep(0.1)
        assert emulator.heard == []
        assert talk(client, bytes(264), encode(Packet(0x50, bytes(2) + struct.pack("<BBHI", 1, 6, 0x4000, 20260101))))


def test_no_packet_that_can_be_sent_ends_it():
    """Every id with payloads of every kind, huge numbers and such that are none among them."""
    rng = np.random.default_rng(0)
    odd = np.array([math.nan, math.inf, -math.inf, 3e38, -3e38, 1e-40, 0, 4], "<f4")
    sizes = [0, 1, 3, 4, 8, 9, 254, 255, 256]
    payloads = [rng.bytes(size) for size in sizes] + [rng.choice(odd, size).tobytes() for size in (1, 2) * 6]
    payloads += [b"\x02" + rng.choice(odd, 2).tobytes() for _ in range(6)]
    packets = [Packet(each, payload) for payload in payloads for each in range(256) if each != 0xAA]
    emulator = EmulatedWSG50(referenced=True, speed_up=50.0)
    with serve_tcp(emulator) as url, client_of(url) as client:
        client.setblocking(False)
        stream, got = b"".join(map(encode, packets)) + bytes_of("loop abc"), bytearray()
        want = encode(Packet(0x06, b"\0\0abc"))
        deadline = time.monotonic() + 30
        while want not in got[-10000:]:
            assert time.monotonic() < deadline
            readable, writable, _ = select.select([client], [client] if stream else [], [], 1.0)
            if readable:
                data = client.recv(65536)
                assert data, "the emulator has hung up"
                got += data
            if writable:
                stream = stream[client.send(stream[:4096]) :]
    assert len(emulator.heard) == len(packets) + 1


def test_what_it_fails_on_costs_one_client(monkeypatch, caplog):
    def broken(*_):
        raise RuntimeError("as a mistake in it would")

    monkeypatch.setitem(wsg50_emulated._ACTIONS, 0x33, broken)
    with serve_tcp(EmulatedWSG50()) as url:
        with client_of(url) as client:
            client.sendall(bytes_of("get force limit"))
            assert client.recv(100) == b""
        with client_of(url) as client:
            assert talk(client, bytes_of("stop"), encode(Packet(STOP, b"\0\0")))
    assert "as a mistake in it would" in caplog.text


def test_a_port_in_use_is_a_sentence(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(SystemExit) as caught:
        main(["--tcp", str(taken.getsockname()[1])])
    assert caught.value.code == 2
    assert re.search("Address already in use.*; try another port", capsys.readouterr().err)


def test_a_line_that_is_cut_can_be_taken_up_again():
    faults = LineFaults(1.0, ["disconnect"])
    emulator = EmulatedWSG50()
    with serve_tcp(emulator, faults) as url:
        host, port = url.removeprefix("socket://").split(":")
        with socket.create_connection((host, int(port)), timeout=5) as client:
            client.sendall(bytes_of("stop"))
            assert client.recv(100) == b""
        faults.rate = 0.0
        with socket.create_connection((host, int(port)), timeout=5) as client:
            client.sendall(bytes_of("stop"))
            assert client.recv(100)
        assert emulator.in_fast_stop


@pytest.mark.parametrize("by", STARTED, ids=STARTED_IDS)
@pytest.mark.parametrize(("port", "end"), [(["--tcp", "0"], signal.SIGINT), (["--pty"], signal.SIGTERM)])
def test_it_runs_as_a_program_and_says_where(port, end, by):
    program = [sys.executable, "-m", "tests.emulators.wsg50.server", *port, "--object-mm", "40"]
    with running([*by, *program]) as process:
        line = first_line(process)
        assert line.startswith("socket://127.0.0.1:") or os.path.exists(line.strip())
        process.send_signal(end)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "faults: {" in errors
