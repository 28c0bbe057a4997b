"""CPU time of the parts of a simulated grasp on one thread, compared with another checkout of this project:

    git worktree add ../before v0.1.0
    python -m benchmarks.simulation --before ../before

Both run in turn, each time in a new process that warms up first. Ratios are by medians, with the range over turns.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from robot.collection import CollectSettings, collect
from robot.readings import Pose
from robot.rig import load_rig
from robot.sim.camera import PinholeCamera
from robot.sim.pinch import Grip
from robot.sim.rig import SimRig
from robot.sim.scene import Scene
from robot.storage import file_content

ROOT = Path(__file__).parents[1]
LARGE = PinholeCamera(px=512, focal_px=1720.0)


def parts(objects: int, grasps: int) -> dict[str, float]:
    """Return the mean CPU seconds of each part, and of a whole attempt with planning, gate and files."""
    cv2.setNumThreads(1)
    for scene in _scenes(objects, 1):  # compiles, and fills the caches
        _outputs(scene, defaultdict(list))
    spent: dict[str, list[float]] = defaultdict(list)
    for scene in _scenes(objects, 1 + grasps):
        _outputs(scene, spent)
    start, attempts = time.process_time(), collected(objects, grasps)
    attempt_s = (time.process_time() - start) / attempts
    return {name: float(np.mean(each)) for name, each in spent.items()} | {"attempt with its files": attempt_s}


def _scenes(objects: int, grasps: int) -> Iterator[Scene]:
    """Yield grips around the middle of the rig's objects, with baked relief."""
    rig, rng = SimRig(40_000), np.random.default_rng(0)
    for name in rig.object_ids(objects):
        for number in range(grasps):
            rig.prepare(name, number)
            scene = rig.sim_state.current_scene()
            scene.obj.body.normals(np.zeros((1, 3)))
            height = max(10.0, rng.uniform(0.3, 0.8) * float(scene.obj.body.upper[2]))
            pose = Pose(scene.placement.x_mm, scene.placement.y_mm, height, rng.uniform(0, np.pi))
            yield replace(scene, grip=Grip(pose, rng.uniform(5, 25)))


def _outputs(scene: Scene, spent: dict[str, list[float]]) -> None:
    def timed(name: str, work: Callable[[], Any]) -> Any:
        start = time.process_time()
        result = work()
        spent[name].append(time.process_time() - start)
        return result

    timed("photo of 256 px", lambda: scene.image("photo"))
    timed("depth", lambda: scene.image("depth"))
    large = replace(scene, camera=LARGE)
    timed("photo of 512 px, as a file", lambda: file_content("photo", large.image("photo")))
    if timed("final placement and walls", lambda: scene.pinch.miss_reason):
        return
    timed("two contacts", lambda: [scene.pinch.contact(finger) for finger in scene.sensors])
    timed("two gels", lambda: [scene.image(f"touch_{finger}") for finger in scene.sensors])


def collected(objects: int, grasps: int) -> int:
    """Collect into a temporary folder; return the number of attempts."""
    with tempfile.TemporaryDirectory() as folder:
        settings = CollectSettings(grasps=grasps)
        rig = partial(load_rig, "sim", seed=1)
        return sum(each.attempts for each in collect(rig, folder + "/r", objects=objects, seed=1, settings=settings))


def compare_checkouts(
    checkouts: dict[str, Path], rounds: int, objects: int, grasps: int
) -> dict[str, dict[str, list[float]]]:
    """Return the seconds of each part in each round, by checkout; their processes run in turn."""
    seconds_of: dict[str, dict[str, list[float]]] = {name: defaultdict(list) for name in checkouts}
    for _ in range(rounds):
        for name, root in checkouts.items():
            # -P: import only the other checkout's packages, none that are next to this file.
            command = [sys.executable, "-P", __file__, "--parts", str(objects), str(grasps)]
            environment = {**os.environ, "PYTHONPATH": str(root.resolve()), "OMP_NUM_THREADS": "1"}
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
            for part, seconds in json.loads(done.stdout).items():
                seconds_of[name][part].append(seconds)
    return seconds_of


def line(part: str, ours: list[float], before: list[float] | None) -> str:
    """Return the milliseconds of a part, and how many times longer it took before."""
    text = f"{part}: {1e3 * float(np.median(ours)):.1f} ms, {1 / float(np.median(ours)):.1f} per second"
    if before is None:
        return text
    each, was = np.array(before) / np.array(ours), float(np.median(before))
    return (
        f"{text}; before {1e3 * was:.1f} ms, {was / np.median(ours):.2f} times ({each.min():.2f} to {each.max():.2f})"
    )


def main() -> None:
    """Print a line for each part."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.simulation", description=__doc__)
    parser.add_argument("--before", type=Path, help="another checkout of this project")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--objects", type=int, default=13)
    parser.add_argument("--grasps", type=int, default=2)
    parser.add_argument("--parts", type=int, nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.parts:
        print(json.dumps(parts(*arguments.parts)))
        return
    checkouts = {"ours": ROOT} | ({"before": arguments.before} if arguments.before else {})
    seconds = compare_checkouts(checkouts, arguments.rounds, arguments.objects, arguments.grasps)
    for part, ours in seconds["ours"].items():
        print(line(part, ours, seconds["before"][part] if arguments.before else None), flush=True)


if __name__ == "__main__":
    main()
