"""An emulated WSG-50 on a real port, TCP or pseudo-terminal, with line faults.

    python -m tests.emulators.wsg50.server --tcp 10000 --object-mm 40 [--faults 0.02 --seed 0]
    python -m tests.emulators.wsg50.server --pty

or in a program:

    with serve_tcp(EmulatedWSG50(object_mm=40.0)) as url, WSG50(port=url) as gripper:
        gripper.grasp(10.0)
"""

import argparse
import contextlib
import logging
import os
import select
import socket
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from robot.drivers.wsg50.codec import Packet, decode, encode
from tests.emulators.interrupts import until_interrupted
from tests.emulators.wsg50.faults import LineFaults
from tests.emulators.wsg50.gripper import UPDATES, EmulatedWSG50

_log = logging.getLogger(__name__)
_TICK_S = 0.001
_CHUNK = 4096


class _Cut(Exception):
    """The line was cut."""


@contextlib.contextmanager
def serve_tcp(emulator: EmulatedWSG50, faults: LineFaults | None = None, *, port: int = 0) -> Iterator[str]:
    """Serve one client at a time on 127.0.0.1 and yield the URL for the driver. Port 0 chooses a free port."""
    with socket.create_server(("127.0.0.1", port)) as server:
        server.settimeout(0.02)

        def wait_for_client(stop: threading.Event) -> _Socket | _Terminal | None:
            while not stop.is_set():
                try:
                    return _Socket(server.accept()[0])
                except TimeoutError:
                    emulator.tick()
            return None

        with _thread(lambda stop: _serve(emulator, faults or LineFaults(), wait_for_client, stop)):
            yield f"socket://127.0.0.1:{server.getsockname()[1]}"


@contextlib.contextmanager
def serve_pty(emulator: EmulatedWSG50, faults: LineFaults | None = None) -> Iterator[str]:
    """Serve a pseudo-terminal and yield its path, which stays the same after a cut.

    A cut or closed serial line does not raise a FAST STOP, because the gripper does not notice it.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "wsg50"
        first = [_Terminal(path)]

        def wait_for_client(stop: threading.Event) -> _Socket | _Terminal | None:
            return None if stop.is_set() else first.pop() if first else _Terminal(path)

        with _thread(lambda stop: _serve(emulator, faults or LineFaults(), wait_for_client, stop)):
            yield str(path)


class _Socket:
    """A TCP client."""

    def __init__(self, client: socket.socket) -> None:
        self._client = client
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.settimeout(1.0)

    def fileno(self) -> int:
        return self._client.fileno()

    def read(self) -> bytes:
        return self._client.recv(_CHUNK)

    def write(self, data: bytes) -> None:
        self._client.sendall(data)

    def close(self) -> None:
        self._client.close()


class _Terminal:
    """The gripper's end of a pseudo-terminal; `path` is a link to the other end."""

    def __init__(self, path: Path) -> None:
        self._own, self._other = os.openpty()
        tty.setraw(self._other)  # stays open, so that clients can reconnect
        os.set_blocking(self._own, False)
        fresh = path.with_suffix(".new")
        fresh.symlink_to(os.ttyname(self._other))
        fresh.replace(path)

    def fileno(self) -> int:
        return self._own

    def read(self) -> bytes:
        return os.read(self._own, _CHUNK)

    def write(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):  # without a reader the bytes are lost, as on a wire
            os.write(self._own, data)

    def close(self) -> None:
        os.close(self._own)
        os.close(self._other)


_Line = _Socket | _Terminal
"""Bytes to and from one client; reading and writing raise OSError after it disconnected."""


@contextlib.contextmanager
def _thread(work: Callable[[threading.Event], None]) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=work, args=(stop,), name="wsg50 emulator", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _serve(
    emulator: EmulatedWSG50,
    faults: LineFaults,
    wait_for_client: Callable[[threading.Event], _Line | None],
    stop: threading.Event,
) -> None:
    """Serve one client after another, whatever they send."""
    while (line := wait_for_client(stop)) is not None:
        emulator.connected()
        try:
            _Session(emulator, faults, line).run(stop)
        except (OSError, _Cut):
            pass  # the client disconnected
        except Exception:
            _log.exception("the emulated gripper failed on what a client sent; the next client is served")
        line.close()
        if isinstance(line, _Socket):
            emulator.disconnected()


class _Session:
    """The connection of one client."""

    def __init__(self, emulator: EmulatedWSG50, faults: LineFaults, line: _Line) -> None:
        self.emulator, self.faults, self.line = emulator, faults, line
        self._arrived, self._received = bytearray(), bytearray()

    def run(self, stop: threading.Event) -> None:
        """Serve until `stop` is set or the client disconnects."""
        while not stop.is_set():
            if select.select([self.line.fileno()], [], [], _TICK_S)[0]:
                self._receive()
            for packet in self.emulator.tick():
                if packet.id in UPDATES:  # faults apply to commands and their replies only
                    self.line.write(encode(packet))
                else:
                    self._send(packet)

    def _receive(self) -> None:
        data = self.line.read()
        if not data:
            raise _Cut
        self._arrived += data
        for noise, command in _packets(self._arrived):
            self._handle(noise)
            for piece in self.faults.on(command) if command else ():
                time.sleep(piece.pause_s)
                if piece.data is None:
                    raise _Cut
                self._handle(piece.data)

    def _handle(self, data: bytes) -> None:
        """Handle the bytes that remain of the sent ones after faults."""
        self._received += data
        for _, command in _packets(self._received):
            for answer in self.emulator.receive(command) if command else ():
                self._send(answer)

    def _send(self, packet: Packet) -> None:
        for piece in self.faults.on(packet):
            time.sleep(piece.pause_s)
            if piece.data is None:
                raise _Cut
            self.line.write(piece.data)


def _packets(buffer: bytearray) -> Iterator[tuple[bytes, Packet | None]]:
    """Remove the complete packets from a buffer, each with the noise before it; finally the noise behind them."""
    while True:
        used, packet = decode(buffer)
        noise = bytes(buffer[: used - len(encode(packet))] if packet else buffer[:used])
        del buffer[:used]
        yield noise, packet
        if packet is None:
            return


def main(arguments: Sequence[str] | None = None) -> None:
    """Serve until interrupted; the first printed line is the address for clients."""
    parser = argparse.ArgumentParser(description="An emulated WSG-50 gripper.")
    port = parser.add_mutually_exclusive_group(required=True)
    port.add_argument("--tcp", type=int, metavar="PORT", help="listen on 127.0.0.1 (0: any free port)")
    port.add_argument("--pty", action="store_true", help="create a pseudo-terminal")
    parser.add_argument("--object-mm", type=float, help="width of an object between the jaws")
    parser.add_argument("--speed-up", type=float, default=1.0, help="factor by which its time runs faster")
    parser.add_argument("--faults", type=float, default=0.0, metavar="RATE", help="fraction of packets with a fault")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    emulator = EmulatedWSG50(object_mm=options.object_mm, speed_up=options.speed_up)
    faults = LineFaults(options.faults, seed=options.seed)
    serving = serve_pty(emulator, faults) if options.pty else serve_tcp(emulator, faults, port=options.tcp)
    try:
        with until_interrupted(), serving as address:
            print(address, flush=True)
            threading.Event().wait()
    except OSError as error:
        parser.error(f"the address cannot be served: {error.strerror}; try another port, or --tcp 0 for a free one")
    print(f"faults: {faults.counts}", file=sys.stderr)


if __name__ == "__main__":
    main()
