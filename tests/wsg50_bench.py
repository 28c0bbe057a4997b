"""The driver of the WSG-50 with an emulated gripper, and lines that damage chosen packets."""

import contextlib
from unittest.mock import patch

import pytest
from serial.urlhandler import protocol_socket

from robot.drivers.wsg50.codec import encode
from robot.drivers.wsg50.driver import WSG50
from robot.errors import DeviceError
from tests.emulators.wsg50.faults import LineFaults, Piece
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.emulators.wsg50.server import serve_pty, serve_tcp

SERVE = {"tcp": serve_tcp, "pty": serve_pty}
QUICK = {"timeout_s": 0.3, "reconnect_s": 0.01, "max_state_age_s": 0.5, "opening_speed_mm_s": 400.0}
HOME, MOVE, STOP, FAST_STOP, ACK, GRASP, RELEASE = 0x20, 0x21, 0x22, 0x23, 0x24, 0x25, 0x26


PORTS = pytest.mark.parametrize("port", SERVE)


class ScriptedFaults(LineFaults):
    """Damages packets by a plan: (id, number of the packet with this id) -> kind of damage, or id -> kind for all.

    Counting starts when a plan is set. Commands and replies count together: 1 is the command, 2 its first reply.
    """

    def __init__(self):
        super().__init__()
        self.plan, self.packet_counts = {}, {}

    def tell(self, plan):
        self.plan, self.packet_counts = plan, {}

    def on(self, packet):
        self.packet_counts[packet.id] = self.packet_counts.get(packet.id, 0) + 1
        kind = self.plan.get((packet.id, self.packet_counts[packet.id])) or self.plan.get(packet.id)
        plain = encode(packet)
        if kind == "long":  # claims 255 bytes, so the next packets are read as its payload
            return [Piece(plain[:4] + b"\xff\x00" + plain[6:])]
        return list(self._damaged(kind, plain) if kind else [Piece(plain)])


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
