"""Errors between two pictures: L1, MSE, SSIM, PSNR, all on grey levels of 0 to 255."""

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from robot.errors import BadRobotInput

_SSIM_SIGMA, _SSIM_REACH = 1.5, 5


class PictureError(NamedTuple):
    """Mean absolute and mean squared difference, structural similarity, and peak signal-to-noise ratio in dB."""

    l1: float
    mse: float
    ssim: float
    psnr: float


def compare(picture: NDArray[Any], truth: NDArray[Any]) -> PictureError:
    """Return errors of `picture` (rows, cols, channels; rounded and clipped to 0..255) against `truth` (uint8).

    PSNR is 20 log10(255 / rms), infinite for equal pictures. Raise BadRobotInput for pictures that differ in shape or
    are smaller than SSIM's window (11 x 11), and for a pixel that is NaN or infinite.
    """
    if picture.shape != truth.shape or picture.ndim != 3 or min(picture.shape[:2]) < 2 * _SSIM_REACH + 1:
        raise BadRobotInput(
            f"two pictures must have one shape, 11 x 11 x channels or more, got {picture.shape} and {truth.shape}"
        )
    if not np.isfinite(picture).all():
        place = tuple(map(int, np.argwhere(~np.isfinite(picture))[0]))
        raise BadRobotInput(f"a picture must be finite to be compared, got {picture[place]} at {place}")
    rounded = np.clip(np.rint(picture.astype(np.float64)), 0, 255)
    difference = rounded - truth
    mse = float(np.mean(difference**2))
    psnr = 10 * math.log10(255**2 / mse) if mse > 0 else math.inf
    return PictureError(float(np.abs(difference).mean()), mse, ssim(rounded, truth), psnr)


def ssim(one: NDArray[Any], other: NDArray[Any]) -> float:
    """Return the mean structural similarity of two (rows, cols, channels) pictures of 0..255.

    Wang, Bovik, Sheikh & Simoncelli 2004: Gaussian window of 11 x 11 pixels with sigma 1.5, K1 = .01, K2 = .03, channel
    by channel, for windows that lie completely inside.
    """
    a, b = one.astype(np.float64), other.astype(np.float64)
    mean_a, mean_b = _window_mean(a), _window_mean(b)
    variance_a = _window_mean(a * a) - mean_a**2
    variance_b = _window_mean(b * b) - mean_b**2
    covariance = _window_mean(a * b) - mean_a * mean_b
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    top = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return float(np.mean(top / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2))))


def _window_mean(image: NDArray[np.float64]) -> NDArray[np.float64]:
    size, cut = 2 * _SSIM_REACH + 1, slice(_SSIM_REACH, -_SSIM_REACH)
    blurred: NDArray[np.float64] = cv2.GaussianBlur(image, (size, size), _SSIM_SIGMA)[cut, cut]
    return blurred
