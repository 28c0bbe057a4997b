"""Meshes in random sizes and proportions, as objects of simulated rigs."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh

from robot.errors import SceneError
from robot.sim.objects.mesh import mesh_object, read_mesh

SIZES, STRETCH = (0.5, 1.6), 0.35
"""Smallest and largest factor of the size; largest logarithm of the factor of one axis."""


def vary_meshes(files: Iterator[Path], count: int, out: Path, seed: int) -> Path:
    """Write the next `count` usable meshes in random sizes into the folder `out`, and return it."""
    rng = np.random.default_rng(seed)
    out.mkdir(parents=True, exist_ok=True)
    while count:
        file = next(files)
        mesh = trimesh.load_mesh(file)
        mesh.apply_scale(np.exp(rng.uniform(*np.log(SIZES)) + rng.uniform(-STRETCH, STRETCH, 3)))
        varied = out / f"{count}-{file.name}"
        mesh.export(varied)
        try:
            mesh_object(varied, read_mesh(varied), seed)
            count -= 1
        except SceneError:  # such as too thin
            varied.unlink()
    return out
