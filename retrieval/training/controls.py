"""Images of controls: without fine tactile detail, or without the object."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retrieval.data.camera import USUAL_CAMERA, PhotoCamera
from retrieval.data.images import read_rgb
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import RgbImage, resize


def low_pass(image: RgbImage) -> RgbImage:
    """Return an image (H, W, 3) reduced to 8 x 6 pixels and enlarged to its old size.

    A Gaussian blur of a tenth of the width precedes the reduction. Lamps, gel drift and coarse shape remain, so a
    method's score on such images does not come from fine tactile detail.
    """
    height, width = image.shape[:2]
    down, across = _low_pass_matrix(height, 6, width / 10), _low_pass_matrix(width, 8, width / 10)
    small = np.einsum("ih,hwc,jw->ijc", down, image, across, optimize=True)
    return resize(np.ascontiguousarray(small, dtype=np.float32), (height, width))


@lru_cache(maxsize=16)
def _low_pass_matrix(old: int, new: int, sigma: float) -> NDArray[np.float32]:
    """Return a matrix (new, old) that blurs and resizes one axis: blurring whole pictures would take longer."""
    import cv2

    kernel = cv2.getGaussianKernel(round(8 * sigma) + 1 | 1, sigma, cv2.CV_32F)
    smooth = cv2.sepFilter2D(np.eye(old, dtype=np.float32), -1, np.ones(1, np.float32), kernel)
    return resize(np.repeat(smooth[..., None], 3, axis=2), (new, old))[..., 0]


def photo_margin(image: RgbImage) -> RgbImage:
    """Return a photo (H, W, 3) with only its margin (an eighth of each side); the rest is the margin's mean colour."""
    high, wide = (max(1, side // 8) for side in image.shape[:2])
    inside = np.zeros(image.shape[:2], dtype=np.bool_)
    inside[high:-high, wide:-wide] = True
    return np.where(inside[..., None], image[~inside].mean(0), image).astype(np.float32)


class LowPassPreprocessing(Preprocessing):
    """Preprocessing of low-pass touches."""

    def load_touch(self, path: str | Path, reference: str | Path | None = None) -> RgbImage:
        """Read the low-pass gel image, and a no-contact frame likewise."""
        return self.touch(low_pass(read_rgb(path)), None if reference is None else low_pass(read_rgb(reference)))


class MarginPreprocessing(Preprocessing):
    """Preprocessing of the margins of photos."""

    def load_photo(self, path: str | Path, camera: PhotoCamera = USUAL_CAMERA) -> RgbImage:
        """Read the margin of a photo."""
        return self.photo(photo_margin(read_rgb(path)))
