"""An emulated WSG-50 on a TCP port, with faults of the line.

    python -m tests.emulators.wsg50.server --port 1000 --object-mm 40

or in a program:

    with serve(EmulatedWSG50(object_mm=40.0)) as port, WSG50(host="127.0.0.1", port=port) as gripper:
        gripper.grasp(10.0)
"""

import argparse
import contextlib
import select
import socket
import threading
import time

from robot.drivers.wsg50.codec import decode, encode
from tests.emulators.wsg50.faults import LineFaults
from tests.emulators.wsg50.gripper import UPDATES, EmulatedWSG50

_TICK_S = 0.001
_CHUNK = 4096


class _Cut(Exception):
    """The line was cut."""


@contextlib.contextmanager
def serve(emulator, faults=None, *, port=0):
    """Serve one client at a time on 127.0.0.1 and yield the port. Port 0 chooses a free one."""
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
            yield server.getsockname()[1]


class _Socket:
    def __init__(self, client):
        self._client = client
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.settimeout(1.0)
        self.fileno, self.write, self.close = client.fileno, client.sendall, client.close

    def read(self):
        return self._client.recv(_CHUNK)


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
    parser.add_argument("--port", type=int, default=1000, help="port of 127.0.0.1 (0: any free port)")
    parser.add_argument("--object-mm", type=float, help="width of an object between the jaws")
    options = parser.parse_args()
    with (
        contextlib.suppress(KeyboardInterrupt),
        serve(EmulatedWSG50(object_mm=options.object_mm), port=options.port) as port,
    ):
        print(f"127.0.0.1:{port}", flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    main()
