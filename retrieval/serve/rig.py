"""What a rig gives to the service: pictures of its sensors, and, of the simulated one, jaws that close on an object.

A real rig shows its sensors only: nothing that comes over HTTP moves it.
"""

import random
import re
from collections.abc import Callable
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
from retrieval.data.storage import is_url
from retrieval.errors import BadInput
from retrieval.search.query.objects import listed_photo
from retrieval.serve.service import GraspResult, LiveRig
from robot.devices import TactileSensor
from robot.errors import RobotConfigError
from robot.rig import load_rig

if TYPE_CHECKING:
    from robot.sim.rig import SimRig  # needs an extra

_SIMULATED_OBJECT_ID = re.compile(r".+-(\d{4,})-\d{5,}")
"""How the simulated rig calls its objects: their seed, and their number."""
_FIRST_UNRECORDED_ATTEMPT = 10_000
"""Attempts from this number on are in no recording."""
_MAX_ATTEMPTS = 20


def load_live_rig(spec: str, index: str | Path) -> LiveRig:
    """The sensors of a rig, which are connected at once. Raises RobotError."""
    rig = load_rig(spec, seed=_seed(index) or 0)
    if rig.info["rig"] == "sim":
        return _simulated_rig(cast("SimRig", rig))
    for sensor in rig.sensors.values():
        sensor.connect()

    def picture(sensor: TactileSensor, lock: Lock) -> bytes:
        with lock:
            return encode_image(sensor.read().pixels, ".jpg")

    return LiveRig({name: partial(picture, sensor, Lock()) for name, sensor in rig.sensors.items()})


def simulated_live_rig(index: str | Path) -> LiveRig | None:
    """The simulated rig, where the index shows its objects and the extra `sim` is installed."""
    seed = _seed(index)
    if seed is None:
        return None
    try:
        return _simulated_rig(cast("SimRig", load_rig("sim", seed=seed)))
    except RobotConfigError:
        return None


def _seed(index: str | Path) -> int | None:
    """The seed of the simulated objects that an index shows; None where its first object is none of the simulated rig,
    and for an index behind a URL.
    """
    if is_url(index):
        return None
    try:
        folder = Path(index)
        folder = folder / read_sharded_manifest(folder).shards[0].folder if is_sharded(folder) else folder
        first = listed_photo(IndexStore(folder).open(verify=False).rows[0]).object_id
    except IndexesError:
        return None  # said when it is opened
    found = _SIMULATED_OBJECT_ID.fullmatch(first)
    return int(found[1]) if found else None


class _SimulatedGripper:
    """The simulated rig from several threads, one after the other; its gels show what they closed on last."""

    def __init__(self, rig: "SimRig") -> None:
        self._rig, self._lock = rig, Lock()
        self._gels: dict[str, npt.NDArray[np.uint8]] = {}

    def grasp(self, names: list[str]) -> GraspResult:
        """Close on one of these objects, drawn at random; again where they close on air."""
        draw = random.SystemRandom()
        with self._lock:
            for _ in range(_MAX_ATTEMPTS):
                name = draw.choice(names)
                grasped = self._rig.press(name, _FIRST_UNRECORDED_ATTEMPT + draw.randrange(1_000_000))
                if grasped:
                    fingers = sorted(self._rig.sensors)
                    self._gels = {finger: grasped[f"touch_{finger}"] for finger in fingers}
                    before = [encode_image(grasped[f"touch_{finger}_before"]) for finger in fingers]
                    return GraspResult(name, [encode_image(self._gels[finger]) for finger in fingers], before)
        raise BadInput(f"{_MAX_ATTEMPTS} times the jaws closed on air; try again")

    def picture(self, finger: str) -> bytes:
        """The gel of a finger, as it was pressed last."""
        with self._lock:
            if finger not in self._gels:
                self._rig.prepare(self._rig.object_ids(1)[0], 0)
                self._gels[finger] = self._rig.sim_state.current_scene().image(f"touch_{finger}_before")
            return encode_image(self._gels[finger], ".jpg")


def _simulated_rig(rig: "SimRig") -> LiveRig:
    jaws = _SimulatedGripper(rig)
    sensors: dict[str, Callable[[], bytes]] = {finger: partial(jaws.picture, finger) for finger in rig.sensors}
    return LiveRig(sensors, jaws.grasp)
