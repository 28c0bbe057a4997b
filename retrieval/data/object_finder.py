"""The place of the object in a photo, found by a small network.

    photo --resize--> (128, 128, 3) --network--> mask (64, 64) --regions--> box and area

The network was trained on rendered photos (`models/object_finder.py`); OpenCV runs it.
"""

import threading
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.files import file_digest
from retrieval.data.resize import Samples, resize

INPUT_PX = 128
_MASK_PX = 512
"""Side of the enlarged mask in which the outline is read."""
_SMALLEST_PART = 0.2
"""Least weight of a region of the object, relative to the largest one."""
_SPREAD = 0.08
"""Squared distance from the photo's middle, in sides of the photo, at which the weight of a region falls to 1/e."""
_SMALLEST_OBJECT = 0.002
"""Least area of an object, relative to the photo."""
NETWORK = Path(__file__).parents[1] / "shipped" / "object-finder.onnx"


class FoundObject(NamedTuple):
    """The box of an object in a photo and its visible area, in pixels; right and bottom lie outside the box."""

    left: float
    top: float
    right: float
    bottom: float
    area: float

    @property
    def middle(self) -> tuple[float, float]:
        """The middle of the box, x and y."""
        return (self.left + self.right) / 2, (self.top + self.bottom) / 2

    @property
    def side(self) -> float:
        """The longer side of the box."""
        return max(self.right - self.left, self.bottom - self.top)

    def scaled(self, factor: float) -> "FoundObject":
        """Return the object in the same photo at another size."""
        left, top, right, bottom = (edge * factor for edge in self[:4])
        return FoundObject(left, top, right, bottom, self.area * factor**2)


class ObjectFinder:
    """Finds the object in photos with a network of a file; several threads may use it."""

    def __init__(self, network: Path = NETWORK) -> None:
        """Remember the file; each thread reads it once."""
        self._file, self._local = network, threading.local()

    def find(self, photo: Samples) -> FoundObject:
        """Return the object in a photo (H, W, 3), or the whole photo if none is found."""
        logits = cv2.resize(self.logits(photo), (_MASK_PX, _MASK_PX), interpolation=cv2.INTER_LINEAR)
        count, number, regions, middles = cv2.connectedComponentsWithStats((logits > 0).astype(np.uint8))
        if count < 2:
            return whole_photo(photo)
        certainty = np.bincount(number.ravel(), np.tanh(logits / 2).ravel())[1:]
        weights = certainty * np.exp(-np.square(middles[1:] / _MASK_PX - 0.5).sum(axis=1) / _SPREAD)
        left, top, wide, high, area = regions[1:][weights >= _SMALLEST_PART * weights.max()].T
        if area.sum() < _SMALLEST_OBJECT * logits.size:
            return whole_photo(photo)
        down, across = (side / _MASK_PX for side in photo.shape[:2])
        right, bottom = (left + wide).max() * across, (top + high).max() * down
        return FoundObject(left.min() * across, top.min() * down, right, bottom, area.sum() * across * down)

    def logits(self, photo: Samples) -> NDArray[np.float32]:
        """Return the logits (INPUT_PX / 2, INPUT_PX / 2) of the object's pixels in a photo (H, W, 3)."""
        small = np.clip(resize(photo, (INPUT_PX, INPUT_PX)), 0, 1)
        network = self._network()
        network.setInput(np.ascontiguousarray(small.transpose(2, 0, 1)[None]))
        logits: NDArray[np.float32] = network.forward()[0, 0]
        return logits

    def _network(self) -> Any:
        if not hasattr(self._local, "network"):
            self._local.network = cv2.dnn.readNetFromONNX(str(self._file))
        return self._local.network


def whole_photo(photo: Samples) -> FoundObject:
    """Return an object that fills a photo (H, W, 3)."""
    height, width = photo.shape[:2]
    return FoundObject(0.0, 0.0, width, height, width * height)


def crop_square(image: Samples, found: FoundObject, side: float) -> Samples:
    """Return the square of `side` pixels around an object's middle; pixels beyond the photo's edge repeat the edge."""
    size = max(round(side), 1)
    left, top = (round(middle - size / 2) for middle in found.middle)
    inside = image[max(top, 0) : top + size, max(left, 0) : left + size]
    above, before = max(-top, 0), max(-left, 0)
    beyond = above, size - above - inside.shape[0], before, size - before - inside.shape[1]
    whole: Samples = cv2.copyMakeBorder(inside, *beyond, cv2.BORDER_REPLICATE) if any(beyond) else inside
    return whole


_FINDER = ObjectFinder()


@lru_cache(maxsize=1)
def network_digest() -> str:
    """Return the SHA-256 (hex) of the network that `find_object` uses."""
    return file_digest(NETWORK)


def find_object(photo: Samples) -> FoundObject:
    """Return the object in a photo (H, W, 3), or the whole photo if none is found."""
    return _FINDER.find(photo)
