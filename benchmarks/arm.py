"""What an arm behind rosbridge costs on this machine: IK round trips, planning, a motion, states received."""

import time
from collections.abc import Iterator

import numpy as np

from benchmarks.common import ResultLine, duration
from robot.drivers.sawyer import messages
from robot.drivers.sawyer.driver import Sawyer
from robot.drivers.sawyer.straight_line import waypoints
from robot.readings import Pose, Region
from tests.emulators.sawyer.server import EmulatedSawyer, serve

WORKSPACE = Region((-150.0, -150.0, 0.0), (150.0, 150.0, 300.0))
LOW, HIGH = Pose(0.0, 0.0, 40.0, 0.0), Pose(0.0, 0.0, 220.0, 0.0)


def measure(calls: int = 300) -> Iterator[ResultLine]:
    """Over the emulator on a local websocket: the network of a real robot and its solver come on top."""
    with serve(EmulatedSawyer()) as url, _arm(url) as arm:
        yield _round_trip(arm, calls)
        yield _planning(arm)
        yield from _motion(arm)


def _arm(url: str) -> Sawyer:
    return Sawyer(
        workspace=WORKSPACE,
        host="127.0.0.1",
        port=int(url.rpartition(":")[2]),
        base_xyz_mm=[500.0, 0.0, -100.0],
        base_yaw_deg=180.0,
        tool_mm=150.0,
    )


def _round_trip(arm: Sawyer, calls: int) -> ResultLine:
    request = messages.ik_request(arm._mount.tip_of(HIGH), "right_hand", arm._fresh_joints())
    seconds = []
    for _ in range(calls):
        start = time.perf_counter()
        messages.ik_answer(arm._link.call(messages.IK_SERVICE, request))
        seconds.append(time.perf_counter() - start)
    middle, late = float(np.median(seconds)), float(np.quantile(seconds, 0.99))
    text = f"{duration(middle)} a call of IKService, .99 quantile {duration(late)}"
    return ResultLine("arm", "rosbridge round trip", text, {"median_s": middle, "q99_s": late})


def _planning(arm: Sawyer) -> ResultLine:
    poses = waypoints(LOW, HIGH)
    start = time.perf_counter()
    arm._solve(poses, arm._fresh_joints())
    seconds = time.perf_counter() - start
    text = f"{duration(seconds)} for 180 mm in {len(poses) - 1} way-points"
    return ResultLine("arm", "planning a straight line", text, {"seconds": seconds})


def _motion(arm: Sawyer) -> Iterator[ResultLine]:
    """A motion of 180 mm at 200 mm/s: what it takes, where it ends, and how evenly the states come."""
    arm.move_to(LOW, 200.0)
    start = time.perf_counter()
    reached = arm.move_to(HIGH, 200.0)
    seconds, off = time.perf_counter() - start, abs(reached.z_mm - HIGH.z_mm)
    least = 180.0 / 200.0 + 0.3
    text = f"{duration(seconds)} for 180 mm at 200 mm/s ({least:g} s by its schedule), ends {off:.2f} mm off"
    yield ResultLine("arm", "a motion", text, {"seconds": seconds, "scheduled_s": least, "off_mm": off})
    times = [arrival.time_s for arrival in arm._link.history(messages.JOINT_STATES[0])]
    gaps = np.diff(times)
    rate, longest = 1 / float(gaps.mean()), float(gaps.max())
    text = f"{rate:.0f} a second of the 100 published, longest gap {duration(longest)}"
    yield ResultLine("arm", "joint states", text, {"rate_hz": rate, "longest_gap_s": longest})
