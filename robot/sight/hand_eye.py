"""Hand-eye calibration from points known in both frames: a rigid and an affine fit with leave-one-out errors.

Points are (N, 3) in mm, in the camera frame of robot.devices and in the rig's frame. The rigid map gives
`Camera.extrinsics`. The affine map is a diagnosis: if it predicts left-out points much better than the rigid map, the
camera's intrinsics or depth scale are wrong. Other causes of a bad fit give a warning too: the unit, a mirrored axis,
wrong pairs. (The nine points of the paper's authors: affine 2.7 mm in sample and 4.7 left out, rigid 8.7 and 10.2.)
"""

import csv
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from _touch_retrieval.documents import typed
from _touch_retrieval.files import write_atomically
from robot.errors import RobotConfigError
from robot.storage import read_content, read_json_object, storage_errors

Points = npt.NDArray[np.float64]
Fit = Callable[[Points, Points], Points]
"""Function from camera points and rig points (N, 3) to the (4, 4) map between them."""

VERSION = 1
COLUMNS = tuple(f"{frame}_{axis}_mm" for frame in ("camera", "rig") for axis in "xyz")
MIN_SPREAD = 0.02
"""Points are treated as collinear (coplanar) below this spread relative to their extent.

At 300 mm this is 6 mm; below it, errors of 5 mm in the points make the camera's rotation arbitrary.
"""
SUSPECT_MM = 20.0
"""A mean error above this gives a warning: twice the leave-one-out error of the paper's rig."""
_SUSPECT_RATIO, _SUSPECT_MM = 0.6, 1.0
_MIN_EXTENT_MM = 5.0
"""Points of a smaller extent are probably in metres; a calibration spans more than a few mm."""
_MIN_MIRROR_POINTS = 6
"""With fewer points, some permutation of them may resemble their mirror image."""
_METRES_RATIO = (500.0, 2000.0)
"""If the ratio of extents lies here, one is in mm and one in metres; noise changes it by less than a factor of 2."""
_MAX_COORDINATE_MM = 1e6
_MAX_CLOCK_ERROR = timedelta(days=1)


@dataclass(frozen=True)
class FitErrors:
    """Distances (mm) between mapped camera points and rig points, in sample and leave-one-out (loo)."""

    mean_mm: float
    max_mm: float
    loo_mean_mm: float
    loo_max_mm: float


@dataclass(frozen=True, eq=False)
class HandEye:
    """A hand-eye calibration.

    Attributes:
        camera_mm: (N, 3) points in the camera frame.
        rig_mm: (N, 3) the same points in the rig's frame.
        rigid: (4, 4) rigid map from camera to rig, mm.
        rigid_errors: Its errors.
        affine: (4, 4) affine map from camera to rig, mm; None if the points do not determine it.
        affine_errors: Its errors, or None.
        affine_problem: Reason why there is no affine map, or "".
        written: Time of the calibration, in UTC.
    """

    camera_mm: Points
    rig_mm: Points
    rigid: Points
    rigid_errors: FitErrors
    affine: Points | None
    affine_errors: FitErrors | None
    affine_problem: str
    written: datetime

    @property
    def warning(self) -> str | None:
        """A warning about large errors with their probable cause, or None.

        Causes: another unit, a mirrored axis, wrong intrinsics or depth scale of the camera (the affine map predicts
        left-out points much better than the rigid map), or wrong pairs.
        """
        rigid, affine = self.rigid_errors, self.affine_errors
        if causes := [*_unit_causes(self.camera_mm, self.rig_mm), *_mirror_causes(self)]:
            return f"{_describe_errors(rigid)}: {'; '.join(causes)}"
        enough = min(_SUSPECT_RATIO * rigid.loo_mean_mm, rigid.loo_mean_mm - _SUSPECT_MM)
        if affine is not None and affine.loo_mean_mm <= enough:
            return (
                f"the error of left-out points is {affine.loo_mean_mm:.1f} mm with an affine map and "
                f"{rigid.loo_mean_mm:.1f} mm with a rigid one: the camera's intrinsics or depth scale may be wrong; "
                "calibrate them, then measure the points again"
            )
        if max(rigid.mean_mm, rigid.loo_mean_mm) <= SUSPECT_MM:
            return None
        return (
            f"{_describe_errors(rigid)}, more than {SUSPECT_MM:g} mm: camera points may be paired with the wrong rig "
            "points, or single points may be wrong; check each pair"
        )

    def age_days(self, now: datetime | None = None) -> float:
        """Return the days since the calibration was written."""
        return ((now or datetime.now(UTC)) - self.written) / timedelta(days=1)

    def save(self, path: Path) -> None:
        """Write the file completely or not at all; raise StorageError if this fails."""
        with storage_errors(path.parent):
            write_atomically(path, (json.dumps(self._document(), indent=1) + "\n").encode())

    def _document(self) -> dict[str, Any]:
        pairs = zip(self.camera_mm.tolist(), self.rig_mm.tolist(), strict=True)
        return {
            "version": VERSION,
            "written": self.written.isoformat(),
            "rigid": self.rigid.tolist(),
            "rigid_errors": asdict(self.rigid_errors),
            "affine": None if self.affine is None else self.affine.tolist(),
            "affine_errors": None if self.affine_errors is None else asdict(self.affine_errors),
            "points": [{"camera_mm": camera, "rig_mm": rig} for camera, rig in pairs],
        }


def fit_hand_eye(camera_mm: npt.ArrayLike, rig_mm: npt.ArrayLike, *, written: datetime | None = None) -> HandEye:
    """Fit the rigid map and, if the points determine it, the affine map.

    Args:
        camera_mm: (N, 3) points in the camera frame: at least 4, not collinear, also with any one left out. The affine
            map requires 5 points that are not coplanar.
        rig_mm: (N, 3) the same points in the rig's frame.
        written: Time of the calibration; now by default.

    Raises:
        RobotConfigError: The points are invalid, too few or collinear.
    """
    camera, rig = _points("camera", camera_mm), _points("rig", rig_mm)
    if len(camera) != len(rig):
        raise RobotConfigError(f"each camera point must have a rig point, got {len(camera)} and {len(rig)}")
    if len(camera) < 4:
        raise RobotConfigError(f"a hand-eye fit requires at least 4 pairs of points, got {len(camera)}; add some")
    for name, points in (("camera", camera), ("rig", rig)):
        if _min_spread(points, 2) < MIN_SPREAD:
            raise RobotConfigError(
                f"the {name} points must not lie on one line, nor all but one of them; add points to its sides"
            )
    affine_problem = _affine_problem(camera)
    affine = None if affine_problem else fit_affine(camera, rig)
    return HandEye(
        camera,
        rig,
        fit_rigid(camera, rig),
        measure_errors(fit_rigid, camera, rig),
        affine,
        None if affine_problem else measure_errors(fit_affine, camera, rig),
        affine_problem,
        (written or datetime.now(UTC)).replace(microsecond=0),
    )


def fit_rigid(camera_mm: Points, rig_mm: Points) -> Points:
    """Return the least-squares rotation and translation (4, 4), no reflection (Kabsch 1976; Umeyama 1991, eq. 40)."""
    camera_mean, rig_mean = camera_mm.mean(0), rig_mm.mean(0)
    left, _, right = np.linalg.svd((rig_mm - rig_mean).T @ (camera_mm - camera_mean))
    rotation = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return _matrix(rotation, rig_mean - rotation @ camera_mean)


def fit_affine(camera_mm: Points, rig_mm: Points) -> Points:
    """Return the least-squares linear map and translation (4, 4), centred so that a far origin costs no digits."""
    camera_mean, rig_mean = camera_mm.mean(0), rig_mm.mean(0)
    linear = np.linalg.lstsq(camera_mm - camera_mean, rig_mm - rig_mean, rcond=None)[0].T
    return _matrix(linear, rig_mean - linear @ camera_mean)


def apply_map(matrix: Points, points_mm: Points) -> Points:
    """Apply a (4, 4) map to points (N, 3)."""
    return points_mm @ matrix[:3, :3].T + matrix[:3, 3]


def measure_errors(fit: Fit, camera_mm: Points, rig_mm: Points) -> FitErrors:
    """Return the errors of a fit in sample, and of each point under the fit of the others."""
    own = np.linalg.norm(apply_map(fit(camera_mm, rig_mm), camera_mm) - rig_mm, axis=1)
    left_out = np.empty(len(own))
    for index in range(len(own)):
        others = np.arange(len(own)) != index
        found = apply_map(fit(camera_mm[others], rig_mm[others]), camera_mm[index : index + 1])
        left_out[index] = np.linalg.norm(found[0] - rig_mm[index])
    return FitErrors(float(own.mean()), float(own.max()), float(left_out.mean()), float(left_out.max()))


def read_pairs(path: Path) -> tuple[Points, Points]:
    """Read camera and rig points from a CSV file with the columns COLUMNS, in any order; or raise RobotConfigError."""
    try:
        with io.StringIO(read_content(path, RobotConfigError).decode("utf-8-sig"), newline="") as file:
            rows = csv.DictReader(file, strict=True)
            if sorted(rows.fieldnames or ()) != sorted(COLUMNS):
                raise RobotConfigError(f"{path} must have the columns {', '.join(COLUMNS)}; it has {rows.fieldnames}")
            numbers = [_row(path, rows.line_num, row) for row in rows]
    except (csv.Error, UnicodeDecodeError) as error:
        raise RobotConfigError(f"{path} is not CSV text: {error}") from error
    pairs = np.array(numbers, dtype=np.float64).reshape(-1, 6)
    return pairs[:, :3], pairs[:, 3:]


def load_hand_eye(path: Path, max_age_days: float | None = None, now: datetime | None = None) -> HandEye:
    """Load a saved calibration and fit it again from its points.

    Args:
        path: The file.
        max_age_days: Largest accepted age; None for any age.
        now: Current time, for tests.

    Raises:
        RobotConfigError: The file is not a calibration, its map does not fit its points, or it is too old.
    """
    plain = read_json_object(path, RobotConfigError)
    if plain.get("version") != VERSION:
        raise RobotConfigError(f"{path} must be a hand-eye calibration of version {VERSION}; make it again")
    try:
        document = typed(plain, _Document)
    except ValueError as error:
        raise RobotConfigError(f"{path} is not a hand-eye calibration: {error}; make it again") from error
    camera, rig = [point.camera_mm for point in document.points], [point.rig_mm for point in document.points]
    found = fit_hand_eye(camera, rig, written=document.written.astimezone(UTC))
    if not np.allclose(document.rigid, found.rigid, rtol=0, atol=1e-6):  # 1 nm: same sums elsewhere
        raise RobotConfigError(f"{path}: the rigid map must fit its points; the file was changed, make it again")
    _check_age(path, found, max_age_days, now)
    return found


def _check_age(path: Path, found: HandEye, max_age_days: float | None, now: datetime | None) -> None:
    age = found.age_days(now)
    if timedelta(days=age) < -_MAX_CLOCK_ERROR:
        raise RobotConfigError(f"{path} was written {-age:.0f} days in the future; set the clock, or calibrate again")
    if max_age_days is not None and not age <= max_age_days:
        raise RobotConfigError(
            f"{path} must be at most {max_age_days:g} days old, got {age:.0f}; calibrate again, or allow more days"
        )


_Place = tuple[float, float, float]
_Matrix = tuple[tuple[float, float, float, float], ...]


@dataclass(frozen=True)
class _PointPair:
    camera_mm: _Place
    rig_mm: _Place


@dataclass(frozen=True)
class _Document:
    """Content of the saved file."""

    version: int
    written: datetime
    rigid: Annotated[_Matrix, Meta(min_length=4, max_length=4)]
    rigid_errors: FitErrors
    affine: _Matrix | None
    affine_errors: FitErrors | None
    points: tuple[_PointPair, ...]


def _describe_errors(errors: FitErrors) -> str:
    return f"the rigid map's mean error is {errors.mean_mm:.1f} mm, and {errors.loo_mean_mm:.1f} mm for left-out points"


def _unit_causes(camera: Points, rig: Points) -> list[str]:
    if max(_extent(rig), _extent(camera)) < _MIN_EXTENT_MM:
        return ["all points seem to be in metres, but they must be in mm"]
    ratio = _extent(rig) / _extent(camera)
    low, high = _METRES_RATIO
    named = (("camera", low <= ratio <= high), ("rig", low <= 1 / ratio <= high))
    return [f"the {name} points seem to be in metres, but they must be in mm" for name, is_so in named if is_so]


def _mirror_causes(found: HandEye) -> list[str]:
    """Return a cause if a mirrored camera, in any unit, fits much better, or if the affine map mirrors.

    Coplanar points cannot show a mirrored axis, and two swapped corners of a tetrahedron give the same picture.
    """
    rig, scaled = found.rig_mm, found.camera_mm * (_extent(found.rig_mm) / _extent(found.camera_mm))
    plain, mirrored = (
        float(np.linalg.norm(apply_map(fit_rigid(points, rig), points) - rig, axis=1).mean())
        for points in (scaled, scaled * [1.0, 1.0, -1.0])
    )
    explains = plain > 2 * mirrored + _SUSPECT_MM
    if not explains and (found.affine is None or np.linalg.det(found.affine[:3, :3]) > 0):
        return []
    other = (
        "" if explains and len(rig) >= _MIN_MIRROR_POINTS else ", or camera points are paired with the wrong rig points"
    )
    return [f"one axis seems to be mirrored, or two swapped (x right, y down, z forward; the rig's z up){other}"]


def _extent(points: Points) -> float:
    """Return the RMS distance from the mean; above 0, because collinear points are rejected."""
    return float(np.sqrt(np.square(points - points.mean(0)).sum(1).mean()))


def _points(name: str, points: npt.ArrayLike) -> Points:
    try:
        found = np.array(points, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise RobotConfigError(f"{name} points must be rows of x, y and z in mm: {error}") from error
    if found.ndim != 2 or found.shape[1] != 3 or not (np.abs(found) < _MAX_COORDINATE_MM).all():  # also rejects NaN
        raise RobotConfigError(
            f"{name} points must be (N, 3) finite mm within a kilometre, got {found.shape}: {found.tolist()}"
        )
    return found


def _row(path: Path, line: int, row: Mapping[str, Any]) -> list[float]:
    try:
        numbers = [float(row[column]) for column in COLUMNS]
    except (TypeError, ValueError, KeyError) as error:
        raise RobotConfigError(f"{path}, line {line}: every column must contain a number in mm: {error}") from error
    if len(row) != len(COLUMNS):
        raise RobotConfigError(f"{path}, line {line} must have {len(COLUMNS)} columns, got more")
    return numbers


def _affine_problem(camera: Points) -> str:
    """Return the reason why these points do not determine an affine map, or ""."""
    if len(camera) < 5:
        return f"an affine map requires at least 5 pairs of points, got {len(camera)}"
    if _min_spread(camera, 3) < MIN_SPREAD:
        return "an affine map requires points that do not lie on one plane, nor all but one of them"
    return ""


def _min_spread(points: Points, dimensions: int) -> float:
    """Return the ratio of the last to the first of the main `dimensions`, the smallest with any point left out."""
    ratios = []
    for index in range(len(points)):
        others = np.delete(points, index, axis=0)
        extents = np.linalg.svd(others - others.mean(0), compute_uv=False)
        ratios.append(float(extents[dimensions - 1] / extents[0]) if extents[0] > 0 else 0.0)
    return min(ratios)


def _matrix(linear: Points, offset: Points) -> Points:
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = linear, offset
    return found
