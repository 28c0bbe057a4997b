"""Meshes from formulas, and mesh files."""

import struct

import numpy as np

from robot.sim.objects.mesh import mesh_object, read_mesh

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
CUBE = np.array([face for a, b, c, d in QUADS for face in ((a, b, c), (a, c, d))])


def sphere(count=60):
    """Return vertices and faces of a unit sphere on a grid of angles, with one vertex at each pole."""
    turn, fall = np.meshgrid(2 * np.pi * np.arange(2 * count) / (2 * count), np.pi * np.arange(1, count) / count)
    ring = np.stack([np.cos(turn) * np.sin(fall), np.sin(turn) * np.sin(fall), np.cos(fall)], axis=-1)
    vertices = np.concatenate([ring.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    i, j = np.meshgrid(np.arange(count - 2), np.arange(2 * count), indexing="ij")
    a, b = i * 2 * count + j, i * 2 * count + (j + 1) % (2 * count)
    sides = np.concatenate([np.stack([a, a + 2 * count, b], -1), np.stack([b, a + 2 * count, b + 2 * count], -1)])
    j, last = np.arange(2 * count), (count - 2) * 2 * count
    top = np.stack([np.full_like(j, len(vertices) - 2), j, (j + 1) % (2 * count)], -1)
    low = np.stack([np.full_like(j, len(vertices) - 1), last + (j + 1) % (2 * count), last + j], -1)
    return vertices, np.concatenate([sides.reshape(-1, 3), top, low])


def box(x_mm, y_mm, z_mm):
    """Return a box around the origin."""
    return CORNERS * [x_mm / 2, y_mm / 2, z_mm / 2], CUBE


def revolved(profile, count=72):
    """Return a solid of revolution about z. `profile` lists (radius, z) upwards; a point closes each end."""
    turn = 2 * np.pi * np.arange(count) / count
    rings = [np.stack([r * np.cos(turn), r * np.sin(turn), np.full(count, z)], 1) for r, z in profile]
    vertices = np.concatenate([*rings, [[0, 0, profile[0][1]], [0, 0, profile[-1][1]]]])
    faces, after = [], (np.arange(count) + 1) % count
    for low in range(0, (len(profile) - 1) * count, count):
        a, b = low + np.arange(count), low + after
        faces += [np.stack([a, b, a + count], 1), np.stack([b, b + count, a + count], 1)]
    first, last = len(vertices) - 2, (len(profile) - 1) * count
    faces.append(np.stack([np.full(count, first), after, np.arange(count)], 1))
    faces.append(np.stack([np.full(count, first + 1), last + np.arange(count), last + after], 1))
    return vertices, np.concatenate(faces)


BOTTLE = [(32, 0), (34, 4), (34, 110), (30, 125), (14, 145), (13, 150), (13, 175), (11, 178)]
"""Radius and height (mm) of a bottle with a shoulder and a neck."""


def stl(path, vertices, faces):
    """Write a binary STL file."""
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *vertices[face].ravel(), 0) for face in faces)
    path.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + rows)
    return path


def obj(path, vertices, faces, head=""):
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    path.write_text(head + "\n".join(lines) + "\n")
    return path


def ply(path, vertices, faces):
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
    )
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(map(str, row)) for row in vertices] + ["3 " + " ".join(map(str, row)) for row in faces]
    path.write_text(head + "\n".join(rows) + "\n")
    return path


def load_mesh_object(path, seed, **drawn):
    """Return the object of a mesh file, with the orientation of the file."""
    return mesh_object(path, read_mesh(path), seed, **drawn)
