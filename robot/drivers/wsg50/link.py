"""Link to a WSG-50, serial or TCP: sends commands, receives replies and updates, each wait with a deadline.

Replies, results of motions and automatic updates arrive interleaved and are distinguished only by their ids. A late
reply has the same id as the expected one. Therefore the link synchronises after every error: before the next command,
the gripper must echo a fresh token. It answers in the order of its commands, so all packets before the echo are old
and are dropped.

There is no reader thread: the waiting caller reads, because updates matter only during a wait.
"""

import io
import itertools
import os
import select
import time
from collections import Counter
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any, TypeVar

from robot.drivers.wsg50 import commands
from robot.drivers.wsg50.codec import MAX_PAYLOAD, Packet, WireError, decode, encode
from robot.drivers.wsg50.commands import CommandId, Status, command_name
from robot.errors import DeviceError

_T = TypeVar("_T")
_TRIES = 3
_GAP_FRACTION = 0.25
"""Fraction of the time-out without bytes after which an incomplete packet is abandoned."""

_PADDING = bytes(MAX_PAYLOAD + 8)
"""Completes any packet whose rest the gripper may still expect, and begins none."""

_MAX_READS = 6
"""Number of reads of 4096 bytes after the end of a wait.

It exceeds ten seconds of updates at the default period, in case this program was suspended. The limit protects against
a peer that sends without end.
"""

_MAX_TIMEOUTS = 3.0
"""A query is not repeated later than this number of time-outs after its first try."""

_CHUNK = 4096
_LOOP_POLL_S = 0.001


class LinkLost(DeviceError):
    """The port cannot be opened, was lost, or was closed by the gripper."""


class NoReply(DeviceError):
    """The gripper did not answer in time, or received a damaged command; it may have executed the command."""


class NoEcho(NoReply):
    """The gripper does not answer at all, so retries are useless."""


class CommandFailed(DeviceError):
    """The gripper answered with a status other than SUCCESS."""

    def __init__(self, command_id: int, status: Status) -> None:
        super().__init__(f"the gripper answered {command_name(command_id)} with {status.name} (status {int(status)})")
        self.status = status


class Port:
    """An open port. Its methods raise LinkLost.

    Args:
        name: A path, or a URL of pyserial such as socket://192.168.1.20:1000.
        baud: Baud rate of a serial port; a socket ignores it.
        stop_bits: Stop bits of a serial port; a socket ignores them.
        write_timeout_s: Time-out of a write.

    Raises:
        DeviceError: pyserial is missing, or the port cannot be opened (LinkLost).
    """

    def __init__(self, name: str, *, baud: int, stop_bits: int, write_timeout_s: float) -> None:
        try:
            serial = import_module("serial")
        except ImportError as error:
            raise DeviceError(
                "the WSG-50 driver requires pyserial, which is missing; run pip install 'touch-retrieval[gripper]'"
            ) from error
        self.name = name
        try:
            self._serial: Any = serial.serial_for_url(
                name,
                do_not_open=True,
                baudrate=baud,
                stopbits=stop_bits,
                timeout=0,
                write_timeout=write_timeout_s,
                exclusive=True,
            )
            # pyserial's own method never returns while a socket's peer sends.
            self._serial.reset_input_buffer = lambda: None
            self._serial.open()
        except Exception as error:  # pyserial raises termios.error, ValueError and others too
            raise LinkLost(f"the gripper's port {name} cannot be opened: {_first_line(error)}") from error

    def read(self, timeout_s: float) -> bytes:
        """Return the received bytes; wait up to `timeout_s` for the first one, else return b""."""
        try:
            if not self._readable(max(0.0, timeout_s)):
                return b""
            data: bytes = self._serial.read(_CHUNK)  # its time-out is 0, so it does not wait
            return data
        except (OSError, ValueError, TypeError) as error:  # select gets None from a closed port
            raise LinkLost(
                f"the gripper's port {self.name} was lost: {_first_line(error)}; check its cable and power, "
                "recover() opens it again"
            ) from error

    def write(self, data: bytes) -> None:
        """Send all bytes."""
        try:
            while data:
                data = data[self._serial.write(data) :]
        except (OSError, ValueError, TypeError) as error:
            raise LinkLost(
                f"the gripper's port {self.name} accepts no bytes: {_first_line(error)}; check its cable and power, "
                "recover() opens it again"
            ) from error

    def close(self) -> None:
        """Close the port; never raises."""
        sock = getattr(self._serial, "_socket", None)
        try:
            self._serial.close()
        except Exception:
            return
        finally:
            if sock is not None:  # pyserial leaves its socket open if the peer closed first
                sock.close()

    def _readable(self, timeout_s: float) -> bool:
        try:
            return bool(select.select([self._serial.fileno()], [], [], timeout_s)[0])
        except io.UnsupportedOperation:  # loop:// has no file descriptor
            deadline = time.monotonic() + timeout_s
        while not self._serial.in_waiting:
            if time.monotonic() >= deadline:
                return False
            time.sleep(_LOOP_POLL_S)
        return True


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]


class Link:
    """The link to one gripper. Its methods raise LinkLost, NoReply, CommandFailed or WireError, all DeviceErrors.

    All calls end in bounded time: `poll` and `pump` after the given time, `send_urgent` after one time-out, `sync`
    after 3, `call` after 4, and `send` and `query`, with up to three tries, after 7.

    Args:
        port: Name of the port; see `Port`.
        baud: Baud rate of a serial port.
        stop_bits: Stop bits of a serial port.
        timeout_s: Time-out of each answer and echo.

    Attributes:
        counts: Numbers of errors by kind.
        updates: For each updating command, its last parameters and their time of arrival (s, time.monotonic).
        has_echoed: Whether a gripper has answered over the open port.
    """

    def __init__(self, port: str, *, baud: int = 115200, stop_bits: int = 1, timeout_s: float = 1.0) -> None:
        self.name, self.baud, self.stop_bits, self.timeout_s = port, baud, stop_bits, timeout_s
        self.counts: Counter[str] = Counter()
        self.updates: dict[int, tuple[bytes, float]] = {}
        self.has_echoed = False
        self._port: Port | None = None
        self._buffer = bytearray()
        self._last_byte_s = 0.0
        self._needs_sync = True
        self._tokens = itertools.count(int.from_bytes(os.urandom(6), "little"))

    @property
    def is_open(self) -> bool:
        """Whether the port is open, as far as this side has noticed."""
        return self._port is not None

    def open(self) -> None:
        """Open the port if it is closed; send nothing."""
        if self._port is None:
            self._port = Port(self.name, baud=self.baud, stop_bits=self.stop_bits, write_timeout_s=self.timeout_s)
            self._buffer.clear()
            self.updates.clear()
            self._needs_sync = True

    def close(self) -> None:
        """Close the port if it is open; never raises."""
        port, self._port, self.has_echoed = self._port, None, False
        if port is not None:
            port.close()

    def call(self, packet: Packet) -> bytes:
        """Send a command once and return the parameters of its reply."""
        self.begin(packet)
        return self._result(packet.id)

    def send(self, packet: Packet) -> None:
        """Send an idempotent command; send it again if no valid reply arrives."""
        self.query(packet, bytes)

    def query(self, packet: Packet, parse: Callable[[bytes], _T]) -> _T:
        """Send an idempotent command as `send` does and return its parsed reply."""
        until = time.monotonic() + _MAX_TIMEOUTS * self.timeout_s
        for left in reversed(range(_TRIES)):
            try:
                return parse(self.call(packet))
            except NoEcho:
                raise
            except (NoReply, WireError):
                if not left or time.monotonic() > until:
                    raise
                self.counts["retried"] += 1
                self._needs_sync = True
        raise AssertionError("the loop returns or raises")

    def begin(self, packet: Packet) -> None:
        """Send a command whose replies `poll` returns; synchronise first if necessary."""
        self.pump(0.0)
        if self._needs_sync:
            self.sync()
        self._needs_sync = True
        self._write(packet)

    def poll(self, command_id: int, timeout_s: float) -> Status | None:
        """Return the status of the next reply to a command, PENDING too, or None after `timeout_s`."""
        for packet in self._packets(timeout_s):
            if self._note(packet, command_id) and (reply := self._reply(packet)):
                return reply[0]
        return None

    def send_urgent(self, packet: Packet) -> None:
        """Send a stop at once, without synchronisation, and wait for a reply; an older reply is sufficient."""
        try:
            self._write(packet)
            self._result(packet.id)
        finally:
            self._needs_sync = True

    def sync(self) -> None:
        """Synchronise: have the gripper echo a fresh token, and drop all packets before it."""
        for number in range(_TRIES):
            if number:
                self.pad()
            token = next(self._tokens).to_bytes(8, "little")
            self._write(Packet(CommandId.LOOP, token))
            if self._wait_for_echo(Packet(CommandId.LOOP, bytes(2) + token)):
                self._needs_sync, self.has_echoed = False, True
                return
            self.counts["no echo"] += 1
        raise NoEcho(f"the gripper at {self.name} did not answer within {self.timeout_s:g} s; is it on and connected?")

    def pad(self) -> None:
        """Complete a packet whose damaged length would swallow the next command; call it before a repetition."""
        self._use_port(lambda port: port.write(_PADDING))

    def require_sync(self) -> None:
        """Make the next command synchronise first."""
        self._needs_sync = True

    def pump(self, seconds: float) -> None:
        """Process the packets that arrive within `seconds`; 0: those that have arrived."""
        for packet in self._packets(seconds):
            self._note(packet, None)

    def _wait_for_echo(self, echo: Packet) -> bool:
        for packet in self._packets(self.timeout_s):
            if packet == echo:
                return True
            self._note(packet, None)
        return False

    def _result(self, command_id: int) -> bytes:
        """Return the parameters of the final reply to the last command."""
        for packet in self._packets(self.timeout_s):
            reply = self._reply(packet) if self._note(packet, command_id) else None
            if reply is None or reply[0] is Status.CMD_PENDING:
                continue
            self._needs_sync = False
            if reply[0] is Status.CHECKSUM_ERROR:
                raise NoReply(f"the gripper received {command_name(command_id)} damaged (CHECKSUM_ERROR)")
            if reply[0] is not Status.SUCCESS:
                raise CommandFailed(command_id, reply[0])
            return reply[1]
        raise NoReply(f"the gripper did not answer {command_name(command_id)} within {self.timeout_s:g} s")

    def _note(self, packet: Packet, command_id: int | None) -> bool:
        """Store an update; return whether the packet is of this command. Any other packet requires synchronisation."""
        if packet.id in commands.UPDATING:
            if packet.payload[:2] == bytes(2):
                self.updates[packet.id] = (packet.payload[2:], time.monotonic())
        elif packet.id != command_id:
            self.counts["unexpected"] += 1
            self._needs_sync = True
        return packet.id == command_id

    def _reply(self, packet: Packet) -> tuple[Status, bytes] | None:
        try:
            return commands.reply(packet)
        except WireError:
            self.counts["no status"] += 1
            return None

    def _packets(self, seconds: float) -> Iterator[Packet]:
        """Yield the packets that arrive within `seconds`; abandon an incomplete packet."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if packet := self._next_packet():
                yield packet
            else:
                self._wait(deadline)
        for _ in range(_MAX_READS):
            if not self._fill(0.0):
                break
        while packet := self._next_packet():
            yield packet

    def _next_packet(self) -> Packet | None:
        used, packet = decode(self._buffer)
        del self._buffer[:used]
        return packet

    def _wait(self, deadline: float) -> None:
        """Wait for bytes; abandon an incomplete packet if none arrive."""
        abandon_s = self._last_byte_s + _GAP_FRACTION * self.timeout_s if self._buffer else deadline
        has_read = self._fill(min(deadline, abandon_s) - time.monotonic())
        if not has_read and self._buffer and time.monotonic() >= abandon_s:
            self.counts["abandoned"] += 1
            del self._buffer[:1]

    def _fill(self, seconds: float) -> bool:
        """Read bytes into the buffer; return False if none arrive within `seconds`."""
        data = self._use_port(lambda port: port.read(seconds))
        if data:
            self._buffer += data
            self._last_byte_s = time.monotonic()
        return bool(data)

    def _write(self, packet: Packet) -> None:
        self._use_port(lambda port: port.write(encode(packet)))

    def _use_port(self, use: Callable[[Port], _T]) -> _T:
        """Use the port, and close it if it was lost."""
        if self._port is None:
            raise LinkLost(
                f"the gripper's port {self.name} is closed or was lost; check its cable and power, "
                "recover() opens it again"
            )
        try:
            return use(self._port)
        except LinkLost:
            self.close()
            raise
