"""Link to a WSG-50, serial or TCP: sends commands, receives replies and updates, each wait with a deadline.

Replies, results of motions and automatic updates arrive interleaved and are distinguished only by their ids. A late
reply has the same id as the expected one. Therefore the link synchronises after every error: before the next command,
the gripper must echo a fresh token. It answers in the order of its commands, so all packets before the echo are old
and are dropped.

There is no reader thread: the waiting caller reads, because updates matter only during a wait.
"""

import itertools
import os
import select
import time
from collections.abc import Callable, Iterator
from operator import methodcaller
from typing import Any, TypeVar

from robot.drivers.packages import import_package
from robot.drivers.wsg50 import codec
from robot.drivers.wsg50.codec import MAX_PAYLOAD, CommandId, Packet, Status, WireError, command_name, decode, encode
from robot.errors import DeviceError

_T = TypeVar("_T")
_TRIES = 3
_GAP_FRACTION = 0.25
"""Fraction of the time-out without bytes after which an incomplete packet is abandoned."""

_PADDING = bytes(MAX_PAYLOAD + 8)
"""Completes any packet whose rest the gripper may still expect, and begins none."""

_CHUNK = 1 << 16
"""Bytes of a read, more than ten seconds of updates, in case this program was suspended."""


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


class Link:
    """The link to one gripper. Its methods raise LinkLost, NoReply, CommandFailed or WireError, all DeviceErrors.

    Args:
        name: Name of the port: a path, or a URL of pyserial such as socket://192.168.1.20:1000.
        baud: Baud rate of a serial port.
        stop_bits: Stop bits of a serial port.
        timeout_s: Time-out of each answer and echo.

    Attributes:
        updates: For each updating command, its last parameters and their time of arrival (s, time.monotonic).
        has_echoed: Whether a gripper has answered over the open port.
        needs_sync: Whether the next command must synchronise first.
    """

    def __init__(self, name: str, *, baud: int = 115200, stop_bits: int = 1, timeout_s: float = 1.0) -> None:
        self.name, self.baud, self.stop_bits, self.timeout_s = name, baud, stop_bits, timeout_s
        self.updates: dict[int, tuple[bytes, float]] = {}
        self.has_echoed = False
        self._port: Any = None
        self._buffer = bytearray()
        self._last_byte_s = 0.0
        self.needs_sync = True
        self._tokens = itertools.count(int.from_bytes(os.urandom(6), "little"))

    @property
    def is_open(self) -> bool:
        """Whether the port is open, as far as this side has noticed."""
        return self._port is not None

    def open(self) -> None:
        """Open the port if it is closed; send nothing."""
        if self._port is not None:
            return
        serial = import_package("serial", "a WSG-50", "gripper")
        try:
            self._port = serial.serial_for_url(
                self.name,
                baudrate=self.baud,
                stopbits=self.stop_bits,
                timeout=0,
                write_timeout=self.timeout_s,
                exclusive=True,
            )
        except Exception as error:  # pyserial raises termios.error, ValueError and others too
            raise LinkLost(f"the gripper's port {self.name} cannot be opened: {_first_line(error)}") from error
        self._buffer.clear()
        self.updates.clear()
        self.needs_sync = True

    def close(self) -> None:
        """Close the port if it is open; never raises."""
        port, self._port, self.has_echoed = self._port, None, False
        sock = getattr(port, "_socket", None)
        try:
            if port is not None:
                port.close()
        except Exception:
            return
        finally:
            if sock is not None:  # pyserial leaves its socket open if the peer closed first
                sock.close()

    def call(self, packet: Packet) -> bytes:
        """Send a command once and return the parameters of its reply."""
        self.begin(packet)
        return self._result(packet.id)

    def send(self, packet: Packet) -> None:
        """Send an idempotent command; send it again if no valid reply arrives."""
        self.query(packet, bytes)

    def query(self, packet: Packet, parse: Callable[[bytes], _T]) -> _T:
        """Send an idempotent command as `send` does and return its parsed reply."""
        for left in reversed(range(_TRIES)):
            try:
                return parse(self.call(packet))
            except NoEcho:
                raise
            except (NoReply, WireError):
                if not left:
                    raise
                self.needs_sync = True
        raise AssertionError("the loop returns or raises")

    def begin(self, packet: Packet) -> None:
        """Send a command whose replies `poll` returns; synchronise first if necessary."""
        self.pump(0.0)
        if self.needs_sync:
            self.sync()
        self.needs_sync = True
        self._write(encode(packet))

    def poll(self, command_id: int, timeout_s: float) -> Status | None:
        """Return the status of the next reply to a command, PENDING too, or None after `timeout_s`."""
        return next((status for status, _ in self._replies(command_id, timeout_s)), None)

    def send_urgent(self, packet: Packet) -> None:
        """Send a stop at once, without synchronisation, and wait for a reply; an older reply is sufficient."""
        try:
            self._write(encode(packet))
            self._result(packet.id)
        finally:
            self.needs_sync = True

    def sync(self) -> None:
        """Synchronise: have the gripper echo a fresh token, and drop all packets before it."""
        for number in range(_TRIES):
            if number:
                self.pad()
            token = next(self._tokens).to_bytes(8, "little")
            self._write(encode(Packet(CommandId.LOOP, token)))
            echo = Packet(CommandId.LOOP, bytes(2) + token)
            if any(packet == echo for packet in self._packets(self.timeout_s)):
                self.needs_sync, self.has_echoed = False, True
                return
        raise NoEcho(f"the gripper at {self.name} did not answer within {self.timeout_s:g} s; is it on and connected?")

    def pad(self) -> None:
        """Complete a packet whose damaged length would swallow the next command; call it before a repetition."""
        self._write(_PADDING)

    def pump(self, seconds: float) -> None:
        """Process the packets that arrive within `seconds`; 0: those that have arrived."""
        for packet in self._packets(seconds):
            self.needs_sync |= packet.id not in codec.UPDATING

    def _result(self, command_id: int) -> bytes:
        """Return the parameters of the final reply to the last command."""
        for status, parameters in self._replies(command_id, self.timeout_s):
            if status is Status.CMD_PENDING:
                continue
            self.needs_sync = False
            if status is Status.CHECKSUM_ERROR:
                raise NoReply(f"the gripper received {command_name(command_id)} damaged (CHECKSUM_ERROR)")
            if status is not Status.SUCCESS:
                raise CommandFailed(command_id, status)
            return parameters
        raise NoReply(f"the gripper did not answer {command_name(command_id)} within {self.timeout_s:g} s")

    def _replies(self, command_id: int, seconds: float) -> Iterator[tuple[Status, bytes]]:
        """Yield status and parameters of the replies to a command that arrive within `seconds`."""
        for packet in self._packets(seconds):
            if packet.id == command_id and len(packet.payload) >= 2:
                yield codec.reply(packet)

    def _packets(self, seconds: float) -> Iterator[Packet]:
        """Yield the packets that arrive within `seconds`, store updates, and abandon an incomplete packet."""
        deadline, gap_s = time.monotonic() + seconds, _GAP_FRACTION * self.timeout_s
        is_last = False
        while True:
            used, packet = decode(self._buffer)
            del self._buffer[:used]
            if packet is not None:
                if packet.id in codec.UPDATING and packet.payload[:2] == bytes(2):
                    self.updates[packet.id] = (packet.payload[2:], time.monotonic())
                yield packet
                continue
            if is_last:
                return
            now = time.monotonic()
            is_last = now >= deadline
            limit = min(deadline, self._last_byte_s + gap_s) if self._buffer else deadline
            if not self._fill(limit - now) and self._buffer and time.monotonic() >= self._last_byte_s + gap_s:
                del self._buffer[:1]

    def _fill(self, seconds: float) -> bool:
        """Read bytes into the buffer; return False if none arrive within `seconds`."""
        with_bytes = self._use_port(lambda port: select.select([port.fileno()], [], [], max(0.0, seconds))[0])
        if with_bytes:
            self._buffer += self._use_port(methodcaller("read", _CHUNK))  # its time-out is 0, so it does not wait
            self._last_byte_s = time.monotonic()
        return bool(with_bytes)

    def _write(self, data: bytes) -> None:
        while data:
            data = data[self._use_port(methodcaller("write", data)) :]

    def _use_port(self, use: Callable[[Any], Any]) -> Any:
        """Use the port; close it and raise LinkLost if it was lost."""
        reason = "it is closed"
        if self._port is not None:
            try:
                return use(self._port)
            except (OSError, ValueError, TypeError) as error:  # select gets None from a closed port
                reason = _first_line(error)
                self.close()
        raise LinkLost(
            f"the gripper's port {self.name} was lost: {reason}; check its cable and power, recover() opens it again"
        )


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
