"""The driver of the WSG-50 with an emulated gripper."""

import contextlib
from unittest.mock import patch

import pytest
from serial.urlhandler import protocol_socket

from robot.drivers.wsg50.driver import WSG50
from robot.errors import DeviceError
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.emulators.wsg50.server import serve_pty, serve_tcp

SERVE = {"tcp": serve_tcp, "pty": serve_pty}
QUICK = {"timeout_s": 0.3, "reconnect_s": 0.01, "max_state_age_s": 0.5, "opening_speed_mm_s": 400.0}
HOME, MOVE, STOP, FAST_STOP, ACK, GRASP, RELEASE = 0x20, 0x21, 0x22, 0x23, 0x24, 0x25, 0x26
PORTS = pytest.mark.parametrize("port", SERVE)


def quick_close():
    """Skip the 0.3 s that pyserial waits after closing a socket."""
    return patch.object(protocol_socket, "time", type("NoWait", (), {"sleep": staticmethod(lambda _: None)}))


@contextlib.contextmanager
def gripper_with_emulator(port="tcp", faults=None, connect=True, emulator=None, **settings):
    """Yield a driver, connected or not, and its emulated gripper."""
    emulator = emulator or EmulatedWSG50(referenced=True, speed_up=20.0)
    with SERVE[port](emulator, faults) as address, quick_close():
        gripper = WSG50(port=address, **QUICK | settings)
        if connect:
            gripper.connect()
        try:
            yield gripper, emulator
        finally:
            with contextlib.suppress(DeviceError):
                gripper.close()
