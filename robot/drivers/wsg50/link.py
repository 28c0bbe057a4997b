"""The line to a WSG-50, serial or TCP: commands out, replies and updates in, each wait with a deadline.

Replies, results of motions and automatic updates come interleaved, and only their ids tell them apart; a reply that
comes late bears the same id as the one that is waited for. So after anything has gone wrong the line is in doubt, and
before the next command is sent the gripper is made to echo a token that nobody has used: it answers in the order in
which it is asked, so whatever comes before the echo is old and is dropped.

Reading is done by whoever waits: updates are only wanted while something is waited for. A wait ends at its deadline
whatever still comes.
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
"""Share of the time-out after which a packet that has begun is given up: the rest of it is not coming."""

_PADDING = bytes(MAX_PAYLOAD + 8)
"""Ends any packet that the gripper may still be waiting for the rest of, and can begin none."""

_MAX_READS = 6
"""So often, 4096 bytes at a time, is taken in what has come by the end of a wait: more than gathers in ten seconds in
which this program is held up. A peer that sends without end, if byte by byte, must not hold it up for longer."""

_MAX_TIMEOUTS = 3.0
"""So many time-outs after a question was first asked it is not asked again."""

_CHUNK = 4096
_LOOP_POLL_S = 0.001


class LinkLost(DeviceError):
    """The port cannot be opened, is gone, or was closed by the other side."""


class NoReply(DeviceError):
    """The gripper did not answer in time, or heard a damaged command; whether it heard it is not known."""


class NoEcho(NoReply):
    """Nobody is there: asking again is of no use."""


class CommandFailed(DeviceError):
    """The gripper answered with another status than SUCCESS."""

    def __init__(self, command_id: int, status: Status) -> None:
        super().__init__(f"the gripper answered {command_name(command_id)} with {status.name} (status {int(status)})")
        self.status = status


class Port:
    """An open port. name: a path, or an URL of pyserial such as socket://192.168.1.20:1000. Raises DeviceError.

    pyserial's settings are the same for all kinds; a socket takes them and ignores them.
    """

    def __init__(self, name: str, *, baud: int, stop_bits: int, write_timeout_s: float) -> None:
        try:
            serial = import_module("serial")
        except ImportError as error:
            raise DeviceError(
                "the WSG-50 driver needs pyserial, which is missing; run pip install 'touch-retrieval[gripper]'"
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
            self._serial.reset_input_buffer = lambda: None  # pyserial's does not end while a socket's peer sends
            self._serial.open()
        except Exception as error:  # pyserial lets termios.error, ValueError and others out
            raise LinkLost(f"the gripper's port {name} cannot be opened: {_first_line(error)}") from error

    def read(self, timeout_s: float) -> bytes:
        """What has come, waiting for the first byte at most `timeout_s`; empty at the end of that."""
        try:
            if not self._readable(max(0.0, timeout_s)):
                return b""
            data: bytes = self._serial.read(_CHUNK)  # with a time-out of 0 it returns what there is
            return data
        except (OSError, ValueError, TypeError) as error:  # a closed one is None to select
            raise LinkLost(
                f"the gripper's port {self.name} is gone: {_first_line(error)}; see to its cable and power, "
                "recover() opens it again"
            ) from error

    def write(self, data: bytes) -> None:
        """Send all of it."""
        try:
            while data:
                data = data[self._serial.write(data) :]
        except (OSError, ValueError, TypeError) as error:
            raise LinkLost(
                f"the gripper's port {self.name} takes no bytes: {_first_line(error)}; see to its cable and power, "
                "recover() opens it again"
            ) from error

    def close(self) -> None:
        """Never raises."""
        sock = getattr(self._serial, "_socket", None)
        try:
            self._serial.close()
        except Exception:
            return  # what cannot be closed is gone
        finally:
            if sock is not None:  # pyserial leaves its socket open where the other side went first
                sock.close()

    def _readable(self, timeout_s: float) -> bool:
        try:
            return bool(select.select([self._serial.fileno()], [], [], timeout_s)[0])
        except io.UnsupportedOperation:  # loop:// has nothing that the system could wait for
            deadline = time.monotonic() + timeout_s
        while not self._serial.in_waiting:
            if time.monotonic() >= deadline:
                return False
            time.sleep(_LOOP_POLL_S)
        return True


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]


class Link:
    """A line to one gripper. port, baud, stop_bits: as Port takes them. timeout_s: of each answer, an echo's too.
    Raises LinkLost, NoReply, CommandFailed, WireError, all of them DeviceError.

    Whatever comes or does not come, `poll` and `pump` end when told to, `send_urgent` after one time-out, `sync` after 3,
    `call` after 4, and `send` and `query`, which may ask three times, after 7 at the latest.

    counts: what went wrong, by kind. updates: of each command that updates itself, its parameters and when they came
    (s of time.monotonic).
    """

    def __init__(self, port: str, *, baud: int = 115200, stop_bits: int = 1, timeout_s: float = 1.0) -> None:
        self.name, self.baud, self.stop_bits, self.timeout_s = port, baud, stop_bits, timeout_s
        self.counts: Counter[str] = Counter()
        self.updates: dict[int, tuple[bytes, float]] = {}
        self.has_echoed = False
        """Whether a gripper has answered over the port that is open now."""
        self._port: Port | None = None
        self._buffer = bytearray()
        self._last_byte_s = 0.0
        self._needs_sync = True
        self._tokens = itertools.count(int.from_bytes(os.urandom(6), "little"))

    @property
    def is_open(self) -> bool:
        """Whether the port is open, as far as is known."""
        return self._port is not None

    def open(self) -> None:
        """Open the port, if it is not open. Sends nothing."""
        if self._port is None:
            self._port = Port(self.name, baud=self.baud, stop_bits=self.stop_bits, write_timeout_s=self.timeout_s)
            self._buffer.clear()
            self.updates.clear()
            self._needs_sync = True

    def close(self) -> None:
        """Close the port, if it is open; never raises."""
        port, self._port, self.has_echoed = self._port, None, False
        if port is not None:
            port.close()

    def call(self, packet: Packet) -> bytes:
        """Send a command once; returns the parameters of its reply."""
        self.begin(packet)
        return self._result(packet.id)

    def send(self, packet: Packet) -> None:
        """Send a command that may be said twice: it is said again where no sound reply comes."""
        self.query(packet, bytes)

    def query(self, packet: Packet, parse: Callable[[bytes], _T]) -> _T:
        """As `send`; returns what its reply holds. A reply that cannot be parsed is not sound."""
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
        """Send a command whose replies `poll` fetches; clears the line first if it is in doubt."""
        self.pump(0.0)
        if self._needs_sync:
            self.sync()
        self._needs_sync = True
        self._write(packet)

    def poll(self, command_id: int, timeout_s: float) -> Status | None:
        """Status of the next reply to this command, PENDING too, or None after `timeout_s`. Notes updates."""
        for packet in self._packets(timeout_s):
            if self._note(packet, command_id) and (reply := self._reply(packet)):
                return reply[0]
        return None

    def send_urgent(self, packet: Packet) -> None:
        """Send at once, whatever is under way, and wait for a reply: for stops, of which an older reply does."""
        try:
            self._write(packet)
            self._result(packet.id)
        finally:
            self._needs_sync = True

    def sync(self) -> None:
        """Have a fresh token echoed, and drop whatever comes before it."""
        for number in range(_TRIES):
            if number:
                self.pad()
            token = next(self._tokens).to_bytes(8, "little")
            self._write(Packet(CommandId.LOOP, token))
            if self._wait_for_echo(Packet(CommandId.LOOP, bytes(2) + token)):
                self._needs_sync, self.has_echoed = False, True
                return
            self.counts["no echo"] += 1
        raise NoEcho(f"the gripper at {self.name} must answer within {self.timeout_s:g} s; is it on, and connected?")

    def pad(self) -> None:
        """Free the gripper of a packet whose damaged length swallows what it is told next: before saying it again."""
        self._use_port(lambda port: port.write(_PADDING))

    def require_sync(self) -> None:
        """Have the line cleared before the next command."""
        self._needs_sync = True

    def pump(self, seconds: float) -> None:
        """Note what comes within `seconds`; 0 for what has come."""
        for packet in self._packets(seconds):
            self._note(packet, None)

    def _wait_for_echo(self, echo: Packet) -> bool:
        for packet in self._packets(self.timeout_s):
            if packet == echo:
                return True
            self._note(packet, None)
        return False

    def _result(self, command_id: int) -> bytes:
        """Parameters of the last reply to the command begun last."""
        for packet in self._packets(self.timeout_s):
            reply = self._reply(packet) if self._note(packet, command_id) else None
            if reply is None or reply[0] is Status.CMD_PENDING:
                continue
            self._needs_sync = False
            if reply[0] is Status.CHECKSUM_ERROR:
                raise NoReply(
                    f"the gripper must hear {command_name(command_id)} undamaged, and did not (CHECKSUM_ERROR)"
                )
            if reply[0] is not Status.SUCCESS:
                raise CommandFailed(command_id, reply[0])
            return reply[1]
        raise NoReply(f"the gripper must answer {command_name(command_id)} within {self.timeout_s:g} s, and did not")

    def _note(self, packet: Packet, command_id: int | None) -> bool:
        """Keep an update; says whether the packet is of the command that is waited for. Any other raises doubt."""
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
        """What comes within `seconds`, and then what has come by then. A packet that stops half-way is given up."""
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
        """Take in bytes as soon as they come, or give up a packet whose rest does not."""
        given_up_s = self._last_byte_s + _GAP_FRACTION * self.timeout_s if self._buffer else deadline
        came = self._fill(min(deadline, given_up_s) - time.monotonic())
        if not came and self._buffer and time.monotonic() >= given_up_s:
            self.counts["abandoned"] += 1
            del self._buffer[:1]

    def _fill(self, seconds: float) -> bool:
        """Take in bytes; False where none come within `seconds`."""
        data = self._use_port(lambda port: port.read(seconds))
        if data:
            self._buffer += data
            self._last_byte_s = time.monotonic()
        return bool(data)

    def _write(self, packet: Packet) -> None:
        self._use_port(lambda port: port.write(encode(packet)))

    def _use_port(self, use: Callable[[Port], _T]) -> _T:
        """Use the port, and close it where it is gone."""
        if self._port is None:
            raise LinkLost(
                f"the gripper's port {self.name} must be open, and was lost; see to its cable and power, "
                "recover() opens it again"
            )
        try:
            return use(self._port)
        except LinkLost:
            self.close()
            raise
