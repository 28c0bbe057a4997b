"""Hand-eye calibration: the camera's pose in the rig's frame, by SciPy's alignment of points known in both frames.

Points are (N, 3) in mm, in the camera frame of robot.devices and in the rig's frame. The map gives
`Camera.extrinsics`. (For the nine points of the paper's authors the mean residual is 8.7 mm.)
"""

import json
import warnings
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from _touch_retrieval.documents import typed
from _touch_retrieval.files import write_atomically
from _touch_retrieval.text import read_numbers
from robot.errors import RobotConfigError
from robot.storage import read_content, read_json_object, storage_errors

Points = npt.NDArray[np.float64]

COLUMNS = tuple(f"{frame}_{axis}_mm" for frame in ("camera", "rig") for axis in "xyz")
SUSPECT_MM = 20.0
"""Largest accepted mean residual, twice that of the paper's rig."""
MIN_SPREAD = 0.02
"""Points lie on one line if their extent across it is below this fraction of that along it: 6 mm for 300 mm.

Errors of 5 mm in such points make the camera's rotation arbitrary.
"""
_MIN_EXTENT_MM = 25.0
"""Points of a smaller extent are in metres, centimetres or inches, or too near to each other for a rotation."""
_UNIT_RATIO = 5.0
"""If one extent exceeds the other by this factor, the smaller one has another unit: a motion keeps distances."""
_SAME_MM = 10.0
"""Points within this distance are one point that was measured again."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """A hand-eye calibration: (4, 4) motion from camera to rig in mm, and the (N,) distances of the mapped points."""

    rigid: Points
    residuals_mm: Points
    written: datetime

    def save(self, path: Path) -> None:
        """Write the file completely or not at all; raise StorageError if this fails."""
        numbers = {"rigid": self.rigid.tolist(), "residuals_mm": self.residuals_mm.tolist()}
        document = json.dumps({"written": self.written.isoformat(), **numbers}, indent=1)
        with storage_errors(path.parent):
            write_atomically(path, f"{document}\n".encode())


def fit_hand_eye(camera_mm: npt.ArrayLike, rig_mm: npt.ArrayLike) -> HandEye:
    """Fit the rotation and translation from camera points to rig points, by least squares.

    Args:
        camera_mm: (N, 3) points in the camera frame, at least 4 different ones that do not lie on one line.
        rig_mm: (N, 3) the same points in the rig's frame.

    Raises:
        RobotConfigError: The points are too few, on one line, in metres or not finite.
    """
    camera, rig = np.asarray(camera_mm, np.float64), np.asarray(rig_mm, np.float64)
    if camera.shape != rig.shape or camera.ndim != 2 or camera.shape[1] != 3:
        raise RobotConfigError(f"points must be two arrays of N x 3 mm, got {camera.shape} and {rig.shape}")
    if not (np.isfinite(camera).all() and np.isfinite(rig).all()):
        raise RobotConfigError("points must be finite numbers of mm; measure the others again")
    arms = [points - points.mean(0) for points in (camera, rig)]
    extents = [float(np.sqrt((arm**2).sum(1).mean())) for arm in arms]
    for name, extent, other in zip(("camera", "rig"), extents, extents[::-1], strict=True):
        if extent < _MIN_EXTENT_MM or extent * _UNIT_RATIO < other:
            raise RobotConfigError(
                f"the {name} points must be in mm, but extend only {extent:.3g}, and those of the other frame "
                f"{other:.3g}; if they are in metres, multiply them by 1000 (centimetres: 10, inches: 25.4), else "
                "measure points that are farther apart"
            )
    distinct = min(map(_distinct, (camera, rig)))
    if distinct < 4:
        raise RobotConfigError(
            f"a calibration requires at least 4 different points, got {distinct}; measure more, {_SAME_MM:g} mm apart"
        )
    for name, arm in zip(("camera", "rig"), arms, strict=True):
        along, across, _ = np.linalg.svd(arm, compute_uv=False)
        if across < MIN_SPREAD * along:
            raise RobotConfigError(f"the {name} points must not lie on one line; add points beside it")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a mirrored cube; its residuals are large
        rotation, _ = Rotation.align_vectors(arms[1], arms[0])
    rigid = np.eye(4)
    rigid[:3, :3] = rotation.as_matrix()
    rigid[:3, 3] = rig.mean(0) - rotation.apply(camera.mean(0))
    residuals = np.linalg.norm(rotation.apply(arms[0]) - arms[1], axis=1)
    return HandEye(rigid, residuals, datetime.now(UTC).replace(microsecond=0))


def _distinct(points: Points) -> int:
    kept: list[Points] = []
    for point in points:
        if all(np.linalg.norm(point - other) > _SAME_MM for other in kept):
            kept.append(point)
    return len(kept)


def read_pairs(path: Path) -> tuple[Points, Points]:
    """Read camera and rig points from a CSV file with COLUMNS, as `read_numbers` does; raise RobotConfigError."""
    try:
        numbers = read_numbers(read_content(path, RobotConfigError), COLUMNS)
    except ValueError as error:
        raise RobotConfigError(f"{path}: {error}") from error
    pairs = np.array(numbers, dtype=np.float64).reshape(-1, 6)
    return pairs[:, :3], pairs[:, 3:]


@dataclass(frozen=True)
class _Document:
    written: datetime
    rigid: tuple[tuple[float, float, float, float], ...]
    residuals_mm: tuple[float, ...]


def load_hand_eye(path: Path) -> Points:
    """Return the (4, 4) motion of a saved calibration; raise RobotConfigError if the file is not one."""
    try:
        document = typed(read_json_object(path, RobotConfigError), _Document)
    except ValueError as error:
        raise RobotConfigError(
            f"{path} is not a hand-eye calibration: {error}; make it again with `retrieve rig calibrate`"
        ) from error
    rigid = np.array(document.rigid)
    if (far := float(np.linalg.norm(rigid[:3, 3]))) < _SAME_MM:
        raise RobotConfigError(f"{path}: its translation must be in mm, got {far:.3g}; multiply one in metres by 1000")
    return rigid
