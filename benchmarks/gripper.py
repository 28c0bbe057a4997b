"""Cost of the connection to a WSG-50, with an emulated one: round trip of a command, a reading, a grasp, updates."""

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
    """For each kind of port, measure round trips of LOOP, state readings, instant grasps, and updates every 1 ms.

    The emulator reads its port as soon as bytes arrive, and sends its own messages every millisecond.
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
                yield _times(port, "state, four requests", trips // 4, gripper.state)
                yield _times(port, f"open and grasp, {SPEED_UP:g} times as fast", grasps, lambda g=gripper: _cycle(g))


def _cycle(gripper: WSG50) -> None:
    gripper.open(60.0)
    gripper.grasp(10.0, 400.0)


def _times(port: str, label: str, count: int, call: Callable[[], object]) -> ResultLine:
    seconds = []
    for _ in range(count):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    median, q99 = (float(each) for each in np.quantile(seconds, [0.5, 0.99]))
    text = f"{label}: {duration(median)} median, {duration(q99)} .99 quantile"
    return ResultLine("gripper", port, text, {"median_s": median, "quantile_99_s": q99})


def _updates(port: str, link: Link, seconds: float) -> ResultLine:
    """Count state updates requested every millisecond."""
    link.send(commands.update(CommandId.SYSTEM_STATE, 1))
    count, last, end = 0, None, time.monotonic() + seconds
    while time.monotonic() < end:
        link.pump(0.0005)
        latest = link.updates[CommandId.SYSTEM_STATE][1]
        count, last = count + (latest != last), latest
    link.send(commands.query(CommandId.SYSTEM_STATE))
    text = f"automatic updates requested every millisecond: {count / seconds:.0f} per second"
    return ResultLine("gripper", port, text, {"updates_per_s": count / seconds})
