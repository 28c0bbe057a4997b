"""The simulated rig: devices like any other over one Scene; seed, object and number decide all of an attempt."""

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from robot.devices import Arm, Camera, Gripper, TactileSensor, VirtualDevice
from robot.errors import DeviceError, RecordingError, RobotConfigError
from robot.gel_settings import parse_gel_settings
from robot.grasping.planner import load_planner
from robot.grasping.settings import GraspSettings, parse_attempt_settings
from robot.readings import RGBD, Frame, GripperState, Intrinsics, Pose, Region
from robot.recording.folder import UNITS
from robot.recording.grasp import RecordedGrasp
from robot.rig import Rig, check_seed
from robot.settings import TypedSettings, bounded
from robot.sim.camera import PinholeCamera, Placement
from robot.sim.gel.marks import Markers
from robot.sim.gel.sensor import draw_sensor
from robot.sim.objects.draw import STROKE_MM, SimObject, draw_object
from robot.sim.objects.shapes import SHAPES
from robot.sim.pinch import PAD_MM, SIDES, Grip, Hand
from robot.sim.scene import Scene

if TYPE_CHECKING:
    from robot.sim.meshes import MeshFolder

Array = npt.NDArray[np.float64]
FORCE_N = (5.0, 80.0)
"""Clamping force of the Weiss WSG-50 that is simulated."""

_MESH_UNITS = UNITS | {"pose": f"{UNITS['pose']}; then its tilt in radian, where it does not point straight down"}
_ATTEMPT_S = 40.0
_MAX_OBJECTS = 100_000
_WORKSPACE = Region((-150.0, -150.0, 0.5 * PAD_MM[0]), (150.0, 150.0, 500.0))
_TABLE_MM = 15.0
"""Objects stand at most this far from the centre of the workspace in x and y."""


class SimClock:
    """Time that passes only when something is done."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self.now_s += seconds


class SimState:
    """What the devices share: the scene of this attempt, where the hand is, what it holds, and the time."""

    def __init__(self, clock: SimClock) -> None:
        self.clock = clock
        self.scene: Scene | None = None
        self.pose = Pose(0.0, 0.0, 300.0, 0.0)
        self.opening_mm = STROKE_MM

    def current_scene(self) -> Scene:
        """The scene of this attempt. Raises DeviceError before there is one."""
        if self.scene is None:
            raise DeviceError("nothing stands on the simulated table yet; call prepare(object_id, number) first")
        return self.scene

    @property
    def is_lifted(self) -> bool:
        """Whether the hand has left the place where it closed."""
        grip = self.current_scene().grip
        return grip is not None and self.pose.z_mm > grip.pose.z_mm + 1.0


@dataclass(frozen=True, kw_only=True)
class SimSettings(TypedSettings):
    """What the simulated rig is like.

    fingers: those with a gel. optics: led, grey (white lamps, a grey camera), or a sensor fitted to real presses
    (gelsight, gelsight_mini). gels: so many pairs serve one after the other, each for its share of the objects.
    markers: black dots on the gels. families: only shapes of these. meshes: a folder of STL, OBJ or PLY files to hold
    instead (needs the extra `mesh`). contact_grid (rows, columns) and contact_tolerance of the contact solver. shadow:
    whether the lamp casts one. focal_px: of the camera, whose pictures have 256 px a side; at 860 they show some 190
    mm, and larger objects in part. localisation_mm: how far off the camera's calibration is, drawn from this range.
    grasp, attempt, planner and gel are the tables [grasp], [attempt], [planner], [gel.a] and [gel.b] of a real rig's
    file: how grasps are drawn and attempts are made (robot.grasping.settings), where the jaws close
    (robot.grasping.planner; "mesh" by default for meshes), and what the gels are made of (robot.gel_settings); what is
    not known of one is drawn.
    """

    fingers: tuple[str, ...] = ("a", "b")
    optics: str = "led"
    gels: int = bounded(1, 1000, 1, unit="pairs")
    markers: bool = False
    families: tuple[str, ...] = ()
    meshes: str = ""
    contact_grid: tuple[int, int] = (120, 160)
    contact_tolerance: float = bounded(1e-12, 0.999, 1e-2)
    shadow: bool = True
    focal_px: float = bounded(300, 10_000, 860.0, unit="px")
    localisation_mm: tuple[float, float] = (5.0, 10.0)
    grasp: Mapping[str, Any] = field(default_factory=dict)
    attempt: Mapping[str, Any] = field(default_factory=dict)
    planner: Mapping[str, Any] = field(default_factory=dict)
    gel: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raises RobotConfigError for a setting of the wrong type or out of range."""
        super().__post_init__()
        fingers, (rows, columns) = self.fingers, self.contact_grid
        if not fingers or len(set(fingers)) != len(fingers) or set(fingers) - set(SIDES):
            raise RobotConfigError(f'fingers must be ["a"], ["b"] or ["a", "b"], got {list(fingers)}')
        if unknown := sorted(set(self.families) - set(SHAPES)):
            raise RobotConfigError(f"families must be of {', '.join(sorted(SHAPES))}; got {unknown[0]!r}")
        if not 3 <= rows <= columns <= 2000 or 4 * rows != 3 * columns:
            raise RobotConfigError(f"contact_grid must be 3 to 2000, 3 rows to 4 columns, got {rows}, {columns}")
        if not 0 <= self.localisation_mm[0] <= self.localisation_mm[1]:
            raise RobotConfigError(f"localisation_mm must be a range of two lengths, got {self.localisation_mm}")


class SimRig(Rig):
    """Arm, gripper with a gel on each finger, and an RGB-D camera over a table with procedural objects; its keywords
    are those of SimSettings.
    """

    Settings = SimSettings
    can_run_jobs: ClassVar[bool] = True

    def __init__(self, seed: int = 0, **settings: Any) -> None:
        """Raises RobotConfigError, UnknownName, SceneError."""
        check_seed(seed)
        asked = SimSettings(**settings)
        self._seed, self._families = seed, tuple(sorted(asked.families))
        attempt = parse_attempt_settings(asked.attempt, asked.grasp)
        self.meshes = _mesh_folder(asked.meshes, seed, attempt.grasp) if asked.meshes else None
        self._shadow = asked.shadow
        self._hand = Hand(
            grid=asked.contact_grid, tolerance=asked.contact_tolerance, turns_about_grip=self.meshes is not None
        )
        drawn = np.random.default_rng([103, seed]).integers(2**31, size=asked.gels)
        dots = Markers() if asked.markers else None
        fingers, known = asked.fingers, parse_gel_settings(asked.gel, asked.fingers)
        self._gels = [
            {
                finger: replace(draw_sensor(int(pair), finger, optics=asked.optics, gel=known[finger]), markers=dots)
                for finger in fingers
            }
            for pair in drawn
        ]
        self._camera = PinholeCamera(focal_px=asked.focal_px)
        clock, self.error_mm = SimClock(), _calibration_error(seed, asked.localisation_mm)
        self.sim_state = SimState(clock)
        super().__init__(
            SimArm(self.sim_state),
            SimGripper(self.sim_state),
            {finger: SimTactileSensor(self.sim_state, finger) for finger in fingers},
            SimCamera(self.sim_state, self._camera, self.error_mm),
            info={
                "source": "simulated rig",
                "sensor": f"simulated GelSight ({asked.optics} optics)",
                "rig": "sim",
                "fingers": sorted(fingers),
                "gels": [{finger: pair[finger].gel.to_dict() for finger in sorted(pair)} for pair in self._gels],
                **({"meshes_sha256": self.meshes.digest, "units": _MESH_UNITS} if self.meshes else {}),
            },
            clock=clock,
            sleep=clock.sleep,
            attempt=attempt,
            planner=load_planner(asked.planner, "mesh" if self.meshes else "cylinder"),
        )
        self.attempt.grasp.check(self.arm, self.gripper)

    def object_ids(self, count: int) -> list[str]:
        """The first `count` objects of this seed. Raises RobotConfigError for more than 100000, or than meshes."""
        if count > _MAX_OBJECTS:
            raise RobotConfigError(f"the simulated rig has at most {_MAX_OBJECTS} objects a seed, got {count}")
        if self.meshes is not None:
            return self.meshes.object_ids(count)
        return [_procedural(self._seed, index, self._families).object_id for index in range(count)]

    def prepare(self, object_id: str, number: int) -> None:
        """Stand the object on the table, turned and placed at random, under new light."""
        obj = self._find_object(object_id)
        name = zlib.crc32(object_id.encode())
        rng = np.random.default_rng([101, self._seed, name, number])
        x, y = rng.uniform(-_TABLE_MM, _TABLE_MM, 2)
        placement = Placement(float(x), float(y), float(rng.uniform(0.0, 2.0 * math.pi)))
        self.sim_state.scene = Scene(
            obj,
            placement,
            self._camera,
            sensors=self._gels[name % len(self._gels)],
            hand=self._hand,
            seed=int(rng.integers(2**31)),
            shadow=self._shadow,
        )
        self.sim_state.clock.now_s = number * _ATTEMPT_S

    def labels(self, object_id: str) -> dict[str, float | bool | str]:
        """`SimObject.labels` of an object of this rig. Raises RobotConfigError where it has none of this name."""
        return self._find_object(object_id).labels()

    def press(self, object_id: str, number: int) -> dict[str, npt.NDArray[np.uint8]]:
        """Gel images of each finger, pressed and before (touch_a, touch_a_before, ...), as jaws close on the object
        at a random height, turn and force, without arm or camera; nothing where they close on air.
        """
        self.prepare(object_id, number)
        scene = self.sim_state.current_scene()
        rng = np.random.default_rng([104, self._seed, zlib.crc32(object_id.encode()), number])
        place, settings, height = scene.placement, self.attempt.grasp, float(scene.obj.body.upper[2])
        x, y = rng.normal([place.x_mm, place.y_mm], settings.jitter_mm)
        lowest = max(settings.floor_mm, height - settings.reach_mm)
        z = rng.uniform(lowest, max(lowest, height - settings.top_margin_mm))
        pose = Pose(float(x), float(y), float(z), float(rng.uniform(0.0, math.pi)))
        scene = replace(scene, grip=Grip(pose, float(rng.uniform(*settings.force_n))))
        if scene.pinch.miss_reason:
            return {}
        names = [f"touch_{finger}{moment}" for finger in sorted(self.sensors) for moment in ("", "_before")]
        return {name: scene.image(name) for name in names}

    def walls(self, grasp: RecordedGrasp) -> dict[str, Array]:
        """Distance (mm) of the object from each gel at first touch, simulated again from what was recorded.

        (rows, columns) of the contact grid, inf where the finger meets nothing; empty for a miss.
        """
        if grasp.pose is None or grasp.force_n is None:
            raise RecordingError(f"{grasp.grasp_id} must have a pose and a force for its walls to be simulated again")
        self.prepare(grasp.object_id, int(grasp.grasp_id.rsplit("-", 1)[-1]))
        scene = replace(self.sim_state.current_scene(), grip=Grip(Pose(*grasp.pose), grasp.force_n))
        return {} if scene.pinch.miss_reason else {finger: scene.pinch.gap(finger) for finger in self.sensors}

    def _find_object(self, object_id: str) -> SimObject:
        """The object of this name: procedural ones end in their index, meshes begin with their file's name."""
        if self.meshes is not None:
            candidates = self.meshes.candidates(object_id)
        else:
            index = object_id.rsplit("-", 1)[-1]
            candidates = [_procedural(self._seed, int(index), self._families)] if index.isdecimal() else []
        for candidate in candidates:
            if candidate.object_id == object_id:
                return candidate
        raise RobotConfigError(f"the simulated rig with seed {self._seed} and these settings has no {object_id!r}")


@lru_cache(maxsize=4)
def _procedural(seed: int, index: int, families: tuple[str, ...]) -> SimObject:
    """It keeps its baked relief from attempt to attempt."""
    return draw_object(seed, index, family=families[index % len(families)] if families else None)


def _mesh_folder(folder: str, seed: int, settings: GraspSettings) -> "MeshFolder":
    from robot.sim.meshes import MeshFolder  # slow to import

    return MeshFolder(folder, seed, settings)


def _calibration_error(seed: int, localisation_mm: Sequence[float]) -> Array:
    """(3,) how far, in mm, the camera believes itself from where it is."""
    rng = np.random.default_rng([102, seed])
    turn, size = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(localisation_mm[0], localisation_mm[1])
    return np.array([size * math.cos(turn), size * math.sin(turn), 0.0])


# Devices ----------------------------------------------------------------------------------------------------


class SimArm(VirtualDevice, Arm):
    """Goes where it is told, at once but for the clock."""

    def __init__(self, sim_state: SimState) -> None:
        super().__init__("simulated arm", _WORKSPACE, clock=sim_state.clock)
        self.can_tilt = True
        self._sim_state = sim_state

    def _move_to(self, pose: Pose, speed_mm_s: float) -> Pose:
        before = self._sim_state.pose.as_tuple()[:3]
        self._sim_state.clock.sleep(math.dist(before, pose.as_tuple()[:3]) / speed_mm_s)
        self._sim_state.pose = pose
        return pose

    def _pose(self) -> Pose:
        return self._sim_state.pose


class SimGripper(VirtualDevice, Gripper):
    """Closes on what stands between its fingers; what it reports comes from the mechanics of the pinch."""

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
        grip = Grip(sim_state.pose, force_n, sim_state.opening_mm)
        sim_state.scene = replace(sim_state.current_scene(), grip=grip)
        sim_state.clock.sleep(sim_state.opening_mm / speed_mm_s)
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
    """The gel of one finger: untouched, pressed, or after the lift."""

    def __init__(self, sim_state: SimState, finger: str) -> None:
        super().__init__(f"simulated gel {finger}", finger, clock=sim_state.clock)
        self._sim_state = sim_state

    def _read(self) -> Frame:
        scene = self._sim_state.current_scene()
        moment = "_before" if scene.grip is None else "_after" if self._sim_state.is_lifted else ""
        return Frame(scene.image(f"touch_{self.finger}{moment}"), self.clock())


class SimCamera(VirtualDevice, Camera):
    """Looks at the table; it knows where it stands only as well as it was calibrated."""

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
