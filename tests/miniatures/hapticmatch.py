"""HapticMatch: three materials of four samples, one height map without a photo, and one folder without samples."""

import pickle
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.miniatures import picture

MATERIALS, SAMPLES = ("AbsorbentMat1", "Denim", "RubberPlate3"), (1, 2, 9, 10)
GRASPS = len(MATERIALS) * len(SAMPLES)


def heights(seed: int) -> np.ndarray:
    """Return (24, 32) float64: ridges with a pitch and a direction for each seed."""
    rows, columns = np.mgrid[:24, :32].astype(np.float64)
    return np.sin(rows * (0.3 + 0.1 * (seed % 7)) + columns * 0.05 * (seed % 5) + seed)


def write(folder: Path, materials: Sequence[str] = MATERIALS) -> None:
    for number, material in enumerate(materials):
        path = folder / "Texture" / material
        for sample in SAMPLES:
            write_sample(path, sample, 100 * number + sample)
    (folder / "Texture" / materials[0] / "11.pkl").write_bytes(pickle.dumps(heights(1), protocol=4))
    picture(folder / "Texture" / "Removed" / "preview.png", 3)


def write_sample(folder: Path, sample: int, seed: int) -> None:
    picture(folder / f"{sample}.jpg", seed, (24, 32))
    (folder / f"{sample}.pkl").write_bytes(pickle.dumps(heights(seed), protocol=4))
