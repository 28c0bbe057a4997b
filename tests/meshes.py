"""Solids with known answers as mesh files."""

import pytest

from robot.sim.objects.mesh import mesh_object, read_mesh

trimesh = pytest.importorskip("trimesh", reason="needs touch-retrieval[mesh]")
pytest.importorskip("embreex", reason="needs touch-retrieval[mesh]")

BOTTLE = [(0, 0), (32, 0), (34, 4), (34, 110), (30, 125), (14, 145), (13, 150), (13, 175), (11, 178), (0, 178)]
"""Radius and height (mm) of a bottle with a shoulder and a neck."""


def solid(vertices, faces):
    """Return a mesh of exactly these vertices and faces."""
    return trimesh.Trimesh(vertices, faces, process=False)


def box(x_mm, y_mm, z_mm):
    """Return a box around the origin."""
    return trimesh.creation.box((x_mm, y_mm, z_mm))


def ball(radius_mm, subdivisions=4):
    return trimesh.creation.icosphere(subdivisions, radius_mm)


def bottle():
    return trimesh.creation.revolve(BOTTLE, sections=72)


def saved(path, mesh):
    """Write a mesh as STL, OBJ or PLY, by the suffix, and return the path."""
    mesh.export(path, file_type=path.suffix[1:].lower())
    return path


def load_mesh_object(path, seed, **drawn):
    """Return the object of a mesh file, with the orientation of the file."""
    return mesh_object(path, read_mesh(path), seed, **drawn)
