"""Scanned or drawn meshes (STL, OBJ, PLY) as objects of the simulated rig; needs the extra `touch-retrieval[mesh]`.

Scans are too coarse for a gel: a triangle of a scanned can is a few mm wide. So a gel meets the curved surface that the
normals of the corners describe, as the camera shows it, with procedural relief like that of any other object: the hit
is moved along the ray by the height of both over the cosine of the angle. Only geometry is read: no materials,
textures, or files that a mesh names.
"""

import io
import re
import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, cKDTree

from robot.errors import SceneError
from robot.extras import import_extra
from robot.sim.objects.appearance import draw_appearance
from robot.sim.objects.body import Body, Vectors
from robot.sim.objects.draw import SimObject
from robot.sim.objects.materials import draw_material
from robot.sim.objects.packets import Rays, ReliefLevel
from robot.sim.objects.relief import RELIEFS, Relief, draw_relief
from robot.sim.objects.resting import UP, rotation_to_up
from robot.sim.objects.shapes.shape import CylindricalChart, Floats, relief_limit
from robot.sim.objects.wall import bake_plain, ends_weight, level_of, smoothstep

FORMATS = ("stl", "obj", "ply")
MIN_THICKNESS_MM = 2.0
_MAX_METRE_EXTENT = 2.0
_CREASE_COSINE = 0.77
_RAY_OFFSET_MM = 1.0
_SIDES = 8
_SIDE_RAD = 2 * np.pi / _SIDES
_BLEND = 0.35, 0.65
"""Where, between two planes that project relief, the first begins to give way to the second, and where it has."""
Faces = NDArray[np.int64]


@dataclass(frozen=True)
class Mesh:
    """A closed surface: vertices (V, 3) in mm, faces (F, 3) of vertex numbers, counter-clockwise from outside."""

    vertices: Vectors
    faces: Faces

    @cached_property
    def corner_normals(self) -> Vectors:
        """A normal for each corner of each face, (F, 3, 3): the vertex's mean, or the face's own at a crease.

        trimesh weights faces by their angle at the vertex (Thuermer and Wuethrich 1998), so the triangulation of a flat
        side has no effect.
        """
        shared, of_face = self.solid.vertex_normals[self.faces], self.solid.face_normals[:, None, :]
        is_smooth = np.sum(shared * of_face, axis=2, keepdims=True) > _CREASE_COSINE
        return np.asarray(np.where(is_smooth, shared, of_face))

    @cached_property
    def solid(self) -> Any:
        """The same as a `trimesh.Trimesh`, whose volume is positive if the faces point outwards."""
        return _import_package("trimesh").Trimesh(self.vertices, self.faces, process=False)

    def rest_on_table(self, up: Vectors) -> "Mesh":
        """Return the mesh turned until the unit direction `up` is vertical, centred, with its lowest point at z = 0."""
        vertices = self.vertices if up is UP else self.vertices @ rotation_to_up(up).T
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        return Mesh(vertices - [*(low + high)[:2] / 2, low[2]], self.faces)

    def normals_at(self, face: Faces, weights: Vectors) -> Vectors:
        """Interpolate the corner normals at points on the faces, given by their `corner_weights` (N, 3)."""
        mixed = np.einsum("ij,ijk->ik", weights, self.corner_normals[face])
        return np.asarray(mixed / np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-300))

    def curved_offset(self, face: Faces, points: Vectors, weights: Vectors) -> Vectors:
        """Return offsets (N, 3) from points on the faces to the curved surface that the corner normals describe.

        The mean of the point's projections onto the tangent planes of the corners (Phong tessellation, Boubekeur and
        Alexa 2008), with weight 1/2: on a sphere or cylinder it is exact to second order. It is 0 at a crease.
        `weights` are the points' `corner_weights` (N, 3).
        """
        corners, normals = self.vertices[self.faces[face]], self.corner_normals[face]
        heights = np.einsum("ijk,ijk->ij", corners - points[:, None, :], normals)
        return np.asarray(np.einsum("ij,ijk->ik", weights * heights / 2, normals))

    def corner_weights(self, face: Faces, points: Vectors) -> Vectors:
        """Return the barycentric coordinates (N, 3) of points on the faces."""
        a, b, c = self.vertices[self.faces[face]].transpose(1, 0, 2)
        cross = np.cross(b - a, c - a)
        square = np.maximum(np.einsum("ij,ij->i", cross, cross), 1e-300)
        v = np.einsum("ij,ij->i", np.cross(points - a, c - a), cross) / square
        w = np.einsum("ij,ij->i", np.cross(b - a, points - a), cross) / square
        return np.asarray(np.clip(np.stack([1 - v - w, v, w], axis=1), 0, 1))


class MeshBody(Body):
    """A mesh with relief. A ray that starts inside hits at 0; relief does not widen the outline."""

    def __init__(self, mesh: Mesh, relief: Relief) -> None:
        self.mesh, self.relief = mesh, relief
        out = 0.0 if relief.engraved else relief.amplitude_mm
        outwards = np.array([out, out, 0.0])
        self.lower, self.upper = mesh.vertices.min(axis=0) - outwards, mesh.vertices.max(axis=0) + outwards
        self.chart = CylindricalChart(float(np.mean(self.upper[:2] - self.lower[:2])) / 2, float(self.upper[2]))

    @cached_property
    def wall(self) -> list[ReliefLevel]:
        """The relief on an unrolled cylinder of the mesh's size, from fine to coarse; empty for a smooth mesh."""
        return bake_plain(self.chart, self.relief)

    @cached_property
    def _caster(self) -> Any:
        """Embree's tree over the faces; it casts on one thread."""
        return _import_package("trimesh.ray.ray_pyembree").RayMeshIntersector(self.mesh.solid)

    @cached_property
    def _samples(self) -> tuple[cKDTree, Vectors, Vectors]:
        """Points about 1 mm apart on the surface, and the normals of their faces."""
        ends = np.cumsum(self.mesh.solid.area_faces)
        count = int(np.clip(ends[-1], 4000, 60000))
        rng = np.random.default_rng(5)
        face = np.minimum(np.searchsorted(ends, rng.uniform(0, ends[-1], count)), len(ends) - 1)
        weights = rng.dirichlet(np.ones(3), count)
        places = np.einsum("ij,ijk->ik", weights, self.mesh.vertices[self.mesh.faces[face]])
        return cKDTree(places), places, self.mesh.solid.face_normals[face]

    def volumes_mm3(self, shell_mm: float) -> tuple[float, float]:
        """Return the exact volume; the shell's volume is area times thickness, at most the whole."""
        return self.mesh.solid.volume, min(self.mesh.solid.volume, self.mesh.solid.area * shell_mm)

    def _cast(self, rays: Rays, step_mm: float) -> Vectors:
        ahead = np.flatnonzero(rays.near_mm <= rays.far_mm)
        origins, directions, near = rays.origins[ahead], rays.directions[ahead], rays.near_mm[ahead]
        # Rays that start on a face of the bounding box would miss it, so start earlier.
        start = near - np.minimum(near, _RAY_OFFSET_MM)
        face, distance = self.first_faces(origins + start[:, None] * directions, directions)
        hit = np.flatnonzero(face >= 0)
        result = np.full(len(ahead), np.inf)
        result[hit] = start[hit] + distance
        cosine = -np.einsum("ij,ij->i", directions[hit], self.mesh.solid.face_normals[face[hit]])
        outside, inside = hit[cosine > 0], hit[(cosine <= 0) & (start[hit] == near[hit])]
        result[inside] = near[inside]
        result[outside] -= self._lift(face[outside], origins[outside], directions[outside], result[outside], step_mm)
        distances = np.full(len(rays.near_mm), np.inf)
        distances[ahead] = np.maximum(result, near)
        return distances

    def first_faces(self, origins: Vectors, directions: Vectors) -> tuple[Faces, Vectors]:
        """Return the first mesh face along each ray (-1 for a miss), and for each hit the distance to its plane."""
        face = np.asarray(self._caster.intersects_first(origins, directions), np.int64)
        hit = face >= 0
        normal, corner = self.mesh.solid.face_normals[face[hit]], self.mesh.vertices[self.mesh.faces[face[hit], 0]]
        speed = np.einsum("ij,ij->i", directions[hit], normal)
        offset = np.einsum("ij,ij->i", corner - origins[hit], normal)
        return face, offset / np.where(np.abs(speed) < 1e-12, 1e-12, speed)

    def _lift(self, face: Faces, origins: Vectors, directions: Vectors, distance: Vectors, step_mm: float) -> Vectors:
        """Return how much earlier (or, if engraved, later) rays meet the curved surface with relief than the faces."""
        points = origins + distance[:, None] * directions
        weights = self.mesh.corner_weights(face, points)
        normals = self.mesh.normals_at(face, weights)
        cosine = np.maximum(-np.einsum("ij,ij->i", directions, normals), 0.35)
        curved = np.asarray(np.einsum("ij,ij->i", self.mesh.curved_offset(face, points, weights), normals) / cosine)
        if not self.wall:
            return curved
        lift = curved
        # Twice, because the ray meets the relief at another place than the mesh.
        for _ in range(2):
            points = origins + (distance - lift)[:, None] * directions
            lift = curved + self._height(points, normals, step_mm) / cosine
        return lift

    def _height(self, points: Vectors, normals: Vectors, step_mm: float) -> Vectors:
        """Return relief in mm, faded at foot and top and where the surface turns up or down.

        The relief is projected from the two nearest of `_SIDES` vertical planes onto the surface, so that its pitch is
        right on a side of any shape, and blended between them. The planes touch the cylinder of `wall`.
        """
        x, y, z = np.ascontiguousarray(points.T, np.float32)
        normal_x, normal_y = normals.T[:2].astype(np.float32)
        plane, beyond = np.divmod(np.arctan2(normal_x, -normal_y), np.float32(_SIDE_RAD))
        level = level_of(self.wall, step_mm)

        def projected(plane: Floats) -> Floats:
            angle = plane * np.float32(_SIDE_RAD)
            s = np.cos(angle) * x + np.sin(angle) * y + (angle + np.float32(np.pi)) * np.float32(self.chart.radius_mm)
            return level.at(np.mod(s, np.float32(self.chart.width_mm)), z)

        share = smoothstep(beyond / _SIDE_RAD, *_BLEND)
        height = (1 - share) * projected(plane) + share * projected(plane + 1)
        weight = smoothstep(np.hypot(normal_x, normal_y), 0.3, 0.75)
        fade = max(1.5, 0.8 * self.relief.amplitude_mm)
        return np.asarray(height * weight * ends_weight(z, self.chart.height_mm, fade), np.float64)

    def _normals(self, points: Vectors, step_mm: float) -> Vectors:
        """Return the mesh's normal n, tilted by the relief: n - (grad h - n (n . grad h))."""
        normals = self._mesh_normals(points)
        if not self.wall:
            return normals
        sides = np.eye(3) * step_mm / 2
        columns = [
            self._height(points + s, normals, step_mm) - self._height(points - s, normals, step_mm) for s in sides
        ]
        gradient = np.stack(columns, axis=1) / step_mm
        return np.asarray(normals - gradient + normals * np.einsum("ij,ij->i", gradient, normals)[:, None])

    def _mesh_normals(self, points: Vectors) -> Vectors:
        """Return smoothed normals of the faces under the points, found with rays from just outside."""
        normals = self._nearest_sample_normals(points)
        reach = self.relief.amplitude_mm + 2 * _RAY_OFFSET_MM
        face, distance = self.first_faces(points + reach * normals, -normals)
        hit = np.flatnonzero(face >= 0)
        depth = reach - distance
        near = np.abs(depth) < reach
        face, hit, depth = face[hit][near], hit[near], depth[near]
        weights = self.mesh.corner_weights(face, points[hit] + depth[:, None] * normals[hit])
        normals[hit] = self.mesh.normals_at(face, weights)
        return normals

    def _nearest_sample_normals(self, points: Vectors) -> Vectors:
        """Return the normal of the nearest sample, avoiding samples that have the point behind them (a thin wall)."""
        tree, places, normals = self._samples
        apart, nearest = tree.query(points, k=6)
        behind = -np.einsum("nkj,nkj->nk", points[:, None, :] - places[nearest], normals[nearest])
        allowed = self.relief.amplitude_mm if self.relief.engraved else 0.0
        best = np.argmin(apart + 4 * np.maximum(behind - allowed, 0), axis=1)
        return np.asarray(normals[nearest[np.arange(len(points)), best]])


# Reading -----------------------------------------------------------------------------------------------------


def read_mesh(path: str | Path) -> Mesh:
    """Read a closed solid and place it on the table.

    The file's z axis is up. Its unit is the metre if its largest extent is below 2, else the mm. Equal vertices are
    merged, and faces without area are dropped.

    Raises:
        SceneError: The file is not a closed solid, or the packages of the extra are missing.
    """
    file = Path(path)
    vertices, faces = _read(file)
    if not len(faces):
        raise SceneError(f"{file} has no triangles; export the surface, not points or curves")
    if faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices[faces]).all():
        raise SceneError(f"{file} has corners that are missing, NaN or infinite; export it again")
    size = float(np.ptp(vertices[faces].reshape(-1, 3), axis=0).max()) or 1.0
    _, first, number = np.unique(np.rint(vertices / (1e-7 * size)), axis=0, return_index=True, return_inverse=True)
    vertices, faces = vertices[first], number.reshape(-1)[faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    _check_closed(faces, file)
    scale = 1000.0 if np.ptp(vertices, axis=0).max() < _MAX_METRE_EXTENT else 1.0
    mesh = Mesh(vertices * scale, faces).rest_on_table(UP)
    thin = np.ptp(mesh.vertices, axis=0).min()
    if thin < MIN_THICKNESS_MM:
        hint = f"at {scale:g} mm a unit; export it in mm or m, with z up"
        raise SceneError(f"{file} must be at least {MIN_THICKNESS_MM:g} mm thick, got {thin:.3g} mm {hint}")
    if mesh.solid.volume < 0:  # the faces point inwards
        mesh = Mesh(mesh.vertices, np.ascontiguousarray(faces[:, ::-1]))
    if mesh.solid.volume < 1.0:
        raise SceneError(
            f"{file} must enclose a volume, got {mesh.solid.volume:g} mm3; export a solid, not a flat surface"
        )
    return mesh


def mesh_object(file: Path, mesh: Mesh, seed: int, *, up: Vectors = UP, relief: str | None = None) -> SimObject:
    """Draw relief, material and appearance for the mesh of a file, from `seed` and the file's name.

    `up` (3,) is the unit direction of the mesh that points up; the relief family is drawn if None.
    """
    stream = [seed, zlib.crc32(file.stem.encode())]
    relief_name = str(np.random.default_rng([*stream, 0]).choice(list(RELIEFS))) if relief is None else relief
    limit = relief_limit(min(_min_width(mesh.vertices), 94.0), 3.0)
    pattern = draw_relief(relief_name, np.random.default_rng([*stream, 1]), limit)
    return SimObject(
        object_id=f"{object_prefix(file)}{relief_name}-{seed:04d}",
        family="mesh",
        relief=pattern,
        material=draw_material(np.random.default_rng([*stream, 2])),
        appearance=draw_appearance(np.random.default_rng([*stream, 3])),
        body=MeshBody(mesh.rest_on_table(up), pattern),
    )


def object_prefix(file: Path) -> str:
    """Return the beginning of the object_id of this file's object."""
    return f"mesh.{re.sub(r'[^A-Za-z0-9._]+', '_', file.stem)}-"


def _import_package(name: str) -> Any:
    return import_extra(name, "a mesh", "mesh", SceneError)


def _read(file: Path) -> tuple[Vectors, Faces]:
    """Return vertices and faces as the file has them; raise SceneError."""
    kind = file.suffix.lower().lstrip(".")
    if kind not in FORMATS:
        raise SceneError(f"a mesh must be a file of {', '.join(FORMATS)}, got {file.name!r}")
    _import_package("trimesh.ray.ray_pyembree")  # the rig needs it later
    trimesh = _import_package("trimesh")
    try:
        # From memory and without a resolver: the reader cannot open files that the mesh names.
        data = io.BytesIO(file.read_bytes())
        loaded = trimesh.load(data, file_type=kind, force="mesh", process=False, skip_materials=True)
        return np.array(loaded.vertices, np.float64), np.array(loaded.faces, np.int64)
    except Exception as error:  # a damaged file can raise any exception in the parser
        raise SceneError(f"{file} is not a readable {kind.upper()} mesh: {error}") from error


def _check_closed(faces: Faces, file: Path) -> None:
    """Check that each edge borders an even number of faces, half of them in each direction."""
    if not len(faces):
        raise SceneError(f"{file} has no triangles with an area; export the surface again")
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, number, counts = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    if opened := int((counts % 2).sum()):
        raise SceneError(
            f"{file} must be a closed surface, but {opened} edges border a hole. Close it, for example "
            "with trimesh.repair.fill_holes, the 3D print tools of Blender or MeshLab's Close Holes"
        )
    if np.bincount(number.reshape(-1), np.where(edges[:, 0] < edges[:, 1], 1, -1)).any():
        raise SceneError(f"{file} must have all faces turned outwards; repair it with trimesh.repair.fix_normals")


def _min_width(vertices: Vectors) -> float:
    """Return the smallest horizontal width, over the directions normal to the sides of the outline's convex hull."""
    flat = vertices[:, :2]
    hull = flat[ConvexHull(flat).vertices]
    sides = np.roll(hull, -1, axis=0) - hull
    across = np.stack([-sides[:, 1], sides[:, 0]], axis=1) / np.linalg.norm(sides, axis=1, keepdims=True)
    return float(np.ptp(hull @ across.T, axis=0).min())
