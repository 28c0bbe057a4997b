"""The scene of the simulated rig for one grasp: an object on a table, fingers, a camera, and the requested outputs.

    scene = Scene(draw_object(0, 3), outputs={"photo", "touch_a"}, grip=Grip(Pose(0, 0, 60, 0.4), force_n=12))
    images = scene.run()        # {"photo": (256, 256, 3) uint8, "touch_a": (240, 320, 3) uint8}

Outputs have the names of a recording's image columns. Nothing else is computed: `scene.passes` counts the
computations (view, photo, depth, turn, wall, bare_finger, contact, gel, background).
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from robot.errors import SceneError
from robot.readings import Pose
from robot.sim import camera as cameras
from robot.sim.camera import Lighting, PinholeCamera, Placement
from robot.sim.contact.layer import Contact, press
from robot.sim.gel.sensor import GelSensor
from robot.sim.objects.draw import STROKE_MM, SimObject

Array = npt.NDArray[np.float64]
_TOUCH = re.compile(r"touch_([a-z])(_before|_after)?")
_MOMENTS = {"_before": 1, None: 2, "_after": 3}
GRAVITY_M_S2 = 9.81
SIDES = {"a": 1.0, "b": -1.0}
"""The direction that each finger faces along the gripper's x."""

SAFETY = 1.5
"""For the lift, the friction of both fingers must be at least this many times the weight."""

_START_MM = 400.0
"""Rays towards the object start this far from the plane x = 0, outside any object that a gripper grasps."""
_COARSE_RAD = [math.radians(angle) for angle in range(-40, 41, 4)]
_FINE_RAD = [math.radians(0.4 * step) for step in range(-10, 11)]
_MAX_TURN_ERROR_RAD = math.radians(0.2)
"""Maximum error of the object's final turn between the jaws."""

_MIN_WIDTH_RATIO = 0.2
"""Lower bound on the squeezed width of a soft object, relative to its width; foam cannot be squeezed further."""

PAD_MM = (15.2, 20.3)
"""Height and width of a bare finger's pad."""

_COARSE_GRID = (5, 9)
"""Rows and columns of the coarse grid for computing the object's turn."""


@dataclass(frozen=True)
class Hand:
    """Properties of the gripper and of the contact solver.

    Attributes:
        grid: rows and columns of the contact solver; `benchmarks.frontier` measures their effect on accuracy.
        tolerance: tolerance of the contact solver.
        turns_about_grip: whether closing jaws turn the object about the point between them, as if it were grasped far
            from its middle, or else about its own axis.
    """

    grid: tuple[int, int] = (120, 160)
    tolerance: float = 1e-2
    turns_about_grip: bool = False


@dataclass(frozen=True)
class Grip:
    """A grip: the jaws close at `pose`, from the opening `opening_mm`, with `force_n` on each finger.

    >>> robot.Grip(robot.Pose(x_mm=0, y_mm=0, z_mm=40, yaw_rad=0), force_n=12).force_n
    12
    """

    pose: Pose
    force_n: float
    opening_mm: float = STROKE_MM


@dataclass(frozen=True, eq=False)
class Scene:
    """One object on the table and the grip on it.

    Attributes:
        sensors: the gel of each finger, by letter; a finger without a gel is rigid.
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
            self._parse(name)

    def _parse(self, name: str) -> tuple[str, str | None] | None:
        """Return finger and moment of a touch, None for photo and depth; raise SceneError if it cannot be computed."""
        if name in ("photo", "depth"):
            return None
        touch = _TOUCH.fullmatch(name)
        if touch is None:
            raise SceneError(f"outputs are photo, depth and touch_a, touch_a_before, touch_a_after, ...; got {name!r}")
        if touch[1] not in self.sensors:
            raise SceneError(f"{name} needs a sensor on finger {touch[1]}; this scene has {sorted(self.sensors)}")
        if touch[2] != "_before" and self.grip is None:
            raise SceneError(f"{name} needs a grip; pass Scene(grip=Grip(pose, force_n))")
        return touch[1], touch[2]

    def run(self) -> dict[str, npt.NDArray[Any]]:
        """Return the requested outputs by name."""
        return {name: self.image(name) for name in sorted(self.outputs)}

    def image(self, name: str) -> npt.NDArray[Any]:
        """Return one output: colour (H, W, 3) uint8, or `depth` (H, W) float32 in metres, NaN where unknown."""
        if touch := self._parse(name):
            return self._touch(*touch)
        self.passes[name] += 1
        if name == "depth":
            return cameras.depth(self.view, self._noise(0, 1))
        return cameras.photo(self.view, Lighting.draw(np.random.default_rng([91, self.seed])), self._noise(0, 0))

    @cached_property
    def view(self) -> cameras.CameraView:
        """Geometry pass that photo and depth share: what each pixel shows."""
        self.passes["view"] += 1
        return cameras.cast_camera_rays(self.obj, self.placement, self.camera)

    @cached_property
    def pinch(self) -> "Pinch":
        """Mechanics of the grip; each quantity is computed on first use."""
        if self.grip is None:
            raise SceneError("this scene has no grip; pass Scene(grip=Grip(pose, force_n))")
        return Pinch(self, self.grip)

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


# The grip -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Pinch:
    """Outcome of the grip on the object of a scene; a finger without a gel is rigid.

    Gripper frame: x along the closing direction, z from the fingertips to the hand (up, unless the hand is tilted),
    origin between the fingertips. Finger a is at -x and faces +x, finger b is at +x and faces -x. In a gel's grid, rows
    count towards the fingertip (-z) and columns to the finger's right. Each quantity is computed once, on first use.

    Raises:
        SceneError: Force or opening is out of range.
    """

    scene: Scene
    grip: Grip
    _contacts: dict[str, Contact] = field(default_factory=dict, init=False, repr=False)
    _clean_images: dict[str, npt.NDArray[np.float32]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        force_n, opening_mm = self.grip.force_n, self.grip.opening_mm
        if not (math.isfinite(force_n) and force_n > 0):
            raise SceneError(f"a grip's force_n must be positive and finite, got {force_n}")
        if not 0 < opening_mm <= STROKE_MM:
            raise SceneError(f"opening_mm must be above 0 and at most {STROKE_MM:g}, got {opening_mm}")

    # Where the object ends ----------------------------------------------------------------------------------

    @cached_property
    def final_placement(self) -> Placement:
        """Pose of the object after the closing jaws have turned it.

        The object turns to the nearest local minimum of its width between the jaws. So flat sides end parallel
        to the pads, up to a small error.
        """
        coarse = _nearest_narrowest_turn(_COARSE_RAD, self._coarse_reach)
        fine = [coarse + angle for angle in _FINE_RAD]
        error_rad = np.random.default_rng([81, self.scene.seed]).uniform(-1.0, 1.0) * _MAX_TURN_ERROR_RAD
        return self._rotated_placement(_nearest_narrowest_turn(fine, self._finger_reach(fine)) + error_rad)

    def _rotated_placement(self, angle: float) -> Placement:
        x, y, pose = self.scene.placement.x_mm, self.scene.placement.y_mm, self.grip.pose
        if self.scene.hand.turns_about_grip:
            c, s, along, across = math.cos(angle), math.sin(angle), x - pose.x_mm, y - pose.y_mm
            x, y = pose.x_mm + c * along - s * across, pose.y_mm + s * along + c * across
        return Placement(x, y, self.scene.placement.yaw_rad + angle)

    @cached_property
    def _coarse_reach(self) -> Array:
        return self._finger_reach(_COARSE_RAD)

    def _finger_reach(self, turns: Sequence[float]) -> Array:
        """Return (turns, fingers): the distance along its rays at which each finger touches; inf for a miss."""
        self.scene.passes["turn"] += 1
        placements = [self._rotated_placement(angle) for angle in turns]
        rays = [self._rays(side, _COARSE_GRID, placements) for side in SIDES.values()]
        starts, directions = (np.stack(parts, axis=1).reshape(-1, 3) for parts in zip(*rays, strict=True))
        return np.asarray(self.scene.obj.body.cast(starts, directions).reshape(len(turns), len(SIDES), -1).min(axis=2))

    def _rays(self, side: float, grid: tuple[int, int], placements: Sequence[Placement]) -> tuple[Array, Array]:
        """Return starts and directions of parallel rays from the pad of a finger.

        Both are (placements, pixels, 3), in the frame of the object in each placement.
        """
        height, width = self._field_mm
        z = height * (0.5 - (np.arange(grid[0]) + 0.5) / grid[0])
        y = -side * width * ((np.arange(grid[1]) + 0.5) / grid[1] - 0.5)
        yy, zz = np.meshgrid(y, z)
        local = np.stack([np.full(yy.size, -side * _START_MM), yy.ravel(), zz.ravel()], axis=1)
        pose, rotations = self.grip.pose, np.stack([placement.rotation() for placement in placements])
        closing = pose.rotation()
        middles = np.array([[pose.x_mm - place.x_mm, pose.y_mm - place.y_mm, pose.z_mm] for place in placements])
        starts = (local @ closing.T + middles[:, None]) @ rotations
        directions = (side * closing[:, 0]) @ rotations
        return starts, np.broadcast_to(directions[:, None], starts.shape)

    @cached_property
    def _field_mm(self) -> tuple[float, float]:
        return next(iter(self.scene.sensors.values())).field.size_mm if self.scene.sensors else PAD_MM

    @cached_property
    def miss_reason(self) -> str | None:
        """Why the fingers miss: one comes down on the object, or it is not between them. None if they meet it."""
        reach = self._coarse_reach[len(_COARSE_RAD) // 2]
        if (reach < _START_MM - self.grip.opening_mm / 2).any():
            return "a finger comes down on the object"
        if not np.isfinite(self._ray_distances["a"]).any() or not np.isfinite(self._ray_distances["b"]).any():
            return "the object is not between the fingers"
        return None

    @cached_property
    def _ray_distances(self) -> dict[str, Array]:
        """Distance along each finger's rays to the turned object; a bare finger uses the coarse grid."""
        distances = {}
        for finger, side in SIDES.items():
            grid = self.scene.hand.grid if finger in self.scene.sensors else _COARSE_GRID
            self.scene.passes["wall" if finger in self.scene.sensors else "bare_finger"] += 1
            (starts,), (directions,) = self._rays(side, grid, [self.final_placement])
            distances[finger] = self.scene.obj.body.cast(starts, directions).reshape(grid)
        return distances

    # Contact ------------------------------------------------------------------------------------------------

    def gap(self, finger: str) -> Array:
        """Return the distance (rows, columns) in mm from the gel at first contact to the object; inf without object."""
        return np.asarray(self._ray_distances[finger] - self._ray_distances[finger].min())

    def contact(self, finger: str) -> Contact:
        """Return the contact of one finger's gel with the object; valid only if `miss_reason` is None."""
        if finger not in self._contacts:
            self.scene.passes["contact"] += 1
            self._contacts[finger] = press(
                self.gap(finger),
                self._pixel_mm,
                self.scene.sensors[finger].layer,
                force_n=self.grip.force_n,
                object_modulus_mpa=self.scene.obj.material.modulus_mpa,
                object_poisson=self.scene.obj.material.poisson,
                tolerance=self.scene.hand.tolerance,
            )
        return self._contacts[finger]

    def touch(self, finger: str, noise_seed: int) -> npt.NDArray[np.uint8]:
        """Return the gel image with closed jaws; the no-contact frame after a miss."""
        if self.miss_reason:
            return self.scene.sensors[finger].background(noise_seed)
        if finger not in self._clean_images:
            self.scene.passes["gel"] += 1
            self._clean_images[finger] = self.scene.sensors[finger].render_clean(self.contact(finger).displacement_mm)
        return self.scene.sensors[finger].capture(self._clean_images[finger], noise_seed)

    # Outcome ------------------------------------------------------------------------------------------------

    @cached_property
    def final_opening_mm(self) -> float:
        """Opening of the jaws at rest: the object's width minus the compression of gels and object.

        After a miss it is 0, also if a finger has come down on the object. A soft object keeps at least a fifth of its
        width, because linear elasticity does not hold below.
        """
        if self.miss_reason:
            return 0.0
        width = 2 * _START_MM - sum(float(wall.min()) for wall in self._ray_distances.values())
        compression = sum(self.contact(finger).approach_mm for finger in self.scene.sensors)
        return max(width - compression, _MIN_WIDTH_RATIO * width)

    @cached_property
    def slip_reason(self) -> str | None:
        """Why the lift loses the object; None if it holds. Coulomb friction, a hard-finger model.

        The friction of both fingers must be at least `SAFETY` times the weight. The line between the contacts, and the
        mean surface normal under each gel, must lie within the friction cone (Nguyen 1988).
        """
        if self.miss_reason:
            return self.miss_reason
        friction, weight = self.scene.obj.material.friction, self.scene.obj.mass_kg * GRAVITY_M_S2
        if 2 * friction * self.grip.force_n < SAFETY * weight:
            return "the object is too heavy for the friction"
        a, b = self._centre("a"), self._centre("b")
        if math.hypot(*(a - b)[1:]) > friction * abs(a[0] - b[0]):
            return "the fingers press past each other"
        if any(_mean_slope(self.contact(finger), self._pixel_mm) > friction for finger in self.scene.sensors):
            return "the side is too steep"
        return None

    @property
    def _pixel_mm(self) -> float:
        return self._field_mm[1] / self.scene.hand.grid[1]

    def _centre(self, finger: str) -> Array:
        """Return (x, y, z) of a contact in the gripper frame: centre of pressure, or a bare finger's nearest point."""
        wall, (height, width) = self._ray_distances[finger], self._field_mm
        has_gel = finger in self.scene.sensors
        weight = self.contact(finger).pressure_mpa if has_gel else (wall <= wall.min() + 0.1).astype(np.float64)
        rows, columns = np.indices(wall.shape)
        fraction = weight / weight.sum()
        z = height * (0.5 - ((rows + 0.5) * fraction).sum() / wall.shape[0])
        y = -SIDES[finger] * width * (((columns + 0.5) * fraction).sum() / wall.shape[1] - 0.5)
        return np.array([SIDES[finger] * (float(wall.min()) - _START_MM), y, z])


def _nearest_narrowest_turn(turns: Sequence[float], reached: Array) -> float:
    """Return the turn at which a descent from the middle turn reaches a local minimum of the object's width.

    Further reach of the fingers means a narrower object.
    """
    reach = reached.sum(axis=1)
    reach[np.isinf(reach)] = -np.inf  # an object that a finger misses is not narrow
    step = len(turns) // 2
    while 0 < step < len(turns) - 1:
        further = max(step - 1, step + 1, key=lambda other: float(reach[other]))
        if not reach[further] > reach[step] + 1e-3:
            break
        step = further
    return turns[step]


def _mean_slope(contact: Contact, pixel_mm: float) -> float:
    """Return the tangent of the angle between closing direction and resultant force of a frictionless contact."""
    along = np.gradient(contact.displacement_mm, pixel_mm)
    total = contact.pressure_mpa.sum()
    return math.hypot(*(float((contact.pressure_mpa * slope).sum() / total) for slope in along))
