"""The emulated WSG-50 on its ports: TCP, a terminal, a program."""

import contextlib
import os
import signal
import socket
import struct
import sys
import time

import pytest

from robot.drivers.wsg50.codec import Packet, encode
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.emulators.wsg50.server import serve_pty, serve_tcp
from tests.waiting import STARTED, STARTED_IDS, first_line, run_process
from tests.wsg50_packets import bytes_of

STOP = 0x22


def read_until(read, expected, seconds=5.0):
    got, deadline = b"", time.monotonic() + seconds
    while expected not in got and time.monotonic() < deadline:
        got += read()
    return got


def test_it_answers_documented_packets_over_tcp():
    with serve_tcp(EmulatedWSG50()) as url:
        host, port = url.removeprefix("socket://").split(":")
        with socket.create_connection((host, int(port)), timeout=5) as client:
            client.sendall(bytes_of("stop"))
            expected = encode(Packet(STOP, b"\0\0"))
            assert read_until(lambda: client.recv(100), expected) == expected


def test_it_answers_documented_packets_over_a_terminal():
    with serve_pty(EmulatedWSG50()) as path:
        terminal = os.open(path, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(terminal, bytes_of("get force limit"))
            expected = encode(Packet(0x33, b"\0\0" + struct.pack("<f", 40)))
            assert read_until(lambda: os.read(terminal, 100), expected) == expected
        finally:
            os.close(terminal)


def damaged(packet):
    return packet[:-1] + bytes([packet[-1] ^ 1])


def is_answered(client, sent, expected):
    client.sendall(sent)
    return expected in read_until(lambda: client.recv(1000), expected)


@contextlib.contextmanager
def client_of(url):
    host, port = url.removeprefix("socket://").split(":")
    with socket.create_connection((host, int(port)), timeout=5) as client:
        yield client


def test_a_damaged_command_is_answered_only_if_configured():
    emulator, answer = EmulatedWSG50(), encode(Packet(STOP, b"\x0b\x00"))
    with serve_tcp(emulator) as url, client_of(url) as client:
        client.sendall(damaged(bytes_of("stop")))
        assert is_answered(client, bytes_of("loop abc"), encode(Packet(0x06, b"\0\0abc")))
        emulator.answers_bad_checksum = True
        assert is_answered(client, b"\xaa" + damaged(bytes_of("stop")), answer)
        assert STOP not in emulator.received


@pytest.mark.parametrize("by", STARTED, ids=STARTED_IDS)
@pytest.mark.parametrize(("port", "end"), [(["--tcp", "0"], signal.SIGINT), (["--pty"], signal.SIGTERM)])
def test_it_runs_as_a_program_and_prints_its_port(port, end, by):
    program = [sys.executable, "-m", "tests.emulators.wsg50.server", *port, "--object-mm", "40"]
    with run_process([*by, *program]) as process:
        line = first_line(process)
        assert line.startswith("socket://127.0.0.1:") or os.path.exists(line.strip())
        process.send_signal(end)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "faults: {" in errors
