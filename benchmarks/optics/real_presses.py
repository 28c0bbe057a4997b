"""Real presses of a ball into a GelSight, and the surface of each.

The data are the `dataPack.npz` of the package `taxim` (MIT): `f0` the unpressed gel, `imgs` the pressed ones,
`touch_center` (x, y) in pixels, labelled by hand. The arrays are plain; nothing is unpickled.

Channels keep their order, and the first is called red. The files do not state the order. In this order, the presses on
the Mini have the colours of other Mini recordings, and the lamps of the older sensor are red below on the left, green
above on the left, blue on the right. (The package itself takes the first for blue.)

The surface comes from our own contact solver: a ball on a bonded layer, solved once for a series of depths; a press is
interpolated by its contact radius. Only the shape matters here, so the gel's modulus has no effect.
"""

import math
import zipfile
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter

from robot.errors import BadRobotInput, UnknownName
from robot.sim.contact.layer import Layer, press

Matrix = NDArray[np.float64]

CROP = 200
PIXEL_MM = 0.0295
# The radius of the ball of the Mini's presses is not documented: it is chosen with the rest of the model.
BALLS_MM = {"gelsight": (2.0,), "gelsight_mini": (0.7, 0.85, 1.0, 2.0)}


@dataclass(frozen=True, eq=False)
class Presses:
    """Presses of one sensor.

    Attributes:
        name: the sensor.
        no_contact: (rows, cols, 3) uint8, the unpressed gel.
        pictures: (count, rows, cols, 3) uint8, the pressed gels.
        centres: (count, 2) labelled centres x, y in pixels.
    """

    name: str
    no_contact: NDArray[np.uint8]
    pictures: NDArray[np.uint8]
    centres: Matrix

    def __len__(self) -> int:
        return len(self.pictures)

    def smooth_no_contact(self, blur_px: float) -> Matrix:
        """Return the unpressed gel (rows, cols, 3), with its noise blurred away (standard deviation; 0: unchanged)."""
        return _blurred(self, blur_px)

    def crop(self, index: int) -> tuple[slice, slice]:
        """Return rows and columns of 200 x 200 pixels around the labelled centre, moved inside the picture."""
        starts = [
            min(max(round(float(middle)) - CROP // 2, 0), size - CROP)
            for middle, size in zip(self.centres[index][::-1], self.no_contact.shape[:2], strict=True)
        ]
        return slice(starts[0], starts[0] + CROP), slice(starts[1], starts[1] + CROP)


@lru_cache(maxsize=16)
def _blurred(presses: Presses, blur_px: float) -> Matrix:
    image = presses.no_contact.astype(np.float64)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px)) if blur_px > 0 else image


def find_presses() -> Path:
    """Return the folder with a folder per sensor in the installed `taxim`. Raise BadRobotInput if it is missing."""
    spec = find_spec("taxim")
    if spec is None or not spec.submodule_search_locations:
        raise BadRobotInput(
            "real presses come with the package taxim, which is missing; "
            "run pip install 'touch-retrieval[calibration]' or give their folder with --data"
        )
    return Path(next(iter(spec.submodule_search_locations))) / "calib"


def read_presses(folder: str | Path, name: str) -> Presses:
    """Read `<folder>/<name>/dataPack.npz`. Raise UnknownName, or BadRobotInput for an invalid file."""
    if name not in BALLS_MM:
        raise UnknownName(f"there are no presses {name!r}; known are {', '.join(BALLS_MM)}")
    path = Path(folder) / name / "dataPack.npz"
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as pack:
            found = [pack[key] for key in ("f0", "imgs", "touch_center")]
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise BadRobotInput(f"{path} must hold f0, imgs and touch_center as plain arrays: {error}") from error
    no_contact, pictures, centres = found
    good = (
        no_contact.dtype == pictures.dtype == np.uint8 and pictures.ndim == 4 and pictures.shape[1:] == no_contact.shape
    )
    if not good or min(no_contact.shape[:2]) < CROP or centres.shape != (len(pictures), 2):
        shapes = [array.shape for array in found]
        raise BadRobotInput(f"{path} must hold uint8 pictures of one size, {CROP} pixels or more, got {shapes}")
    bad = np.flatnonzero(~np.isfinite(centres).all(axis=1))
    if len(bad):
        raise BadRobotInput(f"{path} must hold finite centres; press {bad[0]} has {centres[bad[0]]}")
    return Presses(name, no_contact, pictures, centres.astype(np.float64))


@lru_cache(maxsize=256)
def changed_centre(presses: Presses, index: int, threshold: float = 25) -> tuple[float, float]:
    """Return x, y of the middle of the change in the crop (pixels of the picture): a start without a label."""
    rows, cols = presses.crop(index)
    change = np.abs(presses.pictures[index][rows, cols].astype(np.float32) - presses.no_contact[rows, cols]).sum(axis=2)
    change = cv2.GaussianBlur(change, (0, 0), 3)
    change[change < threshold] = 0
    total = float(change.sum())
    if total == 0:
        return float(presses.centres[index][0]), float(presses.centres[index][1])
    x = float(change.sum(axis=0) @ np.arange(cols.start, cols.stop)) / total
    return x, float(change.sum(axis=1) @ np.arange(rows.start, rows.stop)) / total


# Surfaces --------------------------------------------------------------------------------------------------

_GRID, _HALF_MM = 129, 8.0  # of the solved press: 0.12 mm; the displaced region ends well inside
_DEPTHS = 22
_FINE = 1600  # points of a profile, 0.005 mm apart
_EXACT = 0.98  # up to this fraction of the contact radius the gel follows the ball


@dataclass(frozen=True, eq=False)
class BallTable:
    """Profiles along the radius for a series of contact radii: displacement first, then smoothed over each reach."""

    ball_mm: float
    contact_mm: Matrix  # (depths,), increasing
    heights: Matrix  # (depths, 1 + reaches, points)
    slopes: Matrix  # same shape, along the radius

    def at(self, contact_mm: float, x_mm: Matrix, y_mm: Matrix) -> list[tuple[Matrix, Matrix, Matrix]]:
        """Return value, slope along x and slope along y at these offsets, for displacement and each smoothed one."""
        radius = np.hypot(x_mm, y_mm)
        safe = np.maximum(radius, 1e-9)
        out = []
        for order, (height, slope) in enumerate(zip(*self._profiles(contact_mm), strict=True)):
            place = np.minimum(radius / _HALF_MM * (_FINE - 1), _FINE - 1)
            fall = np.interp(place, np.arange(_FINE), slope)
            if order == 0:
                fall = np.where(radius < _EXACT * contact_mm, -self._ball_slope(radius), fall)
            out.append((np.interp(place, np.arange(_FINE), height), fall * x_mm / safe, fall * y_mm / safe))
        return out

    def _profiles(self, contact_mm: float) -> tuple[Matrix, Matrix]:
        known = self.contact_mm
        upper = int(np.clip(np.searchsorted(known, contact_mm), 1, len(known) - 1))
        fraction = float(np.clip((contact_mm - known[upper - 1]) / (known[upper] - known[upper - 1]), 0, 1))
        heights = (1 - fraction) * self.heights[upper - 1] + fraction * self.heights[upper]
        return heights, (1 - fraction) * self.slopes[upper - 1] + fraction * self.slopes[upper]

    def _ball_slope(self, radius: Matrix) -> Matrix:
        """Return r / sqrt(R^2 - r^2), limited near the equator."""
        return radius / np.sqrt(np.maximum(self.ball_mm**2 - radius**2, (0.05 * self.ball_mm) ** 2))


@lru_cache(maxsize=16)
def ball_table(ball_mm: float, thickness_mm: float, poisson: float, reaches_mm: tuple[float, ...]) -> BallTable:
    """Press a rigid ball to a series of depths; the deepest is nearly to its equator."""
    pixel = 2 * _HALF_MM / _GRID
    axis = (np.arange(_GRID) - _GRID // 2) * pixel
    square = axis[:, None] ** 2 + axis**2
    gap = np.where(square < ball_mm**2, ball_mm - np.sqrt(np.maximum(ball_mm**2 - square, 0)), math.inf)
    contacts: list[float] = []
    heights: list[Matrix] = []
    for depth in np.geomspace(0.01, 1.3, _DEPTHS) * ball_mm:
        contact = press(gap, pixel, Layer(0.3, poisson, thickness_mm), depth_mm=float(depth), tolerance=1e-4)
        radius = math.sqrt(contact.area_mm2 / math.pi)
        if not contacts or radius > contacts[-1]:
            contacts.append(radius)
            heights.append(_radial(contact.displacement_mm, reaches_mm, pixel))
    profiles = CubicSpline(axis[_GRID // 2 :], np.stack(heights), axis=-1)
    fine = np.linspace(0, _HALF_MM, _FINE)
    return BallTable(ball_mm, np.array(contacts), profiles(fine), profiles(fine, 1))


def _radial(displacement: Matrix, reaches_mm: tuple[float, ...], pixel: float) -> Matrix:
    """Return the middle row to the right, unsmoothed and smoothed over each reach: (1 + reaches, points)."""
    maps = [displacement, *(gaussian_filter(displacement, reach / pixel) for reach in reaches_mm)]
    return np.stack([one[_GRID // 2, _GRID // 2 :] for one in maps])
