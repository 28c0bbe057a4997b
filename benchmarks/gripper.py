"""What the line to a WSG-50 costs, against the emulated one: a command's round trip, a reading, a grasp, updates."""

import time
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.common import ResultLine, duration
from robot.drivers.wsg50 import commands
from robot.drivers.wsg50.codec import Packet
from robot.drivers.wsg50.commands import CommandId
from robot.drivers.wsg50.driver import WSG50
from robot.drivers.wsg50.link import Link
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.emulators.wsg50.server import serve_pty, serve_tcp

PORTS = {"TCP": serve_tcp, "pty": serve_pty}
SPEED_UP = 100.0


def measure(trips: int = 1000, grasps: int = 20, seconds: float = 2.0) -> Iterator[ResultLine]:
    """For each kind of port: round trips of LOOP, readings of the state, grasps that take no time, updates of 1 ms.

    The emulator looks at its port at once when bytes come, and every millisecond at what it has to say unasked.
    """
    for port, serve in PORTS.items():
        with serve(EmulatedWSG50(object_mm=40.0, referenced=True, speed_up=SPEED_UP)) as address:
            link = Link(address)
            link.open()
            try:
                yield _times(
                    port, "round trip of a command", trips, lambda link=link: link.call(Packet(CommandId.LOOP, b"abcd"))
                )
                yield _updates(port, link, seconds)
                link.send(Packet(CommandId.DISCONNECT))
            finally:
                link.close()
            with WSG50(port=address) as gripper:
                yield _times(port, "state, four questions", trips // 4, gripper.state)
                yield _times(port, f"open and grasp, {SPEED_UP:g} times as fast", grasps, lambda g=gripper: _cycle(g))


def _cycle(gripper: WSG50) -> None:
    gripper.open(60.0)
    gripper.grasp(10.0, 400.0)


def _times(port: str, what: str, count: int, call: Callable[[], object]) -> ResultLine:
    seconds = []
    for _ in range(count):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    median, slow = (float(each) for each in np.quantile(seconds, [0.5, 0.99]))
    text = f"{what}: {duration(median)} median, {duration(slow)} in 1 of 100"
    return ResultLine("gripper", port, text, {"median_s": median, "quantile_99_s": slow})


def _updates(port: str, link: Link, seconds: float) -> ResultLine:
    """Count state updates asked for every millisecond."""
    link.send(commands.update(CommandId.SYSTEM_STATE, 1))
    count, last, end = 0, None, time.monotonic() + seconds
    while time.monotonic() < end:
        link.pump(0.0005)
        now = link.updates[CommandId.SYSTEM_STATE][1]
        count, last = count + (now != last), now
    link.send(commands.query(CommandId.SYSTEM_STATE))
    text = f"automatic updates asked for every millisecond: {count / seconds:.0f} a second"
    return ResultLine("gripper", port, text, {"updates_per_s": count / seconds})
