"""Live rigs of the service: sensor pictures, and grasps with the simulated rig.

Of a real rig, only sensor pictures are available: no HTTP request moves it.
"""

import random
import re
from functools import partial
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from indexes.errors import IndexesError
from indexes.store.folder import IndexStore
from indexes.store.sharded import is_sharded, read_sharded_manifest
from retrieval.data.images import encode_image
from retrieval.data.opening import believed
from retrieval.errors import BadInput
from retrieval.serve.service import GraspResult, LiveRig
from robot.devices import TactileSensor
from robot.errors import RobotConfigError
from robot.rig import load_rig

if TYPE_CHECKING:
    from robot.sim.rig import SimRig  # needs an extra

_SIMULATED_OBJECT_ID = re.compile(r".+-(\d{4,})-\d{5,}")
"""Object ids of the simulated rig: prefix, seed, number."""
_FIRST_UNRECORDED_ATTEMPT = 10_000
"""First number of the live attempts; recordings contain only attempts with smaller numbers."""
_MAX_ATTEMPTS = 20


def load_live_rig(spec: str | None, index: str | Path) -> LiveRig | None:
    """Return the sensors of a rig, and connect them.

    Args:
        spec: Name or file of the rig, as for `--rig`; None for the simulated rig if the index contains its objects and
            the extra `sim` is installed, else no rig.
        index: Index folder; the simulated rig takes its seed from it.

    Raises:
        RobotError: The rig cannot be loaded or connected.
    """
    seed = _seed(index)
    if spec is None and seed is None:
        return None
    try:
        rig = load_rig(spec or "sim", seed=seed or 0)
    except RobotConfigError:
        if spec is None:
            return None
        raise
    if rig.info["rig"] == "sim":
        gripper = _SimulatedGripper(cast("SimRig", rig))
        return LiveRig({finger: partial(gripper.picture, finger) for finger in rig.sensors}, gripper.grasp)
    for sensor in rig.sensors.values():
        sensor.connect()

    def picture(sensor: TactileSensor, lock: Lock) -> bytes:
        with lock:
            return encode_image(sensor.read().pixels, ".jpg")

    return LiveRig({name: partial(picture, sensor, Lock()) for name, sensor in rig.sensors.items()})


def _seed(index: str | Path) -> int | None:
    """Return the seed of the simulated objects of an index; None if the first object is not of the simulated rig."""
    try:
        folder = Path(index)
        folder = folder / read_sharded_manifest(folder).shards[0].folder if is_sharded(folder) else folder
        first = IndexStore(folder).open(verify=False).rows[0].object_id
    except IndexesError:
        return None  # reported when the index is opened
    match = _SIMULATED_OBJECT_ID.fullmatch(first)
    return int(match[1]) if match else None


class _SimulatedGripper:
    """Thread-safe wrapper of the simulated rig; its gels show the last grasp."""

    def __init__(self, rig: "SimRig") -> None:
        self._rig, self._lock = rig, Lock()
        self._gels: dict[str, npt.NDArray[np.uint8]] = {}

    def grasp(self, names: list[str]) -> GraspResult:
        """Grasp a random one of these objects, and retry with another one if the grasp misses."""
        rng = random.SystemRandom()
        with self._lock:
            for _ in range(_MAX_ATTEMPTS):
                name = rng.choice(names)
                grasped = self._rig.press(name, _FIRST_UNRECORDED_ATTEMPT + rng.randrange(1_000_000))
                if grasped:
                    fingers = sorted(self._rig.sensors)
                    self._gels = {finger: grasped[f"touch_{finger}"] for finger in fingers}
                    before = [encode_image(grasped[f"touch_{finger}_before"]) for finger in fingers]
                    touches = [encode_image(self._gels[finger]) for finger in fingers]
                    opening_mm = believed(self._rig.sim_state.current_scene().pinch.final_opening_mm)
                    return GraspResult(name, touches, before, opening_mm)
        raise BadInput(f"{_MAX_ATTEMPTS} grasps in a row missed the object. Try again.")

    def picture(self, finger: str) -> bytes:
        """Return the gel image of a finger after the last grasp, as JPEG."""
        with self._lock:
            if finger not in self._gels:
                self._rig.prepare(self._rig.object_ids(1)[0], 0)
                self._gels[finger] = self._rig.sim_state.current_scene().image(f"touch_{finger}_before")
            return encode_image(self._gels[finger], ".jpg")
