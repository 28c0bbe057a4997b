"""Cost of a simulated grasp: all outputs, each single output, the saving without one output; then whole collections."""

import dataclasses
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common import ResultLine, duration
from robot.collection import CollectSettings, collect
from robot.readings import Pose
from robot.rig import load_rig
from robot.sim.pinch import Grip
from robot.sim.rig import SimRig
from robot.sim.scene import Scene

FRAMES = ("", "_before", "_after")
EVERYTHING = {"photo", "depth", *(f"touch_{finger}{moment}" for finger in "ab" for moment in FRAMES)}
ARMS = {
    "everything": EVERYTHING,
    "without depth": EVERYTHING - {"depth"},
    "without shadow": EVERYTHING,
    "without finger b": {name for name in EVERYTHING if not name.startswith("touch_b")},
    "without photo and depth": EVERYTHING - {"photo", "depth"},
    "photo alone": {"photo"},
    "depth alone": {"depth"},
    "one pressed gel alone": {"touch_a"},
    "one no-contact frame alone": {"touch_a_before"},
}


def measure(objects: int = 26, grasps: int = 3, collected: int = 26) -> Iterator[ResultLine]:
    """Yield a line for each arm, all over the same scenes, one thread; then a line for one job and one for two."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        scenes = list(_scenes(objects, grasps + 1))
        yield from _arms(scenes[objects:], scenes[:objects])
    finally:
        cv2.setNumThreads(threads)
    if collected:
        for jobs in (1, 2):
            yield _collected(collected, jobs)


def _scenes(objects: int, grasps: int) -> Iterator[Scene]:
    """Yield grips around the middle of the rig's objects, each round over all of them."""
    rig = SimRig(40_000)
    objects_by_name = {name: rig._find_object(name) for name in rig.object_ids(objects)}
    rng = np.random.default_rng(0)
    for number in range(grasps):
        for name, obj in objects_by_name.items():
            rig.prepare(name, number)
            scene = dataclasses.replace(rig.sim_state.current_scene(), obj=obj)
            height = max(10.0, rng.uniform(0.3, 0.8) * float(obj.body.upper[2]))
            pose = Pose(scene.placement.x_mm, scene.placement.y_mm, height, rng.uniform(0, np.pi))
            yield dataclasses.replace(scene, grip=Grip(pose, rng.uniform(5, 25)))


def _arms(scenes: list[Scene], warm: list[Scene]) -> Iterator[ResultLine]:
    """Time the arms in turn, scene by scene; `warm` bakes each object's relief and fills the caches."""
    for scene in warm:
        dataclasses.replace(scene, outputs=frozenset(EVERYTHING)).run()
    seconds: dict[str, list[float]] = {name: [] for name in ARMS}
    for scene in scenes:
        for name in ARMS:
            seconds[name].append(_seconds(_arm(scene, name)))
    everything = float(np.mean(seconds["everything"]))
    for name, each in seconds.items():
        mean = float(np.mean(each))
        text = f"{duration(mean)} per grasp, {1 / mean:.1f} per second; {mean / everything:.0%} of everything"
        yield ResultLine("grasp", name, text, {"seconds": mean, "share": mean / everything})


def _arm(scene: Scene, name: str) -> Scene:
    sensors = {
        finger: sensor for finger, sensor in scene.sensors.items() if name != "without finger b" or finger != "b"
    }
    return dataclasses.replace(
        scene, sensors=sensors, shadow=name != "without shadow", outputs=frozenset(ARMS[name]), passes=Counter()
    )


def _seconds(scene: Scene) -> float:
    """Return the CPU time, of one thread."""
    start = time.process_time()
    scene.run()
    return time.process_time() - start


def _collected(objects: int, jobs: int) -> ResultLine:
    """Time a whole collection, from starting processes to the last file on disk."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        make_rig = partial(load_rig, "sim", seed=1)
        tallies = collect(
            make_rig, Path(folder) / "r", objects=objects, seed=1, settings=CollectSettings(grasps=4), jobs=jobs
        )
        seconds = time.perf_counter() - start
    attempts = sum(tally.attempts for tally in tallies)
    accepted = sum(tally.accepted for tally in tallies)
    text = (
        f"{attempts / seconds:.2f} attempts and {accepted / seconds:.2f} accepted grasps per second, all files written"
    )
    figures = {"attempts_per_s": attempts / seconds, "accepted_per_s": accepted / seconds}
    return ResultLine("grasp", f"collect with {jobs} job{'s' * (jobs > 1)}", text, figures)
