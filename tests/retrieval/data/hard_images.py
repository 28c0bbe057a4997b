"""Hard cases of pictures: integers that wrap, samples that are skipped, a NaN."""

from collections.abc import Iterator

import numpy as np

from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import resize, to_float
from tests.hard_case import HardCase, error_of

_BACKGROUND, _RESIZE = "background", "resize"


def hard_cases() -> Iterator[HardCase]:
    """Yield the hard cases of pictures."""
    yield _background_wraps()
    yield _sixteen_bits()
    yield _checkers()
    yield _nan_picture()


def _background_wraps() -> HardCase:
    """One grey level darker than the no-contact frame: -1/255."""
    touch, gel = np.full((1, 1, 3), 100, np.uint8), np.full((1, 1, 3), 101, np.uint8)
    naive = float(to_float(touch - gel)[0, 0, 0])
    settings = Preprocessing(touch_px=1, background="difference")
    ours = float(settings.touch(to_float(touch), to_float(gel))[0, 0, 0])
    near = [abs(value + 1 / 255) < 1e-6 for value in (naive, ours)]
    expected, naive_text = f"{-1 / 255:.5f}", f"uint8 wraps to {naive:.5f}"
    return HardCase(_BACKGROUND, "one grey level darker", expected, naive_text, f"{ours:.5f}", near[1], near[0])


def _sixteen_bits() -> HardCase:
    """A nearly white pixel of a 16-bit camera."""
    samples = np.full((1, 1, 3), 65_280, np.uint16)
    naive, ours = float(samples.astype(np.uint8)[0, 0, 0] / 255), float(to_float(samples)[0, 0, 0])
    true = 65_280 / 65_535
    near = [abs(value - true) < 1e-6 for value in (naive, ours)]
    return HardCase("samples", "65280 of 16 bits", f"{true:.4f}", f"{naive:.4f}", f"{ours:.4f}", near[1], near[0])


def _checkers() -> HardCase:
    """A texture 8 times too fine for the new size; it must become its mean, not one of its pixels."""
    import cv2

    y, x = (np.indices((512, 512)) + 2) // 4
    fine = np.repeat(((x + y) % 2).astype(np.float32)[..., None], 3, axis=2)
    results = cv2.resize(fine, (64, 64), interpolation=cv2.INTER_LINEAR), resize(fine, (64, 64))
    error = [float(np.abs(image - 0.5).max()) for image in results]
    naive, ours = (f"off by {value:.2g}" for value in error)
    expected = "0.5 everywhere"
    return HardCase(_RESIZE, "checkers of 4 px, 512 px to 64", expected, naive, ours, error[1] < 1e-6, error[0] < 1e-6)


def _nan_picture() -> HardCase:
    """One sample of a touch is NaN; a tower's mean over the picture makes all features NaN."""
    touch = np.full((8, 8, 3), 0.5, np.float32)
    touch[3, 4, 0] = np.nan
    naive = float(touch.mean())
    ours, holds = error_of(lambda: Preprocessing(touch_px=8).touch(touch), "touch", "NaN")
    return HardCase("samples", "one sample is NaN", "refused", f"mean {naive}", ours, holds, bool(np.isfinite(naive)))
