"""A serial or TCP port to a WSG-50: bytes in and out with deadlines, whatever pyserial does underneath."""

import io
import select
import time
from importlib import import_module
from typing import Any

from robot.errors import DeviceError

_CHUNK = 4096
_LOOP_POLL_S = 0.001


class LinkLost(DeviceError):
    """The port cannot be opened, is gone, or was closed by the other side."""


class Port:
    """An open port. name: a path, or an URL of pyserial such as socket://192.168.1.20:1000. Raises DeviceError.

    pyserial's settings are the same for all kinds; a socket takes them and ignores them.
    """

    def __init__(self, name: str, *, baud: int, stop_bits: int, write_timeout_s: float) -> None:
        serial = _pyserial()
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
            raise LinkLost(f"the gripper's port {name} cannot be opened: {_words(error)}") from error

    def read(self, timeout_s: float) -> bytes:
        """What has come, waiting for the first byte at most `timeout_s`; empty at the end of that."""
        try:
            if not self._readable(max(0.0, timeout_s)):
                return b""
            data: bytes = self._serial.read(_CHUNK)  # with a time-out of 0 it returns what there is
            return data
        except (OSError, ValueError, TypeError) as error:  # a closed one is None to select
            raise LinkLost(
                f"the gripper's port {self.name} is gone: {_words(error)}; see to its cable and power, "
                "recover() opens it again"
            ) from error

    def write(self, data: bytes) -> None:
        """Send all of it."""
        try:
            while data:
                data = data[self._serial.write(data) :]
        except (OSError, ValueError, TypeError) as error:
            raise LinkLost(
                f"the gripper's port {self.name} takes no bytes: {_words(error)}; see to its cable and power, "
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
            number = self._serial.fileno()
        except io.UnsupportedOperation:
            return self._readable_without_number(timeout_s)
        return bool(select.select([number], [], [], timeout_s)[0])

    def _readable_without_number(self, timeout_s: float) -> bool:
        """loop:// has nothing that the system could wait for."""
        deadline = time.monotonic() + timeout_s
        while not self._serial.in_waiting:
            if time.monotonic() >= deadline:
                return False
            time.sleep(_LOOP_POLL_S)
        return True


def _pyserial() -> Any:
    try:
        return import_module("serial")
    except ImportError as error:
        raise DeviceError(
            "the WSG-50 driver needs pyserial, which is missing; run pip install 'touch-retrieval[gripper]'"
        ) from error


def _words(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
