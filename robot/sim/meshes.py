"""A folder of meshes as objects of a simulated rig, each in a resting pose in which the gripper can grasp it."""

import hashlib
from collections import Counter
from functools import lru_cache
from pathlib import Path

from robot.errors import RobotConfigError
from robot.grasping.settings import GraspSettings
from robot.sim.antipodal import AntipodalGrasps, find_grasps
from robot.sim.objects.draw import STROKE_MM, SimObject
from robot.sim.objects.mesh import FORMATS, MeshBody, mesh_object, object_prefix, read_mesh
from robot.sim.objects.resting import stable_up_directions

_ENOUGH_GRASPS = 100
"""Take the first resting pose with this many grasps; fewer may be artefacts of the grid, or out of the arm's reach."""


class MeshFolder:
    """The STL, OBJ and PLY files of a folder as objects of one seed; grasp settings decide their resting pose.

    `digest` is the SHA-256 of all mesh files and their names; a recording continues only with the same ones.
    """

    def __init__(self, folder: str, seed: int, settings: GraspSettings) -> None:
        if not Path(folder).is_dir():
            raise RobotConfigError(f"meshes must be a folder of STL, OBJ or PLY files, got {folder!r}")
        self._folder, self._seed, self._settings = folder, seed, settings
        files = sorted(Path(folder).iterdir())
        self._paths = [path for path in files if path.suffix.lower().lstrip(".") in FORMATS and path.name[0] != "."]
        lines = (f"{path.name} {hashlib.sha256(path.read_bytes()).hexdigest()}\n" for path in self._paths)
        self.digest = hashlib.sha256("".join(lines).encode()).hexdigest()

    def object_ids(self, count: int) -> list[str]:
        """Return the names of the first `count` objects.

        Raises:
            RobotConfigError: The folder has fewer meshes, or two meshes of one name.
            SceneError: A mesh file is not usable.
        """
        if count > len(self._paths):
            raise RobotConfigError(
                f"{self._folder} must contain at least {count} STL, OBJ or PLY files, got {len(self._paths)}"
            )
        names = [mesh_object(path, read_mesh(path), self._seed).object_id for path in self._paths[:count]]
        if repeated := sorted(name for name, times in Counter(names).items() if times > 1):
            raise RobotConfigError(
                f"{self._folder} must not contain two meshes of one name, got {repeated[0]!r}. Rename one"
            )
        return names

    def candidates(self, object_id: str) -> list[SimObject]:
        """Return the objects whose file names fit this object_id. Raise SceneError for a bad file."""
        paths = [path for path in self._paths if object_id.startswith(object_prefix(path))]
        return [_resting_object(path, self._seed, self._settings) for path in paths]


@lru_cache(maxsize=4)  # an object keeps its search tree and its grasps between attempts
def _resting_object(path: Path, seed: int, settings: GraspSettings) -> SimObject:
    """Return the mesh in the first resting pose with enough grasps, or else in the pose with the most.

    If no pose has a grasp, return the pose whose opposite sides are nearest to each other.
    """
    mesh = read_mesh(path)
    rated: list[tuple[int, float, SimObject]] = []
    for up in stable_up_directions(mesh.vertices, mesh.solid.center_mass):
        obj = mesh_object(path, mesh, seed, up=up)
        grasps = grasps_of(obj.body, settings)
        rated.append((len(grasps), -grasps.min_width_mm, obj))
        if len(grasps) >= _ENOUGH_GRASPS:
            return obj
    return max(rated, key=lambda pose: pose[:2])[2]


@lru_cache(maxsize=16)
def grasps_of(body: MeshBody, settings: GraspSettings) -> AntipodalGrasps:
    """Return `find_grasps` for the stroke of the simulated gripper, cached."""
    return find_grasps(body, settings, STROKE_MM)
