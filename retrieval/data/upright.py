"""The roll of a photo's camera, estimated by a small network, and a photo turned upright.

    photo --disc around the object--> (64, 64, 3) --network--> probability of each of 24 rolls

The towers know objects upright. The network was trained on rendered photos (`models/upright.py`); OpenCV runs it.
"""

import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from retrieval.data.object_finder import FoundObject, crop_square
from retrieval.data.resize import Samples, resize

INPUT_PX, ROLLS = 64, 24
DISC = 1.5
"""Diameter of the disc relative to the object's longer side."""
_LEAST_ROLL_DEG = 12
"""Least roll that is corrected: the towers know smaller ones."""
_LEAST_PROBABILITY = 0.4
"""Least probability of a roll and its two neighbours at which it is corrected."""
_QUARTERS: dict[float, int] = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}
_RIGHT_ANGLE_TOLERANCE_DEG = 8
"""Difference from a right angle below which a roll is taken for one: cameras are mostly turned by right angles."""
NETWORK = Path(__file__).parents[1] / "shipped" / "upright.onnx"

_AXIS = np.arange(INPUT_PX) - (INPUT_PX - 1) / 2
_INSIDE = np.hypot(*np.meshgrid(_AXIS, _AXIS)) <= INPUT_PX / 2


def disc(photo: Samples, found: FoundObject) -> NDArray[np.float32]:
    """Return the surroundings of an object (INPUT_PX, INPUT_PX, 3), grey outside a disc, whose frame shows no roll."""
    square = np.clip(resize(crop_square(photo, found, DISC * found.side), (INPUT_PX, INPUT_PX)), 0, 1)
    return masked(square)


def masked(square: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a square picture (INPUT_PX, INPUT_PX, 3), grey outside the inscribed disc."""
    return np.where(_INSIDE[..., None], square, np.float32(0.5))


class RollEstimator:
    """Estimates the roll of photos with a network of a file, in one thread."""

    def __init__(self, network: Path = NETWORK) -> None:
        """Read the file."""
        self._network = cv2.dnn.readNetFromONNX(str(network))

    def probabilities(self, photo: Samples, found: FoundObject) -> NDArray[np.float64]:
        """Return the probability of each roll (ROLLS,), in steps from no roll, for a photo (H, W, 3).

        It is the mean over four copies of the photo, turned by right angles.
        """
        shown, found_rolls = disc(photo, found), []
        for quarters in range(4):
            self._network.setInput(np.ascontiguousarray(np.rot90(shown, quarters).transpose(2, 0, 1)[None]))
            likely = np.exp(self._network.forward()[0].astype(np.float64))
            found_rolls.append(np.roll(likely / likely.sum(), -quarters * ROLLS // 4))
        return np.asarray(np.mean(found_rolls, axis=0))


def probable_roll(probabilities: NDArray[np.float64]) -> float:
    """Return the roll in degrees, -180 to 180, from the probability of each; 0 for a small or an improbable one."""
    near = np.arange(-1, 2)
    mass = np.sum([np.roll(probabilities, -shift) for shift in near], axis=0)
    best = int(np.argmax(mass))
    around = probabilities[(best + near) % ROLLS]
    roll = math.remainder((best + float(around @ near / around.sum())) * 360 / ROLLS, 360)
    if abs(roll) < _LEAST_ROLL_DEG or mass[best] < _LEAST_PROBABILITY:
        return 0.0
    right = 90.0 * round(roll / 90)
    return right if abs(roll - right) < _RIGHT_ANGLE_TOLERANCE_DEG else float(round(roll))


def turn(photo: Samples, roll_deg: float) -> Samples:
    """Return a photo (H, W, 3) turned clockwise; its shorter side stays the same, and its edges are repeated."""
    if roll_deg % 360 in _QUARTERS:
        quarter: Samples = cv2.rotate(photo, _QUARTERS[roll_deg % 360])
        return quarter
    height, width = photo.shape[:2]
    is_across = abs(math.sin(math.radians(roll_deg))) > math.sqrt(0.5)
    size = (height, width) if is_across else (width, height)
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), -roll_deg, 1.0)
    matrix[:, 2] += [(size[0] - width) / 2, (size[1] - height) / 2]
    turned: Samples = cv2.warpAffine(photo, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return turned
