"""The simulated rig: virtual devices over one Scene. Seed, object and attempt number determine the whole attempt."""

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from _touch_retrieval.documents import Seed, typed
from robot.devices import Arm, Camera, Gripper, TactileSensor, VirtualDevice
from robot.errors import DeviceError, RobotConfigError
from robot.gel_settings import parse_gel_settings
from robot.grasping.settings import parse_attempt_settings
from robot.readings import RGBD, Frame, GripperState, Intrinsics, Pose, Region
from robot.recording.folder import UNITS
from robot.rig import Rig, load_planner
from robot.settings import TypedSettings
from robot.sim.camera import PinholeCamera, Placement
from robot.sim.gel.sensor import GelSensor, draw_sensor, drift
from robot.sim.objects.draw import STROKE_MM, SimObject, draw_object
from robot.sim.objects.shapes import SHAPES
from robot.sim.scene import PAD_MM, SIDES, Grip, Hand, Scene

if TYPE_CHECKING:
    from robot.sim.meshes import MeshFolder

Array = npt.NDArray[np.float64]
FORCE_N = (5.0, 80.0)
"""Range of the force on each finger of the simulated Weiss WSG-50."""

_MESH_UNITS = UNITS | {"pose": f"{UNITS['pose']}; then its tilt in radian, where it does not point straight down"}
_ATTEMPT_S = 40.0
_WORKSPACE = Region((-150.0, -150.0, 0.5 * PAD_MM[0]), (150.0, 150.0, 500.0))
_TABLE_MM = 15.0
"""Largest distance of objects from the centre of the workspace, in x and in y."""


class SimState:
    """State that the devices share: the scene of this attempt, the pose of the hand, the opening, and the time.

    The time advances only when a device acts.
    """

    def __init__(self) -> None:
        self.now_s = 0.0
        self.scene: Scene | None = None
        self.pose = Pose(0.0, 0.0, 300.0, 0.0)
        self.opening_mm = STROKE_MM

    def clock(self) -> float:
        """Return the time in seconds."""
        return self.now_s

    def sleep(self, seconds: float) -> None:
        """Advance the time."""
        self.now_s += seconds

    def current_scene(self) -> Scene:
        """Return the scene of this attempt; raise DeviceError if there is none."""
        if self.scene is None:
            raise DeviceError("the simulated table is empty. Call prepare(object_id, number) first")
        return self.scene

    @property
    def is_lifted(self) -> bool:
        """Whether the hand is more than 1 mm above the pose in which it closed."""
        grip = self.current_scene().grip
        return grip is not None and self.pose.z_mm > grip.pose.z_mm + 1.0


@dataclass(frozen=True, kw_only=True)
class SimSettings(TypedSettings):
    """Settings of the simulated rig.

    Attributes:
        fingers: fingers with a gel.
        optics: led, grey (white lamps, a grey camera), varied (sensors of any make), or a sensor fitted to real
            presses (gelsight, gelsight_mini).
        gels: number of gel pairs; the objects are divided between them.
        families: shape families to draw from; all if empty.
        meshes: folder of STL, OBJ or PLY files to use instead of procedural objects (needs the extra `mesh`).
        contact_grid: rows and columns of the contact solver.
        contact_tolerance: tolerance of the contact solver.
        focal_px: focal length of the camera. Its pictures have 256 x 256 px. At the default of 860 px they show about
            190 mm; a larger object is cut off.
        session: name of the session, which draws the drift of light, white balance and gels; "" for no drift.
        localisation_mm: range from which the error of the camera's calibration is drawn.
        grasp: the table [grasp], as for a real rig: random grasps (robot.grasping.settings.GraspSettings).
        attempt: the table [attempt]: speeds, waits, retries (robot.grasping.settings.AttemptSettings).
        planner: the table [planner]: the grasp planner (robot.rig; "mesh" by default for meshes).
        gel: the tables [gel.a] and [gel.b]: materials of the gels (robot.gel_settings); unknown properties are drawn.

    Raises:
        RobotConfigError: A setting has the wrong type or is out of range.
    """

    fingers: tuple[str, ...] = ("a", "b")
    optics: str = "led"
    gels: Annotated[int, Meta(ge=1, le=1000)] = 1
    families: tuple[str, ...] = ()
    meshes: str = ""
    contact_grid: tuple[int, int] = (120, 160)
    contact_tolerance: Annotated[float, Meta(ge=1e-12, le=0.999)] = 1e-2
    focal_px: Annotated[float, Meta(ge=300, le=10_000)] = 860.0
    session: str = ""
    localisation_mm: tuple[float, float] = (5.0, 10.0)
    grasp: Mapping[str, Any] = field(default_factory=dict)
    attempt: Mapping[str, Any] = field(default_factory=dict)
    planner: Mapping[str, Any] = field(default_factory=dict)
    gel: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        fingers, (rows, columns) = self.fingers, self.contact_grid
        if not fingers or len(set(fingers)) != len(fingers) or set(fingers) - set(SIDES):
            raise RobotConfigError(f'fingers must be ["a"], ["b"] or ["a", "b"], got {list(fingers)}')
        if unknown := sorted(set(self.families) - set(SHAPES)):
            raise RobotConfigError(f"families must be among {', '.join(sorted(SHAPES))}; got {unknown[0]!r}")
        if not 3 <= rows <= columns <= 2000 or 4 * rows != 3 * columns:
            raise RobotConfigError(
                f"contact_grid must have 3 to 2000 rows and columns in the ratio 3 to 4, got {rows}, {columns}"
            )
        if not 0 <= self.localisation_mm[0] <= self.localisation_mm[1]:
            raise RobotConfigError(
                f"localisation_mm must be two lengths, the smaller first, got {self.localisation_mm}"
            )


class SimRig(Rig):
    """Arm, gripper with a gel on each finger, and an RGB-D camera over a table with simulated objects.

    Args:
        seed: seed of objects, gels, placements and light.
        **settings: the fields of `SimSettings`.

    Raises:
        RobotConfigError: A setting or the folder of meshes is invalid.
        UnknownName: There is no planner or optics of this name.
        SceneError: The settings describe an impossible scene.
    """

    Settings = SimSettings
    can_run_jobs: ClassVar[bool] = True

    def __init__(self, seed: int = 0, **settings: Any) -> None:
        typed(seed, Seed, "seed", error=RobotConfigError)
        options = SimSettings(**settings)
        self._seed, self._families = seed, tuple(sorted(options.families))
        attempt = parse_attempt_settings(options.attempt, options.grasp)
        self.meshes: MeshFolder | None = None
        if options.meshes:
            from robot.sim import meshes  # slow to import

            self.meshes = meshes.MeshFolder(options.meshes, seed, attempt.grasp)
        self._hand = Hand(
            grid=options.contact_grid, tolerance=options.contact_tolerance, turns_about_grip=self.meshes is not None
        )
        drawn = np.random.default_rng([103, seed]).integers(2**31, size=options.gels)
        fingers, known = options.fingers, parse_gel_settings(options.gel, options.fingers)
        self._gels = [
            {finger: draw_sensor(int(pair), finger, optics=options.optics, gel=known[finger]) for finger in fingers}
            for pair in drawn
        ]
        self._camera = PinholeCamera(focal_px=options.focal_px)
        rng = np.random.default_rng([102, seed])
        turn, size = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(*options.localisation_mm)
        self.error_mm = np.array([size * math.cos(turn), size * math.sin(turn), 0.0])
        self.sim_state = SimState()
        super().__init__(
            SimArm(self.sim_state),
            SimGripper(self.sim_state),
            {finger: SimTactileSensor(self.sim_state, finger) for finger in fingers},
            SimCamera(self.sim_state, self._camera, self.error_mm),
            info={
                "source": "simulated rig",
                "sensor": f"simulated GelSight ({options.optics} optics)",
                "rig": "sim",
                "fingers": sorted(fingers),
                "gels": [{finger: pair[finger].gel.to_dict() for finger in sorted(pair)} for pair in self._gels],
                **({"meshes_sha256": self.meshes.digest, "units": _MESH_UNITS} if self.meshes else {}),
            },
            clock=self.sim_state.clock,
            sleep=self.sim_state.sleep,
            attempt=attempt,
            planner=load_planner(options.planner, "mesh" if self.meshes else "cylinder"),
        )
        self.attempt.grasp.check(self.arm, self.gripper)
        if options.session:
            self.begin_session(options.session, {}, 1)

    def object_ids(self, count: int) -> list[str]:
        """Return the first `count` objects; raise RobotConfigError if there are fewer meshes."""
        if self.meshes is not None:
            return self.meshes.object_ids(count)
        return [_procedural(self._seed, index, self._families).object_id for index in range(count)]

    def begin_session(self, session: str, first_attempts: Mapping[str, int], stride: int) -> None:
        """Begin a session with its own drift of the gels; placements of objects do not depend on it."""
        self.session, self._first_attempts, self._stride = session, first_attempts, stride

    def prepare(self, object_id: str, number: int) -> None:
        """Place the object on the table at a random position and yaw, under new light, with the gels of this time."""
        obj = self._find_object(object_id)
        name = zlib.crc32(object_id.encode())
        rng = np.random.default_rng([101, self._seed, name, number])
        x, y = rng.uniform(-_TABLE_MM, _TABLE_MM, 2)
        placement = Placement(float(x), float(y), float(rng.uniform(0.0, 2.0 * math.pi)))
        self.sim_state.scene = Scene(
            obj,
            placement,
            self._camera,
            sensors=self._drifted(name % len(self._gels), object_id, number),
            hand=self._hand,
            seed=int(rng.integers(2**31)),
        )
        self.sim_state.now_s = number * _ATTEMPT_S

    def _drifted(self, pair: int, object_id: str, number: int) -> dict[str, GelSensor]:
        if self.session is None:
            return self._gels[pair]
        hours = (self._first_attempts.get(object_id, 0) + number * self._stride) * _ATTEMPT_S / 3600
        seed = self._seed, zlib.crc32(self.session.encode()), pair
        return {finger: drift(gel, (*seed, ord(finger)), hours) for finger, gel in self._gels[pair].items()}

    def labels(self, object_id: str) -> dict[str, float | bool | str]:
        """Return `SimObject.labels` of an object; raise RobotConfigError if the rig has none of this name."""
        return self._find_object(object_id).labels()

    def press(self, object_id: str, number: int) -> dict[str, npt.NDArray[np.uint8]]:
        """Press the object at a random height, yaw and force, without arm or camera.

        Returns:
            The gel images of each finger, pressed and before (touch_a, touch_a_before, ...); empty if the jaws miss.
            `sim_state` holds the scene of the grasp.
        """
        self.prepare(object_id, number)
        scene = self.sim_state.current_scene()
        rng = np.random.default_rng([104, self._seed, zlib.crc32(object_id.encode()), number])
        place, settings, height = scene.placement, self.attempt.grasp, float(scene.obj.body.upper[2])
        x, y = rng.normal([place.x_mm, place.y_mm], settings.jitter_mm)
        lowest = max(settings.floor_mm, height - settings.reach_mm)
        z = rng.uniform(lowest, max(lowest, height - settings.top_margin_mm))
        pose = Pose(float(x), float(y), float(z), float(rng.uniform(0.0, math.pi)))
        self.sim_state.scene = scene = replace(scene, grip=Grip(pose, float(rng.uniform(*settings.force_n))))
        if scene.pinch.miss_reason:
            return {}
        names = [f"touch_{finger}{moment}" for finger in sorted(self.sensors) for moment in ("", "_before")]
        return {name: scene.image(name) for name in names}

    def _find_object(self, object_id: str) -> SimObject:
        if self.meshes is not None:
            candidates = self.meshes.candidates(object_id)  # the name begins with `mesh.` and the name of the file
        else:
            index = object_id.rsplit("-", 1)[-1]  # the name ends with the index
            candidates = [_procedural(self._seed, int(index), self._families)] if index.isdecimal() else []
        for candidate in candidates:
            if candidate.object_id == object_id:
                return candidate
        raise RobotConfigError(f"the simulated rig with seed {self._seed} and these settings has no {object_id!r}")


@lru_cache(maxsize=4)
def _procedural(seed: int, index: int, families: tuple[str, ...]) -> SimObject:
    """Draw an object, cached: it keeps its baked relief between attempts."""
    return draw_object(seed, index, family=families[index % len(families)] if families else None)


# Devices ----------------------------------------------------------------------------------------------------


class SimArm(VirtualDevice, Arm):
    """Arm that reaches each pose exactly; only the clock advances."""

    def __init__(self, sim_state: SimState) -> None:
        super().__init__("simulated arm", _WORKSPACE, clock=sim_state.clock)
        self.can_tilt = True
        self._sim_state = sim_state

    def _move_to(self, pose: Pose, speed_mm_s: float) -> Pose:
        self._sim_state.sleep(math.dist(self._sim_state.pose.as_tuple()[:3], pose.as_tuple()[:3]) / speed_mm_s)
        self._sim_state.pose = pose
        return pose

    def _pose(self) -> Pose:
        return self._sim_state.pose


class SimGripper(VirtualDevice, Gripper):
    """Gripper that closes on the object between its fingers; its readings are those of the simulated grip (`Pinch`)."""

    def __init__(self, sim_state: SimState) -> None:
        super().__init__(
            "simulated gripper",
            stroke_mm=STROKE_MM,
            min_force_n=FORCE_N[0],
            max_force_n=FORCE_N[1],
            clock=sim_state.clock,
        )
        self._sim_state = sim_state

    def _settings(self) -> dict[str, Any]:
        return {"stroke_mm": STROKE_MM, "force_n": list(FORCE_N)}

    def _open(self, opening_mm: float) -> GripperState:
        sim_state = self._sim_state
        sim_state.opening_mm = opening_mm
        if sim_state.scene is not None and sim_state.scene.grip is not None:
            sim_state.scene = replace(sim_state.scene, grip=None)
        return self._state()

    def _grasp(self, force_n: float, speed_mm_s: float) -> GripperState:
        sim_state = self._sim_state
        sim_state.scene = replace(sim_state.current_scene(), grip=Grip(sim_state.pose, force_n, sim_state.opening_mm))
        sim_state.sleep(sim_state.opening_mm / speed_mm_s)
        return self._state()

    def _state(self) -> GripperState:
        scene = self._sim_state.scene
        if scene is None or scene.grip is None:
            return GripperState(self._sim_state.opening_mm, 0.0, "idle")
        pinch = scene.pinch
        if pinch.miss_reason:
            return GripperState(0.0, 0.0, "no_part")
        if self._sim_state.is_lifted and pinch.slip_reason:
            return GripperState(0.0, 0.0, "part_lost")
        return GripperState(pinch.final_opening_mm, scene.grip.force_n, "holding")


class SimTactileSensor(VirtualDevice, TactileSensor):
    """The gel of one finger: without contact, pressed, or after the lift."""

    def __init__(self, sim_state: SimState, finger: str) -> None:
        super().__init__(f"simulated gel {finger}", finger, clock=sim_state.clock)
        self._sim_state = sim_state

    def _read(self) -> Frame:
        scene = self._sim_state.current_scene()
        moment = "_before" if scene.grip is None else "_after" if self._sim_state.is_lifted else ""
        return Frame(scene.image(f"touch_{self.finger}{moment}"), self.clock())


class SimCamera(VirtualDevice, Camera):
    """RGB-D camera over the table; its reported pose has the calibration error."""

    def __init__(self, sim_state: SimState, camera: PinholeCamera, error_mm: Array) -> None:
        reported = camera.to_rig.copy()
        reported[:3, 3] += error_mm
        super().__init__("simulated camera", reported, clock=sim_state.clock)
        self._sim_state, self._camera = sim_state, camera

    def _settings(self) -> dict[str, Any]:
        return {"px": self._camera.px, "focal_px": self._camera.focal_px}

    def _read(self, depth: bool) -> RGBD:
        scene, centre = self._sim_state.current_scene(), (self._camera.px - 1) / 2
        lens = Intrinsics(self._camera.focal_px, self._camera.focal_px, centre, centre)
        return RGBD(scene.image("photo"), scene.image("depth") if depth else None, lens, self.clock())
