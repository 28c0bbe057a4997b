"""The scene of the simulated rig for one grasp: an object on a table, fingers, a camera, and the requested outputs.

    scene = Scene(draw_object(0, 3), outputs={"photo", "touch_a"}, grip=Grip(Pose(0, 0, 60, 0.4), force_n=12))
    images = scene.run()        # {"photo": (256, 256, 3) uint8, "touch_a": (240, 320, 3) uint8}

Outputs have the names of a recording's image columns. Nothing else is computed: `scene.passes` counts the
computations (view, photo, depth, turn, wall, bare_finger, contact, gel, background).
"""

import re
from collections import Counter
from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from robot.errors import SceneError
from robot.sim import camera as cameras
from robot.sim.camera import Lighting, PinholeCamera, Placement
from robot.sim.gel.sensor import GelSensor
from robot.sim.objects.draw import SimObject
from robot.sim.pinch import SIDES, Grip, Hand, Pinch

_TOUCH = re.compile(r"touch_([a-z])(_before|_after)?")
_MOMENTS = {"_before": 1, None: 2, "_after": 3}


@dataclass(frozen=True, eq=False)
class Scene:
    """One object on the table and the grip on it.

    Attributes:
        obj: the object.
        placement: its pose on the table.
        camera: the camera over the table.
        sensors: the gel of each finger, by letter; a finger without a gel is rigid.
        hand: the gripper.
        grip: pose and force of the jaws; None before a grasp.
        seed: seed of light, noise and the error of the object's turn.
        outputs: names of the outputs that `run` computes.
        passes: counts of the computations done, by name.

    Raises:
        SceneError: An output is unknown, a touch has no sensor or no grip, or a finger is not a or b.

    >>> scene = robot.Scene(robot.draw_object(seed=0, index=0), outputs={"photo"})
    >>> scene.run()["photo"].dtype
    dtype('uint8')
    """

    obj: SimObject
    placement: Placement = field(default_factory=Placement)
    camera: PinholeCamera = field(default_factory=PinholeCamera)
    sensors: Mapping[str, GelSensor] = field(default_factory=dict)
    hand: Hand = field(default_factory=Hand)
    grip: Grip | None = None
    seed: int = 0
    outputs: Set[str] = frozenset()
    passes: Counter[str] = field(default_factory=Counter, repr=False)

    def __post_init__(self) -> None:
        if unknown := sorted(set(self.sensors) - set(SIDES)):
            raise SceneError(f"a parallel gripper has the fingers a and b, got {unknown[0]!r}")
        for name in sorted(self.outputs):
            self._check(name)

    def _check(self, name: str) -> None:
        touch = _TOUCH.fullmatch(name)
        if touch is None and name not in ("photo", "depth"):
            raise SceneError(f"outputs are photo, depth and touch_a, touch_a_before, touch_a_after, ...; got {name!r}")
        if touch and touch[1] not in self.sensors:
            raise SceneError(f"{name} needs a sensor on finger {touch[1]}; this scene has {sorted(self.sensors)}")
        if touch and touch[2] != "_before" and self.grip is None:
            raise SceneError(f"{name} needs a grip; pass Scene(grip=Grip(pose, force_n))")

    def run(self) -> dict[str, npt.NDArray[Any]]:
        """Return the requested outputs by name."""
        return {name: self.image(name) for name in sorted(self.outputs)}

    def image(self, name: str) -> npt.NDArray[Any]:
        """Return one output: colour (H, W, 3) uint8, or `depth` (H, W) float32 in metres, NaN where unknown."""
        self._check(name)
        if name == "photo":
            return self._photo()
        if name == "depth":
            self.passes["depth"] += 1
            return cameras.depth(self._view, self._noise(0, 1))
        touch = _TOUCH.fullmatch(name)
        assert touch is not None
        return self._touch(touch[1], touch[2])

    def _photo(self) -> npt.NDArray[np.uint8]:
        self.passes["photo"] += 1
        lighting = Lighting.draw(np.random.default_rng([91, self.seed]))
        return cameras.photo(self._view, lighting, self._noise(0, 0))

    @cached_property
    def _view(self) -> cameras.CameraView:
        """Geometry pass that photo and depth share."""
        self.passes["view"] += 1
        return cameras.cast_camera_rays(self.obj, self.placement, self.camera)

    @cached_property
    def pinch(self) -> Pinch:
        """Mechanics of the grip; each quantity is computed on first use."""
        if self.grip is None:
            raise SceneError("this scene has no grip; pass Scene(grip=Grip(pose, force_n))")
        return Pinch(
            obj=self.obj,
            placement=self.placement,
            grip=self.grip,
            sensors=self.sensors,
            hand=self.hand,
            seed=self.seed,
            passes=self.passes,
        )

    def _touch(self, finger: str, moment: str | None) -> npt.NDArray[np.uint8]:
        """Return the gel image before, during or after the hold; after a slip it is a no-contact frame."""
        noise = self._noise(_MOMENTS[moment], ord(finger))
        if moment == "_before" or (moment == "_after" and self.pinch.slip_reason):
            self.passes["background"] += 1
            return self.sensors[finger].background(noise)
        return self.pinch.touch(finger, noise)

    def _noise(self, *stream: int) -> int:
        """Return a separate seed for each frame of this scene."""
        return int(np.random.default_rng([92, self.seed, *stream]).integers(2**31))
