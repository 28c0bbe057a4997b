"""The blur of a photo, measured at the edges of its object, and the removal of blur.

A blur attenuates the relief's fine structure in a photo, but does not delete it. A Wiener filter amplifies it again, as
far as noise and compression permit.
"""

import math

import cv2
import numpy as np

from retrieval.data.object_finder import FoundObject
from retrieval.data.resize import RgbImage, Samples, resize, to_float

_TEST_BLUR_PX, _STEEPEST, _MARGIN = 1.5, 99.5, 0.05
_VIEW_PX = 160
"""Side of the picture of the object in which slopes are measured, about that of a view: finer detail is not used."""
_LARGEST_SCALE = 2.0
SHARP_PX, BLURRED_PX = 0.85, 1.4
"""Blur of an ordinary photo, which stays, and the least one that is removed, as standard deviations in pixels."""
_MOST_PX = 2.5
"""Largest blur that is removed; of a stronger one, as much."""
_ARTEFACTS = 0.02
"""Power of compression artefacts relative to the photo's; larger than that of JPEG at quality 90."""
_LEAST_NOISE, _NOISE_FACTOR = 1e-3, 1200.0
"""Least power of the noise, relative to the photo's, and this power for a noise with a variance of 1."""
_LAPLACIAN_PAIR = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)


def blur_px(photo: Samples, found: FoundObject) -> float:
    """Return the standard deviation of a photo's blur in pixels of the picture of its object, at most 160 a side.

    A further blur t changes the steepest slope of an edge with the blur s by the factor s / sqrt(s^2 + t^2). The Sobel
    operator's own blur, 0.75 pixels, is included.
    """
    (x, y), reach = found.middle, _box_px(found) / 2
    top, left = max(int(y - reach), 0), max(int(x - reach), 0)
    inside = photo[top : math.ceil(y + reach), left : math.ceil(x + reach)]
    height, width = (min(side, _VIEW_PX) for side in inside.shape[:2])
    grey = resize(inside, (height, width)).mean(axis=2)
    slopes = []
    for picture in (grey, cv2.GaussianBlur(grey, (0, 0), _TEST_BLUR_PX)):
        across, down = cv2.Sobel(picture, cv2.CV_32F, 1, 0), cv2.Sobel(picture, cv2.CV_32F, 0, 1)
        slopes.append(float(np.percentile(np.hypot(across, down), _STEEPEST)))
    ratio = min(slopes[1] / max(slopes[0], 1e-6), 0.99)
    return _TEST_BLUR_PX * ratio / math.sqrt(1 - ratio**2)


def sharpen(photo: Samples, found: FoundObject, measured_px: float, is_lossy: bool) -> tuple[Samples, FoundObject]:
    """Return a photo (H, W, 3) as sharp as an ordinary one, and its object; both as they are if its blur is ordinary.

    A large photo becomes smaller: the picture of its object has at most two pixels for each one of the measurement.

    Args:
        photo: The photo.
        found: Its object.
        measured_px: Its blur, from `blur_px`.
        is_lossy: Whether the photo has compression artefacts.
    """
    if measured_px < BLURRED_PX:
        return photo, found
    scale = _box_px(found) / _VIEW_PX
    if scale > _LARGEST_SCALE:
        factor, scale = _LARGEST_SCALE / scale, _LARGEST_SCALE
        height, width = (math.ceil(side * factor) for side in photo.shape[:2])
        photo, found = resize(photo, (height, width)), found.scaled(factor)
    removed_px = max(scale, 1.0) * min(math.sqrt(measured_px**2 - SHARP_PX**2), _MOST_PX)
    noise = max(_noise_power(photo), _ARTEFACTS if is_lossy else _LEAST_NOISE)
    margin = math.ceil(8 * removed_px)
    levels = cv2.copyMakeBorder(to_float(photo), *(margin,) * 4, cv2.BORDER_REPLICATE)
    down, across = np.fft.fftfreq(levels.shape[0])[:, None], np.fft.rfftfreq(levels.shape[1])
    kept = np.exp(-2 * np.square(math.pi * removed_px) * (down**2 + across**2))
    gain = (1 + noise) * kept / (kept**2 + noise)
    spectrum = np.fft.rfft2(levels, axes=(0, 1)) * gain[..., None]
    sharp = np.fft.irfft2(spectrum, levels.shape[:2], axes=(0, 1))[margin:-margin, margin:-margin]
    return np.ascontiguousarray(np.clip(sharp, 0, 1), np.float32), found


def _box_px(found: FoundObject) -> float:
    """Return the side in pixels of the part of a photo in which slopes are measured."""
    return (1 + 2 * _MARGIN) * found.side


def _noise_power(photo: Samples) -> float:
    """Return the power of the noise, relative to that of an ordinary photo, from the finest details.

    The noise is measured as by Immerkaer, Computer Vision and Image Understanding 64:2, 1996.
    """
    grey: RgbImage = to_float(photo).mean(axis=2)
    finest = float(np.abs(cv2.filter2D(grey, -1, _LAPLACIAN_PAIR)).mean())
    return _NOISE_FACTOR * math.pi / 2 * (finest / 6) ** 2
