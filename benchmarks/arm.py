"""Cost of an arm over rosbridge on this machine: IK round trips, planning, a motion, received states."""

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
    """Measure over the emulator on a local websocket, without the network and solver of a real robot."""
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
    median, q99 = float(np.median(seconds)), float(np.quantile(seconds, 0.99))
    text = f"{duration(median)} per call of IKService, .99 quantile {duration(q99)}"
    return ResultLine("arm", "rosbridge round trip", text, {"median_s": median, "q99_s": q99})


def _planning(arm: Sawyer) -> ResultLine:
    poses = waypoints(LOW, HIGH)
    start = time.perf_counter()
    arm._solve(poses, arm._fresh_joints())
    seconds = time.perf_counter() - start
    text = f"{duration(seconds)} for 180 mm in {len(poses) - 1} way-points"
    return ResultLine("arm", "planning a straight line", text, {"seconds": seconds})


def _motion(arm: Sawyer) -> Iterator[ResultLine]:
    """Yield a motion of 180 mm at 200 mm/s: duration, end position, and regularity of the states."""
    arm.move_to(LOW, 200.0)
    start = time.perf_counter()
    reached = arm.move_to(HIGH, 200.0)
    seconds, error_mm = time.perf_counter() - start, abs(reached.z_mm - HIGH.z_mm)
    scheduled_s = 180.0 / 200.0 + 0.3
    text = f"{duration(seconds)} for 180 mm at 200 mm/s (scheduled {scheduled_s:g} s), ends {error_mm:.2f} mm off"
    yield ResultLine("arm", "a motion", text, {"seconds": seconds, "scheduled_s": scheduled_s, "off_mm": error_mm})
    times = [arrival.time_s for arrival in arm._link.history(messages.JOINT_STATES[0])]
    gaps = np.diff(times)
    rate, longest = 1 / float(gaps.mean()), float(gaps.max())
    text = f"{rate:.0f} per second of the 100 published, longest gap {duration(longest)}"
    yield ResultLine("arm", "joint states", text, {"rate_hz": rate, "longest_gap_s": longest})
