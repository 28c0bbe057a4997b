"""An emulated WSG-50 on a real port, TCP or pseudo-terminal, with line faults.

    python -m tests.emulators.wsg50.server --tcp 10000 --object-mm 40
    python -m tests.emulators.wsg50.server --pty

or in a program:

    with serve_tcp(EmulatedWSG50(object_mm=40.0)) as url, WSG50(port=url) as gripper:
        gripper.grasp(10.0)
"""

import argparse
import contextlib
import os
import select
import socket
import tempfile
import threading
import time
import tty
from pathlib import Path

from robot.drivers.wsg50.codec import decode, encode
from tests.emulators.wsg50.faults import LineFaults
from tests.emulators.wsg50.gripper import UPDATES, EmulatedWSG50

_TICK_S = 0.001
_CHUNK = 4096


class _Cut(Exception):
    """The line was cut."""


@contextlib.contextmanager
def serve_tcp(emulator, faults=None, *, port=0):
    """Serve one client at a time on 127.0.0.1 and yield the URL for the driver. Port 0 chooses a free port."""
    with socket.create_server(("127.0.0.1", port)) as server:
        server.settimeout(0.02)

        def wait_for_client(stop):
            while not stop.is_set():
                try:
                    return _Socket(server.accept()[0])
                except TimeoutError:
                    emulator.tick()
            return None

        with _served(emulator, faults, wait_for_client):
            yield f"socket://127.0.0.1:{server.getsockname()[1]}"


@contextlib.contextmanager
def serve_pty(emulator, faults=None):
    """Serve a pseudo-terminal and yield its path, which stays the same after a cut.

    A cut or closed serial line does not raise a FAST STOP, because the gripper does not notice it.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "wsg50"
        first = [_Terminal(path)]

        def wait_for_client(stop):
            return None if stop.is_set() else first.pop() if first else _Terminal(path)

        with _served(emulator, faults, wait_for_client):
            yield str(path)


# Lines to one client; reading and writing raise OSError after it disconnected.


class _Socket:
    def __init__(self, client):
        self._client = client
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.settimeout(1.0)
        self.fileno, self.write, self.close = client.fileno, client.sendall, client.close

    def read(self):
        return self._client.recv(_CHUNK)


class _Terminal:
    """The gripper's end of a pseudo-terminal; `path` is a link to the other end."""

    def __init__(self, path):
        self._own, self._other = os.openpty()
        tty.setraw(self._other)  # stays open, so that clients can reconnect
        os.set_blocking(self._own, False)
        fresh = path.with_suffix(".new")
        fresh.symlink_to(os.ttyname(self._other))
        fresh.replace(path)

    def fileno(self):
        return self._own

    def read(self):
        return os.read(self._own, _CHUNK)

    def write(self, data):
        with contextlib.suppress(BlockingIOError):  # without a reader the bytes are lost, as on a wire
            os.write(self._own, data)

    def close(self):
        os.close(self._own)
        os.close(self._other)


@contextlib.contextmanager
def _served(emulator, faults, wait_for_client):
    """Serve one client after another in a thread, whatever they send."""
    stop, faults = threading.Event(), faults or LineFaults()

    def work():
        while (line := wait_for_client(stop)) is not None:
            emulator.connected()
            with contextlib.suppress(OSError, _Cut):  # the client disconnected
                _Session(emulator, faults, line).run(stop)
            line.close()
            if isinstance(line, _Socket):
                emulator.disconnected()

    thread = threading.Thread(target=work, name="wsg50 emulator", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


class _Session:
    def __init__(self, emulator, faults, line):
        self.emulator, self.faults, self.line = emulator, faults, line
        self._arrived, self._received = bytearray(), bytearray()

    def run(self, stop):
        while not stop.is_set():
            if select.select([self.line.fileno()], [], [], _TICK_S)[0]:
                self._receive()
            for packet in self.emulator.tick():
                if packet.id in UPDATES:  # faults apply to commands and their replies only
                    self.line.write(encode(packet))
                else:
                    self._through_faults(packet, self.line.write)

    def _receive(self):
        data = self.line.read()
        if not data:
            raise _Cut
        self._arrived += data
        for noise, command in _packets(self._arrived):
            self._handle(noise)
            if command:
                self._through_faults(command, self._handle)

    def _handle(self, data):
        """Handle the bytes that remain of the sent ones after faults."""
        self._received += data
        for _, command in _packets(self._received):
            for answer in self.emulator.receive(command) if command else ():
                self._through_faults(answer, self.line.write)

    def _through_faults(self, packet, send):
        for pause_s, data in self.faults.on(packet):
            time.sleep(pause_s)
            if data is None:
                raise _Cut
            send(data)


def _packets(buffer):
    """Remove the complete packets from a buffer, each with the noise before it; finally the noise behind them."""
    packet = True
    while packet:
        used, packet = decode(buffer)
        yield bytes(buffer[: used - len(encode(packet))] if packet else buffer[:used]), packet
        del buffer[:used]


def main():
    """Serve until Ctrl-C; the first printed line is the address for clients."""
    parser = argparse.ArgumentParser(description="An emulated WSG-50 gripper.")
    port = parser.add_mutually_exclusive_group(required=True)
    port.add_argument("--tcp", type=int, metavar="PORT", help="listen on 127.0.0.1 (0: any free port)")
    port.add_argument("--pty", action="store_true", help="create a pseudo-terminal")
    parser.add_argument("--object-mm", type=float, help="width of an object between the jaws")
    options = parser.parse_args()
    emulator = EmulatedWSG50(object_mm=options.object_mm)
    serving = serve_pty(emulator) if options.pty else serve_tcp(emulator, port=options.tcp)
    with contextlib.suppress(KeyboardInterrupt), serving as address:
        print(address, flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    main()
